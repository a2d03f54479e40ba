"""`leco chart`: methods and samplers on one scene for the same time, and what came out, drawn."""
