"""A chart for people: picture, page and tables."""
