"""Dispatch to experts, matrix products and processes on one machine."""
