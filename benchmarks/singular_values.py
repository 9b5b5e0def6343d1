"""Our SVD of 3x3 matrices against Warp's ``wp.svd3``: time, accuracy and gradients, side by side.

    python -m benchmarks.singular_values                           # 2,000 matrices on the CPU
    python -m benchmarks.singular_values --rows 30000 --device cuda

Errors are the largest over 2,000 matrices of a family, over the size of the matrix: of U diag(sigma) V^T, of U^T U and
V^T V, and of sigma against LAPACK in float64. Gradients are those of <W, R> + sum sigma^3 with a random W, ours in
closed form and Warp's by its own adjoint of ``svd3``; the error is that of their product with a random direction,
against central differences of LAPACK in float64, over the norms of both.
"""

import torch
import warp as wp

from benchmarks.timing import parser_of, seconds
from neuma_lib.device import start_warp, warp_stream
from neuma_lib.mechanics.singular_values import rotation_and_singular_values, svd3
from neuma_lib.mechanics.singular_values_kernels import warp_types

start_warp()

COUNT = 2000
STEP = 1e-6
"""Step of the central differences: truncation 1e-12 and rounding 1e-10, far below the differences measured here."""


@wp.kernel
def warp_svd(
    F: wp.array(dtype=wp.mat33f),
    U: wp.array(dtype=wp.mat33f),
    sigma: wp.array(dtype=wp.vec3f),
    V: wp.array(dtype=wp.mat33f),
):
    i = wp.tid()
    u, s, v = wp.svd3(F[i])
    U[i] = u
    sigma[i] = s
    V[i] = v


@wp.kernel
def warp_probe(F: wp.array(dtype=wp.mat33f), W: wp.array(dtype=wp.mat33f), loss: wp.array(dtype=float)):
    u, s, v = wp.svd3(F[wp.tid()])
    cubes = s[0] * s[0] * s[0] + s[1] * s[1] * s[1] + s[2] * s[2] * s[2]
    wp.atomic_add(loss, 0, wp.ddot(W[wp.tid()], u * wp.transpose(v)) + cubes)


def by_warp(F: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """U, sigma and V^T of F (n, 3, 3), float32."""
    U, sigma, V = torch.empty_like(F), F.new_empty(len(F), 3), torch.empty_like(F)
    _, vec3, mat33 = warp_types(F.dtype)
    arrays = [wp.from_torch(x, dtype=t) for x, t in ((F, mat33), (U, mat33), (sigma, vec3), (V, mat33))]
    wp.launch(warp_svd, dim=len(F), inputs=arrays, device=arrays[0].device, stream=warp_stream(F.device))
    return U, sigma, V.mT


def gradient_by_warp(F: torch.Tensor, W: torch.Tensor) -> torch.Tensor:
    leaf = wp.from_torch(F.clone(), dtype=wp.mat33f, requires_grad=True)
    weights = wp.from_torch(W, dtype=wp.mat33f)
    loss = wp.zeros(1, dtype=float, device=leaf.device, requires_grad=True)
    with wp.Tape() as tape:
        wp.launch(warp_probe, dim=len(F), inputs=[leaf, weights, loss], device=leaf.device)
    tape.backward(loss)
    return wp.to_torch(leaf.grad)


def gradient_by_ours(F: torch.Tensor, W: torch.Tensor) -> torch.Tensor:
    leaf = F.clone().requires_grad_()
    R, sigma = rotation_and_singular_values(leaf)
    return torch.autograd.grad((W * R).sum() + (sigma**3).sum(), leaf)[0]


def derivative(F: torch.Tensor, W: torch.Tensor, direction: torch.Tensor) -> torch.Tensor:
    """Derivatives (n,) of the probe along a direction, by differences in float64 on the CPU."""

    def probe(F):
        U, sigma, Vh = torch.linalg.svd(F)
        sign = torch.linalg.det(F).sign()
        last = torch.stack([torch.ones_like(sign), torch.ones_like(sign), sign], dim=-1)
        R = (U * last[:, None]) @ Vh
        return (W * R).sum((1, 2)) + ((sigma * last) ** 3).sum(1)

    return (probe(F + STEP * direction) - probe(F - STEP * direction)) / (2 * STEP)


def families() -> dict[str, torch.Tensor]:
    """Matrices (COUNT, 3, 3) by what is difficult in them, rounded to float32."""
    generator = torch.Generator().manual_seed(0)

    def noise():
        return torch.randn(COUNT, 3, 3, generator=generator, dtype=torch.float64)

    def stretched(*sigma):
        U, V = (torch.linalg.qr(noise())[0] for _ in range(2))
        U, V = (Q * torch.linalg.det(Q)[:, None, None] for Q in (U, V))
        return (U * torch.tensor(sigma, dtype=torch.float64)) @ V.mT

    eye = torch.eye(3, dtype=torch.float64).repeat(COUNT, 1, 1)
    matrices = {
        "F = I": eye,
        "I + 1e-5 noise": eye + 1e-5 * noise(),
        "I + 0.1 noise": eye + 0.1 * noise(),
        "sigma 2, 1, 1": stretched(2.0, 1.0, 1.0),
        "sigma 2, 1 + 1e-4, 1": stretched(2.0, 1.0 + 1e-4, 1.0),
        "det < 0: 1.5, 1, -0.5": stretched(1.5, 1.0, -0.5),
        "det < 0: 1, 1, -0.9": stretched(1.0, 1.0, -0.9),
        "flat: 1, 1e-2, 1e-5": stretched(1.0, 1e-2, 1e-5),
    }
    return {name: F.float() for name, F in matrices.items()}


def accuracy(F: torch.Tensor, U, sigma, Vh) -> list[float]:
    """Largest errors of the product, the orthonormality and sigma; the part with det U = det V = 1 and sigma sorted."""
    F, U, sigma, Vh = (x.double().cpu() for x in (F, U, sigma, Vh))
    size, eye = F.norm(dim=(1, 2)), torch.eye(3, dtype=torch.float64)
    product = ((U * sigma[:, None]) @ Vh - F).norm(dim=(1, 2)) / size
    square = max(float((Q @ Q.mT - eye).abs().max()) for Q in (U, Vh))
    values = (sigma.abs().sort(descending=True).values - torch.linalg.svdvals(F)).abs().amax(1) / size
    proper = (torch.linalg.det(U) > 0) & (torch.linalg.det(Vh) > 0)
    proper &= (sigma[:, 0] >= sigma[:, 1] - 1e-5) & (sigma[:, 1] >= sigma[:, 2].abs() - 1e-5)
    return [float(product.max()), square, float(values.max()), float(proper.double().mean())]


def main() -> None:
    parser = parser_of(__doc__)
    parser.add_argument("--rows", type=int, nargs="+", default=[COUNT])
    parser.add_argument("--repetitions", type=int, default=50)
    parser.add_argument("--device", default="cpu")
    args = parser.parse_args()
    device = torch.device(args.device)
    generator = torch.Generator().manual_seed(1)
    ways = {"ours": (svd3, gradient_by_ours), "Warp's": (by_warp, gradient_by_warp)}

    for rows in args.rows:
        F = (torch.eye(3) + 0.1 * torch.randn(rows, 3, 3, generator=generator)).to(device)
        for name, (svd, _) in ways.items():
            print(
                f"{rows} matrices, {name}: {1e6 * seconds(lambda s=svd, F=F: s(F), device, args.repetitions):.0f} us"
            )
    W, direction = (torch.randn(COUNT, 3, 3, generator=generator).double() for _ in range(2))
    print(f"{'family':24} {'':7} {'product':>9} {'U, V':>9} {'sigma':>9} {'proper':>7} {'gradient':>9}")
    for family, F in families().items():
        exact = derivative(F.double(), W, direction)
        for name, (svd, gradient) in ways.items():
            grad = gradient(F.to(device), W.float().to(device)).double().cpu()
            size = grad.norm(dim=(1, 2)) * direction.norm(dim=(1, 2)) + exact.abs()
            wrong = float((((grad * direction).sum((1, 2)) - exact).abs() / size).nan_to_num(torch.inf).max())
            *errors, proper = accuracy(F, *svd(F.to(device)))
            print(f"{family:24} {name:7}", *(f"{x:9.1e}" for x in errors), f"{proper:7.0%} {wrong:9.1e}")


if __name__ == "__main__":
    main()
