"""Differentiable material point method."""
