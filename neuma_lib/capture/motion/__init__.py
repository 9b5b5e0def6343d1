"""Timing of the cameras and free flight of the object."""
