"""What skipping costs: measured when the gate is frozen, and again while it guides."""
