"""Several bodies on one grid, and solids without a video, with one Gaussian per particle."""

from collections.abc import Sequence

import numpy as np
import torch
import trimesh
from scipy.spatial import cKDTree
from torch import Tensor
from torch.nn.functional import normalize

from neuma_lib.coupling.binding import Binding
from neuma_lib.coupling.reconstruction import Reconstruction
from neuma_lib.mechanics.density import Density, density_at
from neuma_lib.splatting.gaussians import Gaussians
from neuma_lib.splatting.spherical_harmonics import rgb_to_sh0

BODY_COLOURS = (
    (0.90, 0.62, 0.0), (0.34, 0.71, 0.91), (0.0, 0.62, 0.45), (0.80, 0.47, 0.65), (0.0, 0.45, 0.70),
)  # fmt: skip
"""RGB of the bodies in their order, those of Okabe and Ito (2008)."""

_WIDTH = 0.55  # standard deviation of a Gaussian in particle spacings, for closed surfaces with sharp edges
_OPACITY = 0.95
_LIGHT = (0.35, 0.8, 0.5)  # direction to the light: from above, slightly to the right of the camera
_AMBIENT = 0.45  # brightness of surfaces that face away from the light


def join(bodies: Sequence[Reconstruction]) -> Reconstruction:
    """Concatenate bodies: particles, Gaussians and bindings, in the given order. One body is returned unchanged."""
    if len(bodies) == 1:
        return bodies[0]
    offsets = np.cumsum([0, *(len(body.x0) for body in bodies)])
    entries = np.cumsum([0, *(len(body.binding.indices) for body in bodies)])
    bindings = [body.binding for body in bodies]
    starts = [b.indptr[:-1] + int(n) for b, n in zip(bindings, entries, strict=False)]
    binding = Binding(
        torch.cat([*starts, torch.tensor([int(entries[-1])])]),
        torch.cat([b.indices + int(n) for b, n in zip(bindings, offsets, strict=False)]),
        torch.cat([b.values for b in bindings]),
        (sum(b.shape[0] for b in bindings), int(offsets[-1])),
    )
    coefficients = max(body.gaussians.shN.shape[1] for body in bodies)
    parts = [body.gaussians for body in bodies]
    padded = [torch.nn.functional.pad(g.shN, (0, 0, 0, coefficients - g.shN.shape[1])) for g in parts]
    names = ("means", "quats", "scales", "opacities", "sh0")
    gaussians = Gaussians(
        **{name: torch.cat([getattr(g, name) for g in parts]) for name in names}, shN=torch.cat(padded)
    )
    x0, vol0, mass = (torch.cat([getattr(body, name) for body in bodies]) for name in ("x0", "vol0", "mass"))
    return Reconstruction(x0, vol0, mass, gaussians, binding, all(body.affine for body in bodies))


def coloured_solid(mesh: trimesh.Trimesh, x0: Tensor, density: Density, colors: Tensor) -> Reconstruction:
    """A solid filled with particles, with one isotropic Gaussian per particle for rendering.

    Args:
        mesh: surface of the solid, watertight [m].
        x0: particles inside it [m], shape (N, 3).
        density: mass density [kg/m^3].
        colors: RGB of the particles in [0, 1], shape (N, 3), shaded by a fixed light and the nearest surface normal.
    """
    volume = float(mesh.volume) / len(x0)
    vol0 = torch.full_like(x0[:, 0], volume)
    nearest = cKDTree(mesh.triangles_center).query(x0.numpy())[1]
    normals = torch.from_numpy(np.asarray(mesh.face_normals)[nearest]).to(x0)
    facing = (normals @ normalize(x0.new_tensor(_LIGHT), dim=0)).clamp(min=0)
    rgb = (_AMBIENT + (1 - _AMBIENT) * facing)[:, None] * colors.to(x0)
    gaussians = Gaussians(
        means=x0,
        quats=x0.new_tensor([1.0, 0.0, 0.0, 0.0]).repeat(len(x0), 1),
        scales=torch.full_like(x0, _WIDTH * volume ** (1 / 3)),
        opacities=torch.full_like(vol0, _OPACITY),
        sh0=rgb_to_sh0(rgb)[:, None, :],
        shN=x0.new_zeros(len(x0), 0, 3),
    )
    return Reconstruction(x0, vol0, vol0 * density_at(x0, density), gaussians, Binding.identity(len(x0), x0))
