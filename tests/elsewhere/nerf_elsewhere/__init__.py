"""Hosts and a sampler of another package."""
