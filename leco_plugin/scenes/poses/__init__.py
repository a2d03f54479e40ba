"""From photographs to a scene: where each was taken, by structure from motion (`leco poses`)."""

ASKED = "colmap/asked.json"
"""In the folder of a scene: what was asked for, from before the work on."""
