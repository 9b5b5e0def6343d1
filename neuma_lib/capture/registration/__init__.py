"""Pose, size and rigid motion of the reconstruction in the videos."""
