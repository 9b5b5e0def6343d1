"""Cameras, Gaussian kernels, their deformation by particles, and the differentiable rasterizer."""

from neuma_lib.render.cameras import Cameras
from neuma_lib.render.deformation import deform
from neuma_lib.render.gaussians import Gaussians
from neuma_lib.render.rasterizer import Statistics, Workspace, rasterize

__all__ = ["Cameras", "Gaussians", "Statistics", "Workspace", "deform", "rasterize"]
