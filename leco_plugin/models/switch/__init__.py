"""The parts of `switch-nerf`: its field, its samples, its loss, its sizes."""
