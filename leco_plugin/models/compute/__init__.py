"""How points and products of matrices are moved on a machine, and among its processes."""
