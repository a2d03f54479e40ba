"""What runs say together: who is ahead, what was learned, whether the time was enough."""
