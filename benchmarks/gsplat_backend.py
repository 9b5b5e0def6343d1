"""The rasterizer of the gsplat package (1.5.3), for comparison, on CUDA in float32.

Projection, colours, blur, near plane and depth order follow our conventions.
Constants in the kernels of gsplat:

- alpha below 1/255 is ignored, as by default here;
- alpha is limited to 0.999, here to 0.99 by default, so images of more opaque Gaussians differ;
- a pixel ends before its transmittance becomes <= 1e-4, here before < 1e-4;
- a splat ends 3.33 standard deviations from its centre, where an opacity of 1 gives 1/255.
"""

import math

import torch

from neuma_lib.splatting.projection import NEAR_PLANE


def rasterize(
    means, covars, opacities, sh, viewmats, Ks, width, height, background=(1.0, 1.0, 1.0), alpha_max=None
):
    """Images (T, V, H, W, 3) and alphas (T, V, H, W); arguments as of `neuma_lib.splatting.rasterizer.rasterize`.

    ``alpha_max`` has no effect (see above).
    """
    import gsplat  # no other benchmark needs it

    background = torch.as_tensor(background, dtype=means.dtype, device=means.device)
    T, G, V = means.shape[0], means.shape[1], viewmats.shape[0]
    # quaternions and scales are unused if covariances are given
    images, alphas, _ = gsplat.rasterization(
        means,
        None,
        None,
        opacities.expand(T, G),
        sh.expand(T, *sh.shape),
        viewmats.expand(T, V, 4, 4),
        Ks.expand(T, V, 3, 3),
        width,
        height,
        near_plane=NEAR_PLANE,
        eps2d=0.3,
        sh_degree=math.isqrt(sh.shape[1]) - 1,
        packed=False,
        backgrounds=background.expand(T, V, 3),
        covars=(covars + covars.mT) / 2,
    )
    return images, alphas[..., 0]
