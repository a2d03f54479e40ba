"""The procedural city: its plan, its exact geometry, its photographs, and their folder."""
