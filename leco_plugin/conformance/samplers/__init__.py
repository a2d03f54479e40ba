"""The rules for samplers, at the seams of packed hosts and of proposal hosts."""
