"""Mega-NeRF's files: read without running what is in them, checked, and written."""
