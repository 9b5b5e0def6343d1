"""Captures that Blender films, with a known truth."""
