"""Cameras, lenses, the board and the room."""
