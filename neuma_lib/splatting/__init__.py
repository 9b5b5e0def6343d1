"""Gaussian splatting: cameras, Gaussians, and a differentiable rasterizer for batches of frames."""
