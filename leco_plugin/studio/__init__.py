"""What nerfstudio 1.1.5 needs on present-day libraries and on machines without a network.

Nothing here acts on import: a model asks for what it needs when it is built.
"""
