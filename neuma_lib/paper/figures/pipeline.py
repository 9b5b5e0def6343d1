"""Intermediate results of one scene in all stages: Gaussians (shrunk for visibility), surface and particles from the
views at the start; particles in the colours of the Gaussians bound to them; the simulation with the learned law; its
render, the observation, and their difference, which training reduces. Paper: fig:structure.
"""

import dataclasses

import matplotlib
import numpy as np
import torch
import trimesh
from matplotlib.figure import Figure
from matplotlib.patches import FancyArrowPatch
from PIL import Image
from torch import Tensor

from neuma_lib.coupling.reconstruction import Reconstruction
from neuma_lib.evaluation.plotting import rendering, style
from neuma_lib.io.images import load_views
from neuma_lib.io.laws import load_law
from neuma_lib.io.mesh import read_mesh
from neuma_lib.io.particles import load_motion
from neuma_lib.mechanics.law import Law
from neuma_lib.paper.image_grid import ImageGrid, draw_images, note
from neuma_lib.splatting.cameras import Cameras
from neuma_lib.splatting.gaussians import Gaussians
from neuma_lib.splatting.observation import over_white
from neuma_lib.splatting.rasterizer import rasterize
from neuma_lib.splatting.spherical_harmonics import rgb_to_sh0, sh0_to_rgb

LEFT, RIGHT, HEAD, TITLES = 0.8, 0.42, 0.2, 0.16
SHOWN = 5  # number of pictures of each stage
_SHRINK, _OPAQUE = 0.45, 0.8
"""Scale of the Gaussians, and their minimum opacity, in the picture that shows each of them."""
_LIGHT = np.array([-0.45, 0.75, 0.5]) / np.linalg.norm([-0.45, 0.75, 0.5])
"""Direction to the light in the world (y up, the frontal camera at +z)."""
_AMBIENT = 0.35  # brightness of a face without light
_NEUTRAL = np.array([0.72, 0.75, 0.80])  # colour of objects without one
_THICKNESS = 1e-8  # variance of the splats of the surface normal to their faces [m^2]
_STRONGEST = 0.95  # quantile of the stresses at the end of the colour map


def data(inputs, params, log) -> ImageGrid:
    """Rows: initial state, simulation, rendering, observation, difference.

    Numbers: ``first``, titles of the pictures of the first row; ``heads``, the step before each row.
    """
    video, body, cameras = rendering.film(inputs, params, 0, params.scene["density"])
    law = load_law(inputs.prior[0], inputs.adaptor[0])
    third = len(video.frames) // 3  # before it, the body only falls
    picked = [third + i for i in rendering.evenly(SHOWN, len(video.frames) - third)]
    x, F = (state[picked] for state in load_motion(inputs.rollout))

    seen = rendering.observed(video, picked, params.magnify)
    rendered = rendering.renders(body, cameras, x, F)
    stressed, strongest = _stressed_particles(law, body, x, F, cameras)
    start = [_gaussians(body.gaussians, cameras), _surface(read_mesh(inputs.mesh), cameras)]
    for colors in (_NEUTRAL, _carried_colors(body)):
        radius = rendering.sphere_radius(body.vol0)
        start.append(rendering.particle_pictures(body.x0[None], colors, radius, cameras)[0])
    motion = np.stack([stressed, rendered, seen, _difference(rendered, seen)])
    still, motion = rendering.cropped([np.stack(start), motion])
    views, _ = load_views(inputs.static, list(range(4)))
    first = np.concatenate([_montage(rendering.as_bytes(over_white(views)), *still.shape[1:3])[None], still])
    rows = ("I\ninitial\nstate", "II\nsimulation", "III\nrendering", "\nobservation", "\ndifference")
    numbers = {
        "first": ["views at the start", "Gaussians", "surface", "particles", "binding"],
        "heads": [
            f"{params.views} views → Gaussians, surface, particles; each Gaussian is bound to the particles inside it",
            f"material point method with M = M₀ + ΔM; colour: von Mises stress, 0 to {1e-3 * strongest:.0f} kPa",
            "particles carry Gaussians, Gaussians are splatted",
            "one video",
            "squared and summed: the loss",
        ],
    }
    columns = tuple(rendering.milliseconds([video.frames[i] for i in picked], params.scene["dt"]))
    images = np.concatenate([first[None], motion])
    log(f"{images.shape[0]} x {images.shape[1]} pictures")
    return ImageGrid(images, rows, columns, numbers)


def _montage(images: np.ndarray, height: int, width: int) -> np.ndarray:
    """Join four pictures (4, H, W, 3) to one (height, width, 3) on white."""
    (images,) = rendering.cropped([images], margin=0.0)
    both = np.concatenate([np.concatenate(list(images[i : i + 2]), axis=1) for i in (0, 2)], axis=0)
    factor = min(height / both.shape[0], width / both.shape[1])
    inner = round(both.shape[1] * factor), round(both.shape[0] * factor)
    page = Image.new("RGB", (width, height), "white")
    page.paste(
        Image.fromarray(both).resize(inner, Image.LANCZOS), ((width - inner[0]) // 2, height - inner[1])
    )
    return np.asarray(page)


def _gaussians(gaussians: Gaussians, cameras: Cameras) -> np.ndarray:
    """The Gaussians, shrunk to be distinguishable: uint8 (H, W, 3)."""
    small = dataclasses.replace(gaussians, scales=_SHRINK * gaussians.scales)
    return _splat(small.means, small.covars(), small.opacities.clamp(min=_OPAQUE), small.sh(), cameras)


def _surface(mesh: trimesh.Trimesh, cameras: Cameras) -> np.ndarray:
    """A mesh in grey, as flat splats on its faces: uint8 (H, W, 3)."""
    edges = torch.tensor(mesh.triangles - mesh.triangles_center[:, None], dtype=torch.float32)
    covars = edges.mT @ edges / 2 + _THICKNESS * torch.eye(3)
    light = _AMBIENT + (1 - _AMBIENT) * np.clip(mesh.face_normals @ _LIGHT, 0, None)
    colors = torch.from_numpy(light[:, None] * _NEUTRAL).float()
    means = torch.tensor(mesh.triangles_center, dtype=torch.float32)
    return _splat(means, covars, torch.full((len(means),), 0.99), rgb_to_sh0(colors)[:, None], cameras)


def _splat(means: Tensor, covars: Tensor, opacities: Tensor, sh: Tensor, cameras: Cameras) -> np.ndarray:
    with torch.no_grad():
        images, _ = rasterize(
            means[None], covars[None], opacities, sh, cameras.viewmats, cameras.Ks, cameras.width, cameras.height,
            background=(1.0, 1.0, 1.0), eps2d=0.0,
        )  # fmt: skip
    return rendering.as_bytes(images[0, 0])


def _carried_colors(body: Reconstruction) -> np.ndarray:
    """Mean view-independent colours (N, 3) of the Gaussians that particles carry, grey for particles without."""
    colors = sh0_to_rgb(body.gaussians.sh0[:, 0]).clamp(0, 1)
    binding, count = body.binding, len(body.x0)
    rows = torch.repeat_interleave(torch.arange(len(colors)), binding.counts)
    weighted = binding.values[:, None] * colors[rows]
    total = torch.zeros(count, 3).index_add_(0, binding.indices, weighted)
    weight = torch.zeros(count).index_add_(0, binding.indices, binding.values)[:, None]
    neutral = torch.tensor(_NEUTRAL).float()
    return torch.where(weight > 0, total / weight.clamp(min=1e-9), neutral).numpy()


def _stressed_particles(
    law: Law, body: Reconstruction, x: Tensor, F: Tensor, cameras: Cameras
) -> tuple[np.ndarray, float]:
    """Particles coloured by their von Mises stress under a law at states x (T, N, 3), F (T, N, 3, 3).

    Returns:
        uint8 pictures (T, H, W, 3), and the stress at the end of the colour map [Pa], the quantile `_STRONGEST` of the
        states after the first.
    """
    weights = tuple(w.detach() for w in law.elasticity.weights())
    with torch.no_grad():
        tau = law.elasticity.evaluate(F.reshape(-1, 3, 3), weights)
    tau = 0.5 * (tau + tau.mT)
    mean = tau.diagonal(dim1=1, dim2=2).mean(1)
    deviator = tau - mean[:, None, None] * torch.eye(3)
    stress = (1.5 * deviator.square().sum((1, 2))).sqrt().reshape(x.shape[:2]).numpy()
    strongest = float(np.quantile(stress[1:], _STRONGEST))
    colors = matplotlib.colormaps[style.RAMP](0.1 + 0.9 * np.clip(stress / strongest, 0, 1))[..., :3]
    radius = rendering.sphere_radius(body.vol0)
    pictures = [
        rendering.particle_pictures(state[None], c, radius, cameras)[0] for state, c in zip(x, colors)
    ]
    return np.stack(pictures), strongest


def _difference(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Absolute difference of uint8 pictures, from white (none) to black."""
    largest = np.abs(a.astype(np.int16) - b.astype(np.int16)).max(-1, keepdims=True)
    return 255 - largest.repeat(3, -1).astype(np.uint8)


@style.styled
def draw(grid: ImageGrid) -> Figure:
    """A row for each stage, arrows between them, and the path of the gradient."""
    numbers = grid.numbers
    count = len(grid.columns)
    width = style.PAGE - LEFT - RIGHT
    height = grid.height(width)
    figure = style.new_canvas(style.PAGE, len(grid.rows) * (height + HEAD) + 2 * TITLES + 0.05)
    middles, top = [], 0.0
    for i, row in enumerate(grid.rows):
        titles = numbers["first"] if i == 0 else grid.columns if i == 1 else ()
        note(figure, LEFT + width / 2, top + 0.1, numbers["heads"][i], ha="center", color=style.BLUE)
        top += HEAD + (TITLES if titles else 0)
        draw_images(figure, grid.images[i : i + 1], LEFT, top, width, (), titles)
        stage, _, text = row.partition("\n")
        note(figure, 0.03, top + height / 2, f"$\\bf{{{stage}}}$\n{text}", linespacing=1.4, fontsize=6.5)
        middles.append(top + height / 2)
        top += height
    for j in range(1, count):
        x = LEFT + j * width / count
        for row in (0, 1):
            _arrow(figure, (x - 0.09, middles[row]), (x + 0.09, middles[row]))
    x = LEFT + width + 0.03
    _arrow(figure, (x, middles[-1]), (x, middles[1]), color=style.VERMILION, bend=0.06)
    note(
        figure, style.PAGE - 0.08, (middles[-1] + middles[1]) / 2, "gradient to the adaptor ΔM",
        rotation=90, ha="center", color=style.VERMILION,
    )  # fmt: skip
    return figure


def _arrow(figure: Figure, start, end, color: str = style.GREY, bend: float = 0.0) -> None:
    """Draw an arrow between two points, in inches from the upper left corner."""
    width, height = figure.get_size_inches()
    ends = [(x / width, 1 - y / height) for x, y in (start, end)]
    look = {"arrowstyle": "-|>", "mutation_scale": 7, "color": color, "linewidth": 1.0, "zorder": 5}
    curve = f"arc3,rad={bend}"
    figure.add_artist(FancyArrowPatch(*ends, connectionstyle=curve, transform=figure.transFigure, **look))
