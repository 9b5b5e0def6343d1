"""The rasterizer by the gsplat package (1.5.3), for comparison and as an alternative on CUDA in float32.

gsplat is imported at the first call only. Projection, colours, blur, near plane and depth order follow the same
conventions as ours. Constants that gsplat fixes in its kernels:

- alpha counts from 1/255 on, as our default;
- alpha is limited to 0.999, ours to 0.99 by default: images differ where a Gaussian is more opaque than that;
- a pixel ends where its transmittance would become 1e-4 or less, ours where it would fall below 1e-4;
- a splat ends 3.33 standard deviations from its centre, which is where an opacity of 1 reaches 1/255.
"""

from __future__ import annotations

import math

from neuma_lib.errors import InputError
from neuma_lib.splatting.compositing import Settings
from neuma_lib.splatting.projection import NEAR_PLANE

ALPHA_MIN = 1.0 / 255.0
TRANSMITTANCE_MIN = 1e-4


def rasterize(means, covars, opacities, sh, viewmats, Ks, background, settings: Settings):
    """Images (T, V, H, W, 3) and alphas (T, V, H, W); arguments as of ``rasterizer.rasterize``, checked by it.

    ``settings.alpha_max`` has no effect (see above).

    Raises:
        InputError: gsplat is not installed, or a threshold is not the one that gsplat fixes.
    """
    try:
        import gsplat
    except ImportError as error:
        raise InputError(
            f"rasterize: compositor 'gsplat' cannot import that package ({error}); "
            "install gsplat==1.5.3 and a CUDA compiler, or leave the compositor out"
        ) from error
    if not (
        math.isclose(settings.alpha_min, ALPHA_MIN)
        and math.isclose(settings.transmittance_min, TRANSMITTANCE_MIN)
    ):
        raise InputError(
            "rasterize: compositor 'gsplat' has alpha_min = 1/255 and transmittance_min = 1e-4 built in, "
            f"not {settings.alpha_min:g} and {settings.transmittance_min:g}; leave them out or change the compositor"
        )
    T, G, V = means.shape[0], means.shape[1], viewmats.shape[0]
    # quaternions and scales are not read where covariances are given
    images, alphas, _ = gsplat.rasterization(
        means,
        None,
        None,
        opacities.expand(T, G),
        sh.expand(T, *sh.shape),
        viewmats.expand(T, V, 4, 4),
        Ks.expand(T, V, 3, 3),
        settings.width,
        settings.height,
        near_plane=NEAR_PLANE,
        eps2d=settings.eps2d,
        sh_degree=math.isqrt(sh.shape[1]) - 1,
        packed=False,
        backgrounds=background.expand(T, V, 3),
        covars=(covars + covars.mT) / 2,
    )
    return images, alphas[..., 0]
