"""How large gate, field and batches are: from the scene, the device, or a checkpoint."""
