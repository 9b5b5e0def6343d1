"""Data sets of others: how they lay out images and cameras."""
