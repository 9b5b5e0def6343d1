"""Interface of the compositors. A compositor is a module with four functions over the splats of I images:

``composite(splats, depths, background, settings, empty)``
    returns the images (I, H, W, 3), the alphas (I, H, W) and a tuple of tensors for the adjoint;
``composite_adjoint(splats, kept, background, settings, grad_pictures, grad_alphas, grad_splats, empty)``
    writes the gradients (I, G, SPLAT_SIZE) of all splats that are not culled; those of the others are undefined;
``compare(splats, depths, background, settings, observed, empty)``
    stores no images, takes straight-alpha RGBA (I, H, W) as int32, R in the lowest byte, and returns sums of squared
    differences from it over white, float64 (I, parts) with any number of parts, and a tuple of tensors for the adjoint;
``compare_adjoint(splats, kept, background, settings, scales, opacities, grad_splats)``
    writes, like ``composite_adjoint``, the gradients of half of these sums, times the scale (I,) of each image; those
    with respect to the opacities are undefined unless ``opacities`` is true.

``splats`` and ``depths`` are results of ``projection``, ``empty(name, shape, like, dtype)`` allocates.
"""

import dataclasses


@dataclasses.dataclass(frozen=True)
class Settings:
    """Image size [px], thresholds and blur [px^2] of ``rasterizer.rasterize``."""

    width: int
    height: int
    alpha_min: float
    alpha_max: float
    transmittance_min: float
    eps2d: float
