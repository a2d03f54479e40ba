"""Runs of a chart: made, each in a process of its own, kept in its folder, taken over, resumed."""
