"""Kernels of :mod:`neuma_lib.splatting.projection` on a CPU: sixteen Gaussians at a time, one per lane of a vector."""

# No `from __future__ import annotations` here: Warp reads the annotations of kernels as objects.
import functools
import re

import torch
import warp as wp

from neuma_lib.device import native_source, start_warp, typed
from neuma_lib.splatting.records import SPLAT_SIZE
from neuma_lib.splatting.spherical_harmonics import SH_C0, SH_C1, SH_C2, SH_C3

start_warp()

LANES = 16


def source(dtype: torch.dtype, name: str, **constants: float) -> str:
    """C++ text of a function."""
    parts = native_source(__file__, ".cpp")
    values = {"SPLAT_SIZE": SPLAT_SIZE, "C0": SH_C0, "C1": SH_C1, **constants}
    values |= dict(zip(("C2A", "C2B", "C2C"), SH_C2)) | dict(zip(("C3A", "C3B", "C3C", "C3D", "C3E"), SH_C3))
    values["REAL"] = {torch.float32: "float", torch.float64: "double"}[dtype]
    return re.sub(rf"\b({'|'.join(values)})\b", lambda m: str(values[m[0]]), parts["start"] + parts[name])


@functools.cache
def kernels(dtype: torch.dtype, near: float, slack: float, unlimited: float, culled: float):
    """``(project, geometry_adjoint)`` Warp kernels of a dtype over packs of `LANES` Gaussians."""
    real = wp.dtype_from_torch(dtype)
    types = {
        **dict.fromkeys(("pack", "count", "frames", "views", "coefficients"), int),
        **dict.fromkeys(("width", "height", "eps2d", "alpha_min"), real),
        "means": wp.array3d(dtype=real),  # (T, G, 3)
        "covars": wp.array4d(dtype=real),  # (T, G, 3, 3)
        "opacities": wp.array(dtype=real),  # (G,)
        "sh": wp.array3d(dtype=real),  # (G, K, 3)
        "viewmats": wp.array3d(dtype=real),  # (V, 4, 4)
        "Ks": wp.array3d(dtype=real),  # (V, 3, 3)
        "splats": wp.array3d(dtype=real),  # (T V, G, SPLAT_SIZE), out
        "depths": wp.array2d(dtype=real),  # (T V, G), out
        "grad_splats": wp.array3d(dtype=real),  # (T V, G, SPLAT_SIZE)
        "grad_means": wp.array3d(dtype=real),  # (T, G, 3), out
        "grad_covars": wp.array4d(dtype=real),  # (T, G, 3, 3), out
    }
    own = typed(types)
    kernel = own.kernel(wp.get_module(f"{__name__}.{str(dtype).removeprefix('torch.')}"))
    constants = dict(NEAR_PLANE=near, REACH_SLACK=slack, UNLIMITED=unlimited, CULLED=culled)

    @own.func_native(source(dtype, "project", **constants))
    def project_pack(
        pack, count, frames, views, coefficients, means, covars, opacities, sh, viewmats, Ks, width, height, eps2d,
        alpha_min, splats, depths,
    ): ...  # fmt: skip

    @own.func_native(source(dtype, "adjoint", **constants))
    def adjoint_pack(
        pack, count, frames, views, coefficients, means, covars, sh, viewmats, Ks, width, height, splats, depths,
        grad_splats, grad_means, grad_covars,
    ): ...  # fmt: skip

    @kernel
    def project(means, covars, opacities, sh, viewmats, Ks, width, height, eps2d, alpha_min, splats, depths):
        project_pack(
            wp.tid(), means.shape[1], means.shape[0], viewmats.shape[0], sh.shape[1], means, covars, opacities, sh,
            viewmats, Ks, width, height, eps2d, alpha_min, splats, depths,
        )  # fmt: skip

    @kernel
    def geometry_adjoint(
        means, covars, sh, viewmats, Ks, width, height, splats, depths, grad_splats, grad_means, grad_covars
    ):
        adjoint_pack(
            wp.tid(), means.shape[1], means.shape[0], viewmats.shape[0], sh.shape[1], means, covars, sh, viewmats, Ks,
            width, height, splats, depths, grad_splats, grad_means, grad_covars,
        )  # fmt: skip

    return project, geometry_adjoint
