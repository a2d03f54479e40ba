"""`leco export`: an occupancy in the formats of other programs."""
