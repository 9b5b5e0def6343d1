"""The surface of a moving body: its mesh at rest, deformed with the particles inside and coloured by its Gaussians."""

import numpy as np
import trimesh
from scipy.spatial import cKDTree
from torch import Tensor

from neuma_lib.geometry.skinning import carry, skinning_matrix
from neuma_lib.splatting.gaussians import Gaussians
from neuma_lib.splatting.spherical_harmonics import sh0_to_rgb

_NEAREST = 4  # number of Gaussians that colour a vertex


def moving_surface(mesh: trimesh.Trimesh, x: np.ndarray) -> np.ndarray:
    """Vertices (T, V, 3) [m] of a mesh that moves with the particles x (T, N, 3) [m], at rest in frame 0."""
    return carry(skinning_matrix(mesh.vertices, x[0]), x)


def vertex_colours(mesh: trimesh.Trimesh, gaussians: Gaussians) -> np.ndarray:
    """Colours (V, 3) in [0, 1] of a mesh at rest: means over the nearest Gaussians, weighted by opacity."""
    index = cKDTree(_numpy(gaussians.means)).query(mesh.vertices, k=min(_NEAREST, len(gaussians)))[1]
    index = index.reshape(len(mesh.vertices), -1)
    weight = _numpy(gaussians.opacities)[index][..., None]
    rgb = _numpy(sh0_to_rgb(gaussians.sh0[:, 0])).clip(0, 1)[index]
    return (weight * rgb).sum(axis=1) / weight.sum(axis=1)


def _numpy(tensor: Tensor) -> np.ndarray:
    return tensor.detach().double().cpu().numpy()
