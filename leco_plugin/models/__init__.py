"""What is learned, and what it guides: gate, field, `leco-occupancy`, Switch-NeRF, guided hosts."""
