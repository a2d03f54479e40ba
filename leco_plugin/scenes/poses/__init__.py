"""From photographs to a scene: where each was taken, by structure from motion (`leco poses`)."""
