"""Pages, measures and films of a capture."""
