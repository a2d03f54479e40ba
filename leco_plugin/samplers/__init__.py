"""Samplers: what a host calls instead of its occupancy grid or its proposal networks."""
