"""Time of the rasterizer by stage: milliseconds per image, for each selected compositor.

    python -m benchmarks.rasterizer                                # CPU: 2,000 Gaussians, 2 frames at 96 px
    python -m benchmarks.rasterizer --device cuda                  # 20,000 Gaussians, 40 frames at 800 px
    python -m benchmarks.rasterizer --device cuda --frames 1 --views 50 --appearance
    python -m benchmarks.rasterizer --device cuda --compositors tiles gsplat --tiles 16x2 16x4 8x2 32x2

The Gaussians fill a ball of 0.15 m radius. They are 2 to 4 mm wide, with opacities from 0.1 to 0.95. Cameras are 1.6 m
away, where the ball covers three eighths of the image's width. A stage runs several times without synchronisation, as
in training, measured by the clock of the device. The last rows compare one image with that of the CPU in float64.
"""

import math
import time
from collections.abc import Callable

import torch

from benchmarks import gsplat_backend
from benchmarks.timing import parser_of
from neuma_lib.splatting import compositor_cuda, projection
from neuma_lib.splatting.cameras import Cameras, look_at
from neuma_lib.splatting.compositing import Settings
from neuma_lib.splatting.gaussians import covariances
from neuma_lib.splatting.rasterizer import COMPOSITORS, rasterize

RADIUS = 0.15  # m
DISTANCE = 1.6  # m
BACKGROUND = (1.0, 1.0, 1.0)
STAGES = ("projection", "lists", "blend", "blend adjoint", "geometry adjoint", "appearance adjoint")
WHOLE = ("forward", "backward", "both", "entries", "memory [GB]", "mean error", "off by 1/255 [%]")


def ball(
    gaussians: int, frames: int, views: int, pixels: int, device: torch.device
) -> tuple[list[torch.Tensor], Cameras]:
    """means (T, G, 3), covars (T, G, 3, 3), opacities (G,) and sh (G, 16, 3) of a falling ball, and its cameras."""
    generator = torch.Generator().manual_seed(0)

    def uniform(*shape):
        return torch.rand(*shape, generator=generator)

    directions = torch.nn.functional.normalize(torch.randn(gaussians, 3, generator=generator), dim=-1)
    rest = RADIUS * uniform(gaussians, 1) ** (1 / 3) * directions
    fall = torch.linspace(0.1, -0.1, frames)[:, None] * torch.tensor([0.0, 1.0, 0.0])
    quats = torch.randn(gaussians, 4, generator=generator)
    covars = covariances(torch.nn.functional.normalize(quats, dim=-1), 0.002 + 0.002 * uniform(gaussians, 3))
    sh = 0.2 * torch.randn(gaussians, 16, 3, generator=generator)
    inputs = [rest + fall[:, None], covars.repeat(frames, 1, 1, 1), 0.1 + 0.85 * uniform(gaussians), sh]
    angles = 2 * math.pi * torch.arange(views) / views
    eyes = DISTANCE * torch.stack([angles.sin(), torch.full_like(angles, 0.2), angles.cos()], dim=-1)
    focal = 0.375 * pixels * DISTANCE / (2 * RADIUS)
    K = torch.tensor([[focal, 0, pixels / 2], [0, focal, pixels / 2], [0, 0, 1]])
    viewmats = look_at(eyes, torch.zeros(3), torch.tensor([0.0, 1.0, 0.0]))
    cameras = Cameras(viewmats, K.repeat(views, 1, 1), pixels, pixels).to(device)
    return [value.to(device) for value in inputs], cameras


def milliseconds(work: Callable[[], object], device: torch.device, repetitions: int) -> float:
    """Time of one of ``repetitions`` runs in a row, after two that are not counted."""
    for _ in range(2):
        work()
    if device.type == "cuda":
        start, end = (torch.cuda.Event(enable_timing=True) for _ in range(2))
        torch.cuda.synchronize()
        start.record()
        for _ in range(repetitions):
            work()
        end.record()
        end.synchronize()
        return start.elapsed_time(end) / repetitions
    begin = time.perf_counter()
    for _ in range(repetitions):
        work()
    return 1e3 * (time.perf_counter() - begin) / repetitions


def stages(name: str, inputs, cameras: Cameras, repetitions: int) -> dict[str, float]:
    """Milliseconds per call of the stages of one of our compositors."""
    means, covars, opacities, sh = inputs
    sh = projection.for_device(sh)
    settings = Settings(cameras.width, cameras.height, 1 / 255, 0.99, 1e-4, 0.3)
    background = torch.tensor(BACKGROUND, device=means.device)
    compositor = COMPOSITORS[name]

    def empty(_, shape, like, dtype=None):
        return torch.empty(shape, dtype=dtype or like.dtype, device=like.device)

    def project():
        return projection.project(means, covars, opacities, sh, cameras.viewmats, cameras.Ks, settings, empty)

    splats, depths = project()
    pictures, alphas, kept = compositor.composite(splats, depths, background, settings, empty)
    grad_pictures, grad_alphas = torch.randn_like(pictures), torch.randn_like(alphas)
    grad_splats = torch.empty_like(splats)

    def lists():
        return compositor_cuda.lists(splats, depths, settings.width, settings.height, compositor_cuda.TILE)

    def blend():
        return compositor.composite(splats, depths, background, settings, empty)

    def blend_adjoint():
        compositor.composite_adjoint(
            splats, kept, background, settings, grad_pictures, grad_alphas, grad_splats, empty
        )

    def geometry_adjoint():
        projection.geometry_adjoint(
            means, covars, sh, cameras.viewmats, cameras.Ks, settings, splats, depths, grad_splats
        )

    def appearance_adjoint():
        projection.appearance_adjoint(means, sh, cameras.viewmats, splats, depths, grad_splats)

    work = dict(zip(STAGES, (project, lists, blend, blend_adjoint, geometry_adjoint, appearance_adjoint)))
    if name != "tiles":
        del work["lists"]
    times = {stage: milliseconds(run, means.device, repetitions) for stage, run in work.items()}
    if name == "tiles":
        times["blend"] -= times["lists"]
        times["entries"] = len(kept[0])
    return times


def whole(
    name: str, inputs, cameras: Cameras, appearance: bool, repetitions: int
) -> tuple[dict[str, float], torch.Tensor]:
    """Milliseconds per call through autograd, memory, and the first image."""
    leaves = [value.clone().requires_grad_(index < 2 or appearance) for index, value in enumerate(inputs)]
    trained = [leaf for leaf in leaves if leaf.requires_grad]
    device = inputs[0].device

    def forward():
        scene = (*leaves, cameras.viewmats, cameras.Ks, cameras.width, cameras.height)
        if name == "gsplat":
            return gsplat_backend.rasterize(*scene, background=BACKGROUND)[0]
        return rasterize(*scene, background=BACKGROUND, compositor=name)[0]

    images = forward()
    weights, first = torch.randn_like(images), images[0, 0].detach().clone()
    del images
    if device.type == "cuda":
        torch.cuda.reset_peak_memory_stats()
        before = torch.cuda.memory_allocated()
    ahead = milliseconds(forward, device, repetitions)
    both = milliseconds(lambda: torch.autograd.grad(forward(), trained, weights), device, repetitions)
    result = {"forward": ahead, "backward": both - ahead, "both": both}
    if device.type == "cuda":
        result["memory [GB]"] = (torch.cuda.max_memory_allocated() - before) / 1e9
    return result, first


def reference(inputs, cameras: Cameras) -> torch.Tensor:
    """The first image, by the CPU in float64."""
    means, covars, opacities, sh = (value.double().cpu() for value in inputs)
    camera = cameras[0].to("cpu", torch.float64)
    image, _ = rasterize(
        means[:1], covars[:1], opacities, sh, camera.viewmats, camera.Ks, camera.width, camera.height,
        background=BACKGROUND,
    )  # fmt: skip
    return image[0, 0]


def main() -> None:
    parser = parser_of(__doc__)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--gaussians", type=int)
    parser.add_argument("--size", type=int, help="width and height [px]")
    parser.add_argument("--frames", type=int)
    parser.add_argument("--views", type=int, default=1)
    parser.add_argument("--appearance", action="store_true", help="also gradients of opacities and colours")
    parser.add_argument("--compositors", nargs="+", help="rows (CPU), tiles, gsplat (CUDA); default: ours")
    parser.add_argument(
        "--tiles",
        nargs="+",
        default=["16x2"],
        metavar="SIDExPIXELS",
        help="tile side [px] x pixels of a lane",
    )
    parser.add_argument("--repetitions", type=int, default=10)
    args = parser.parse_args()
    device = torch.device(args.device)
    small = device.type == "cpu"
    gaussians = args.gaussians or (2000 if small else 20_000)
    pixels = args.size or (96 if small else 800)
    frames = args.frames or (2 if small else 40)
    inputs, cameras = ball(gaussians, frames, args.views, pixels, device)
    count = frames * args.views
    truth = reference(inputs, cameras)

    columns: dict[str, dict[str, float]] = {}
    for name in args.compositors or ["rows" if small else "tiles"]:
        for shape in args.tiles if name == "tiles" else [""]:
            if shape:
                compositor_cuda.TILE, compositor_cuda.LANE_PIXELS = map(int, shape.split("x"))
            times = stages(name, inputs, cameras, args.repetitions) if name in COMPOSITORS else {}
            result, image = whole(name, inputs, cameras, args.appearance, args.repetitions)
            times |= result
            error = (image.double().cpu() - truth).abs()
            column = columns[f"{name} {shape}".strip()] = {
                key: value / count if key in (*STAGES, *WHOLE[:4]) else value for key, value in times.items()
            }
            column["mean error"] = float(error.mean())
            column["off by 1/255 [%]"] = 100 * float((error.amax(dim=-1) > 1 / 255).double().mean())

    print(
        f"{gaussians} Gaussians, {frames} frames x {args.views} views of {pixels} x {pixels} px, {device}; "
        f"gradients of means, covariances{', opacities, colours' * args.appearance}; milliseconds an image"
    )
    print(f"{'':22}" + "".join(f"{label:>14}" for label in columns))
    for row in (*STAGES, *WHOLE):
        cells = [f"{column[row]:14.4g}" if row in column else f"{'-':>14}" for column in columns.values()]
        if set(cells) != {f"{'-':>14}"}:
            print(f"{row:22}" + "".join(cells))


if __name__ == "__main__":
    main()
