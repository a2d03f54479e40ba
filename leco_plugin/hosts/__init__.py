"""What a host gets in place of its own sampling, and what watches over it."""
