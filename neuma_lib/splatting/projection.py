"""EWA projection of 3D Gaussians to splats (Warp kernels with hand-written adjoint).

Conventions are those of gsplat: camera z forward, pixel centres at half integers, a blur of ``eps2d`` pixel^2 added to
the projected covariance, the tangents x/z and y/z of the Jacobian limited to 30 % beyond the image, colour
max(0, 1/2 + SH) along the direction from the camera to the mean, depth = camera z.

A splat is a record of ``SPLAT_SIZE`` numbers, in three aligned groups of four: mean (2) [px], conic A, B, C [1/px^2]
(the exponent is -(A dx^2 + C dy^2)/2 - B dx dy), opacity, RGB, and the ellipse A dx^2 + 2 B dx dy + C dy^2 <= reach
where alpha can reach alpha_min: reach, and half the width and height of its bounding box [px]. The last three have no
gradients.
"""

import functools

import torch
import warp as wp

from neuma_lib.device import launch, start_warp
from neuma_lib.splatting.records import SPLAT_SIZE, functions
from neuma_lib.splatting.spherical_harmonics import SH_C0, SH_C1, SH_C2, SH_C3

start_warp()

NEAR_PLANE = 0.01  # depth [m] below which a Gaussian is culled
REACH_SLACK = 0.02
"""Added to the reach so that round-off excludes no pixel; the compositors test alpha itself."""
UNLIMITED = 1.0e20  # reach for alpha_min = 0
CULLED = 1.0e30  # depth of Gaussians that are invisible in an image


def for_device(sh: torch.Tensor) -> torch.Tensor:
    """The same harmonics (G, K, 3), on CUDA with coefficients as the slowest index in memory, for coalesced reads."""
    return sh.transpose(0, 1).contiguous().transpose(0, 1) if sh.is_cuda else sh.contiguous()


def project(means, covars, opacities, sh, viewmats, Ks, settings, empty) -> tuple[torch.Tensor, torch.Tensor]:
    """Splats (T V, G, SPLAT_SIZE) and depths (T V, G) of T frames in V cameras; image t V + v.

    Arguments as for ``rasterizer.rasterize``, ``settings`` and ``empty`` as in ``compositing``. The record of a culled
    Gaussian (depth ``CULLED``) is undefined.
    """
    shape = (len(means) * len(viewmats), means.shape[1])
    splats, depths = empty("splats", (*shape, SPLAT_SIZE), means), empty("depths", shape, means)
    kernel, _, _ = kernels(means.dtype)
    launch(
        kernel, shape, means, covars, opacities, sh, viewmats, Ks, settings.width, settings.height, settings.eps2d,
        settings.alpha_min, splats, depths,
    )  # fmt: skip
    return splats, depths


def geometry_adjoint(
    means, covars, sh, viewmats, Ks, settings, splats, depths, grad_splats
) -> tuple[torch.Tensor, torch.Tensor]:
    """Gradients of means (T, G, 3) and covariances (T, G, 3, 3) from those of the splats."""
    grad_means, grad_covars = torch.empty_like(means), torch.empty_like(covars)
    _, kernel, _ = kernels(means.dtype)
    launch(
        kernel, means.shape[:2], means, covars, sh, viewmats, Ks, settings.width, settings.height, splats, depths,
        grad_splats, grad_means, grad_covars,
    )  # fmt: skip
    return grad_means, grad_covars


def appearance_adjoint(means, sh, viewmats, splats, depths, grad_splats) -> tuple[torch.Tensor, torch.Tensor]:
    """Gradients of opacities (G,) and harmonics (G, K, 3) from those of the splats, summed over all images."""
    grad_opacities, grad_sh = means.new_empty(len(sh)), torch.empty_like(sh)
    _, _, kernel = kernels(means.dtype)
    launch(kernel, len(sh), means, viewmats, splats, depths, grad_splats, grad_opacities, grad_sh)
    return grad_opacities, grad_sh


@functools.cache
def kernels(dtype: torch.dtype):
    """``(project, geometry_adjoint, appearance_adjoint)`` kernels of a dtype.

    The adjoint has two parts, because training a material needs the first one only. It has a thread per Gaussian and
    frame. In the second, a thread sums over all images of a Gaussian, without atomics. Loops over harmonics have a
    constant length, so that they are unrolled and coefficients stay in registers.
    """
    real = wp.dtype_from_torch(dtype)
    vec3 = wp.types.vector(3, real)
    vec16 = wp.types.vector(16, real)
    mat33 = wp.types.matrix((3, 3), real)
    mat44 = wp.types.matrix((4, 4), real)
    mat23 = wp.types.matrix((2, 3), real)
    mat22 = wp.types.matrix((2, 2), real)
    mat316 = wp.types.matrix((3, 16), real)
    module = wp.get_module(f"{__name__}.{str(dtype).removeprefix('torch.')}")

    _, store = functions(dtype)
    zero, half, one, two, three, four, six, eight = (real(v) for v in (0, 0.5, 1, 2, 3, 4, 6, 8))
    tangent_margin = real(0.3)
    near = real(NEAR_PLANE)
    reach_slack, unlimited = real(REACH_SLACK), real(UNLIMITED)
    culled = real(CULLED)
    c0, c1 = real(SH_C0), real(SH_C1)
    c2a, c2b, c2c = (real(v) for v in SH_C2)
    c3a, c3b, c3c, c3d, c3e = (real(v) for v in SH_C3)

    @wp.func(module=module)
    def sh_values(d: vec3, count: int):
        x, y, z = d[0], d[1], d[2]
        v = vec16()
        v[0] = c0
        if count > 1:
            v[1] = -c1 * y
            v[2] = c1 * z
            v[3] = -c1 * x
        if count > 4:
            v[4] = c2a * x * y
            v[5] = -c2a * y * z
            v[6] = c2b * (two * z * z - x * x - y * y)
            v[7] = -c2a * x * z
            v[8] = c2c * (x * x - y * y)
        if count > 9:
            v[9] = -c3a * y * (three * x * x - y * y)
            v[10] = c3b * x * y * z
            v[11] = -c3c * y * (four * z * z - x * x - y * y)
            v[12] = c3d * z * (two * z * z - three * x * x - three * y * y)
            v[13] = -c3c * x * (four * z * z - x * x - y * y)
            v[14] = c3e * z * (x * x - y * y)
            v[15] = -c3a * x * (x * x - three * y * y)
        return v

    @wp.func(module=module)
    def sh_gradients(d: vec3, count: int):
        # row i: derivative of the harmonics with respect to component i of the direction
        x, y, z = d[0], d[1], d[2]
        g = mat316()
        if count > 1:
            g[1, 1] = -c1
            g[2, 2] = c1
            g[0, 3] = -c1
        if count > 4:
            g[0, 4] = c2a * y
            g[1, 4] = c2a * x
            g[1, 5] = -c2a * z
            g[2, 5] = -c2a * y
            g[0, 6] = -two * c2b * x
            g[1, 6] = -two * c2b * y
            g[2, 6] = four * c2b * z
            g[0, 7] = -c2a * z
            g[2, 7] = -c2a * x
            g[0, 8] = two * c2c * x
            g[1, 8] = -two * c2c * y
        if count > 9:
            g[0, 9] = -six * c3a * x * y
            g[1, 9] = -three * c3a * (x * x - y * y)
            g[0, 10] = c3b * y * z
            g[1, 10] = c3b * x * z
            g[2, 10] = c3b * x * y
            g[0, 11] = two * c3c * x * y
            g[1, 11] = -c3c * (four * z * z - x * x - three * y * y)
            g[2, 11] = -eight * c3c * y * z
            g[0, 12] = -six * c3d * x * z
            g[1, 12] = -six * c3d * y * z
            g[2, 12] = three * c3d * (two * z * z - x * x - y * y)
            g[0, 13] = -c3c * (four * z * z - three * x * x - y * y)
            g[1, 13] = two * c3c * x * y
            g[2, 13] = -eight * c3c * x * z
            g[0, 14] = two * c3e * x * z
            g[1, 14] = -two * c3e * y * z
            g[2, 14] = c3e * (x * x - y * y)
            g[0, 15] = -three * c3a * (x * x - y * y)
            g[1, 15] = six * c3a * x * y
        return g

    @wp.func(module=module)
    def rotation_of(viewmat: mat44):
        return mat33(
            viewmat[0, 0], viewmat[0, 1], viewmat[0, 2],
            viewmat[1, 0], viewmat[1, 1], viewmat[1, 2],
            viewmat[2, 0], viewmat[2, 1], viewmat[2, 2],
        )  # fmt: skip

    @wp.func(module=module)
    def translation_of(viewmat: mat44):
        return vec3(viewmat[0, 3], viewmat[1, 3], viewmat[2, 3])

    @wp.func(module=module)
    def limited_tangent(tangent: real, focal: real, centre: real, extent: real):
        margin = tangent_margin * half * extent / focal
        return wp.clamp(tangent, -(centre / focal + margin), (extent - centre) / focal + margin)

    @wp.func(module=module)
    def symmetric(m: mat33):
        return half * (m + wp.transpose(m))

    @wp.func(module=module)
    def colour_gradient(
        splats: wp.array3d(dtype=real), grad_splats: wp.array3d(dtype=real), image: int, g: int
    ):
        # zero where the colour is clamped to zero
        grad = vec3()
        for i in range(3):
            if splats[image, g, 6 + i] > zero:
                grad[i] = grad_splats[image, g, 6 + i]
        return grad

    @wp.kernel(module=module, enable_backward=False)
    def project(
        means: wp.array2d(dtype=vec3),  # (T, G)
        covars: wp.array2d(dtype=mat33),  # (T, G)
        opacities: wp.array(dtype=real),  # (G,)
        sh: wp.array2d(dtype=vec3),  # (G, K)
        viewmats: wp.array(dtype=mat44),  # (V,)
        Ks: wp.array(dtype=mat33),  # (V,)
        width: real,
        height: real,
        eps2d: real,
        alpha_min: real,
        splats: wp.array3d(dtype=real),  # (T V, G, SPLAT_SIZE), out
        depths: wp.array2d(dtype=real),  # (T V, G), out
    ):
        image, g = wp.tid()
        views = viewmats.shape[0]
        t = image // views
        v = image - t * views
        rotation = rotation_of(viewmats[v])
        translation = translation_of(viewmats[v])
        intrinsics = Ks[v]
        fx, fy, cx, cy = intrinsics[0, 0], intrinsics[1, 1], intrinsics[0, 2], intrinsics[1, 2]
        mean = means[t, g]
        opacity = opacities[g]

        p = rotation * mean + translation
        depths[image, g] = culled
        if p[2] < near or opacity < alpha_min or opacity <= zero:
            return
        rz = one / p[2]
        u = limited_tangent(p[0] * rz, fx, cx, width)
        w = limited_tangent(p[1] * rz, fy, cy, height)
        jacobian = mat23(fx * rz, zero, -fx * u * rz, zero, fy * rz, -fy * w * rz)
        m = jacobian * rotation
        cov = m * symmetric(covars[t, g]) * wp.transpose(m)
        a = cov[0, 0] + eps2d
        b = half * (cov[0, 1] + cov[1, 0])
        c = cov[1, 1] + eps2d
        det = a * c - b * b
        if not (det > zero):  # or NaN
            return
        mean_x = fx * p[0] * rz + cx
        mean_y = fy * p[1] * rz + cy
        reach = unlimited
        if alpha_min > zero:
            # exact bounding box of the region where opacity * exp(-sigma) >= alpha_min
            reach = two * wp.log(opacity / alpha_min)
            reach_x = wp.sqrt(reach * a)
            reach_y = wp.sqrt(reach * c)
            if (
                mean_x + reach_x < zero
                or mean_x - reach_x > width
                or mean_y + reach_y < zero
                or mean_y - reach_y > height
            ):
                return
        inv = one / det

        count = sh.shape[1]
        direction = wp.normalize(mean + wp.transpose(rotation) * translation)
        values = sh_values(direction, count)
        colour = vec3(half, half, half)
        for k in range(16):
            if k < count:
                colour += values[k] * sh[g, k]

        depths[image, g] = p[2]
        red, green, blue = wp.max(colour[0], zero), wp.max(colour[1], zero), wp.max(colour[2], zero)
        reach += reach_slack
        store(splats, image, g, 0, mean_x, mean_y, c * inv, -b * inv)
        store(splats, image, g, 1, a * inv, opacity, red, green)
        store(splats, image, g, 2, blue, reach, wp.sqrt(reach * a), wp.sqrt(reach * c))

    @wp.kernel(module=module, enable_backward=False)
    def geometry_adjoint(
        means: wp.array2d(dtype=vec3),  # (T, G)
        covars: wp.array2d(dtype=mat33),  # (T, G)
        sh: wp.array2d(dtype=vec3),  # (G, K)
        viewmats: wp.array(dtype=mat44),  # (V,)
        Ks: wp.array(dtype=mat33),  # (V,)
        width: real,
        height: real,
        splats: wp.array3d(dtype=real),  # (T V, G, SPLAT_SIZE)
        depths: wp.array2d(dtype=real),  # (T V, G)
        grad_splats: wp.array3d(dtype=real),  # (T V, G, SPLAT_SIZE)
        grad_means: wp.array2d(dtype=vec3),  # (T, G), out
        grad_covars: wp.array2d(dtype=mat33),  # (T, G), out
    ):
        t, g = wp.tid()
        views = viewmats.shape[0]
        count = sh.shape[1]
        mean = means[t, g]
        covar = symmetric(covars[t, g])
        grad_mean = vec3()
        grad_covar = mat33()
        for v in range(views):
            image = t * views + v
            if depths[image, g] < culled:
                rotation = rotation_of(viewmats[v])
                translation = translation_of(viewmats[v])
                intrinsics = Ks[v]
                fx, fy, cx, cy = intrinsics[0, 0], intrinsics[1, 1], intrinsics[0, 2], intrinsics[1, 2]
                p = rotation * mean + translation
                rz = one / p[2]
                tan_x = p[0] * rz
                tan_y = p[1] * rz
                u = limited_tangent(tan_x, fx, cx, width)
                w = limited_tangent(tan_y, fy, cy, height)
                jacobian = mat23(fx * rz, zero, -fx * u * rz, zero, fy * rz, -fy * w * rz)
                m = jacobian * rotation

                # conic = cov^-1, so d cov = - conic (d conic) conic with B counted twice in the exponent
                conic = mat22(
                    splats[image, g, 2], splats[image, g, 3], splats[image, g, 3], splats[image, g, 4]
                )
                g_conic = mat22(
                    grad_splats[image, g, 2],
                    half * grad_splats[image, g, 3],
                    half * grad_splats[image, g, 3],
                    grad_splats[image, g, 4],
                )
                g_cov = -conic * g_conic * conic
                grad_covar += wp.transpose(m) * g_cov * m
                g_jacobian = two * g_cov * m * covar * wp.transpose(rotation)

                g_x = grad_splats[image, g, 0] * fx * rz
                g_y = grad_splats[image, g, 1] * fy * rz
                g_z = -(g_x * tan_x + g_y * tan_y)
                g_z -= rz * rz * (fx * g_jacobian[0, 0] + fy * g_jacobian[1, 1])
                # third column of the Jacobian: -f (x/z) / z, with constant x/z where it is clamped
                g_u = -fx * rz * g_jacobian[0, 2]
                g_w = -fy * rz * g_jacobian[1, 2]
                g_z -= rz * (u * g_u + w * g_w)
                if u == tan_x:
                    g_x += g_u * rz
                    g_z -= g_u * tan_x * rz
                if w == tan_y:
                    g_y += g_w * rz
                    g_z -= g_w * tan_y * rz
                grad_mean += wp.transpose(rotation) * vec3(g_x, g_y, g_z)

                if count > 1:
                    ray = mean + wp.transpose(rotation) * translation
                    length = wp.length(ray)
                    direction = ray / length
                    slopes = sh_gradients(direction, count)
                    g_colour = colour_gradient(splats, grad_splats, image, g)
                    g_direction = vec3()
                    for k in range(1, 16):
                        if k < count:
                            weight = wp.dot(sh[g, k], g_colour)
                            for i in range(3):
                                g_direction[i] += slopes[i, k] * weight
                    grad_mean += (g_direction - direction * wp.dot(direction, g_direction)) / length
        grad_means[t, g] = grad_mean
        grad_covars[t, g] = grad_covar

    @wp.kernel(module=module, enable_backward=False)
    def appearance_adjoint(
        means: wp.array2d(dtype=vec3),  # (T, G)
        viewmats: wp.array(dtype=mat44),  # (V,)
        splats: wp.array3d(dtype=real),  # (T V, G, SPLAT_SIZE)
        depths: wp.array2d(dtype=real),  # (T V, G)
        grad_splats: wp.array3d(dtype=real),  # (T V, G, SPLAT_SIZE)
        grad_opacities: wp.array(dtype=real),  # (G,), out
        grad_sh: wp.array2d(dtype=vec3),  # (G, K), out
    ):
        g = wp.tid()
        views = viewmats.shape[0]
        count = grad_sh.shape[1]
        grad_opacity = zero
        grad_harmonics = mat316()
        for t in range(means.shape[0]):
            for v in range(views):
                image = t * views + v
                if depths[image, g] < culled:
                    grad_opacity += grad_splats[image, g, 5]
                    g_colour = colour_gradient(splats, grad_splats, image, g)
                    ray = means[t, g] + wp.transpose(rotation_of(viewmats[v])) * translation_of(viewmats[v])
                    values = sh_values(wp.normalize(ray), count)
                    for k in range(16):
                        if k < count:
                            for i in range(3):
                                grad_harmonics[i, k] += values[k] * g_colour[i]
        grad_opacities[g] = grad_opacity
        for k in range(16):
            if k < count:
                grad_sh[g, k] = vec3(grad_harmonics[0, k], grad_harmonics[1, k], grad_harmonics[2, k])

    return project, geometry_adjoint, appearance_adjoint
