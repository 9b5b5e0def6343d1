"""Masks of the object in photographs and videos."""
