"""Gaussian splatting: cameras, Gaussians, and a differentiable rasterizer for batches of frames."""

from neuma_lib.splatting.cameras import Cameras
from neuma_lib.splatting.gaussians import Gaussians
from neuma_lib.splatting.rasterizer import RenderBuffers, Statistics, rasterize

__all__ = ["Cameras", "Gaussians", "RenderBuffers", "Statistics", "rasterize"]
