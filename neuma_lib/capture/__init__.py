"""Capture of objects from photographs and videos: frames, lenses, printed board, camera poses, masks and motion."""
