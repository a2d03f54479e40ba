"""Learning an occupancy: its phases, how far a run has come, and what heals it."""
