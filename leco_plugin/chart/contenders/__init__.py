"""What a chart compares, as data, and how long every run of it may take."""
