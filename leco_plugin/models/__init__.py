"""Gate, field, rendering, losses, and the nerfstudio models `leco-occupancy` and `switch-nerf`."""
