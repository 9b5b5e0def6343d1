"""An object from photographs alone, without a board, metres or a floor: poses, masks, Gaussians, and a closed surface.

    python -m benchmarks.photographs PHOTOS OUT                       # a folder of photographs; everything goes to OUT
    python -m benchmarks.photographs PHOTOS OUT --set '{"photographs": {"agreement": 1}}'

Says how well held-out photographs are shown, with exposures and without, and what the surface is. The longest side of
the object becomes 0.3 m in the middle of the simulator's box. Poses and mattes that lie in OUT already are taken from
there. OUT/held_out.png has held-out photographs, the Gaussians and the surface from there, side by side.
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path

import numpy as np
import torch
import trimesh

from neuma_lib.capture.agreement import LEAST_AGREEMENT, agreement
from neuma_lib.capture.folder import PHOTOGRAPHS
from neuma_lib.capture.mattes import write_mattes
from neuma_lib.capture.photograph_masks import photograph_mask
from neuma_lib.capture.pictures import group_of, picture_sheet, read_picture, undistorted
from neuma_lib.capture.poses import Poses, find_poses, load_poses, save_poses
from neuma_lib.capture.redrawn_masks import redrawn_masks
from neuma_lib.capture.saliency import Saliency, fetch_network
from neuma_lib.config.loading import load, merged, read_yaml
from neuma_lib.config.settings import Config
from neuma_lib.fitting.gaussians import GaussianFitReport, fit_gaussians
from neuma_lib.geometry.surface import photographed, reconstruct
from neuma_lib.geometry.visual_hull import visual_hull
from neuma_lib.geometry.volume import sample_volume
from neuma_lib.io.gaussians import save_gaussians
from neuma_lib.io.images import OPENGL_TO_OPENCV
from neuma_lib.io.mesh import write_mesh
from neuma_lib.io.photographs import StaticViews, load_static
from neuma_lib.splatting.cameras import Cameras
from neuma_lib.splatting.gaussians import Gaussians
from neuma_lib.splatting.rasterizer import rasterize

SIDE, MIDDLE = 0.3, (0.5, 0.5, 0.5)
"""Longest side of the object in the simulator's box, and its place there [m]."""
MOST_SHOWN = 6
"""Held-out photographs in the picture."""


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("photographs", type=Path, help="folder of photographs")
    parser.add_argument("out", type=Path, help="folder of what is made")
    parser.add_argument("--longest", type=int, default=1000, help="longer side of undistorted pictures [px]")
    parser.add_argument("--set", default="{}", help="changes of the settings, as JSON")
    args = parser.parse_args()
    torch.set_num_threads(1)
    settings = load(merged(read_yaml("config/config.yaml"), json.loads(args.set)))
    args.out.mkdir(parents=True, exist_ok=True)
    transforms = args.out / "mattes/transforms.json"
    if not transforms.is_file():
        make_mattes(transforms, args.photographs, args.longest, settings)
    views = load_static(transforms, settings.photographs)
    heights = [image.shape[:2] for image in views.images]
    print(f"{len(heights)} mattes of {len(set(heights))} sizes, at most {np.max(heights)} px")
    print(f"left out: {', '.join(views.left_out) or 'none'}")
    for rate in (0.0, settings.photographs.gain_rate):
        begun = time.process_time()
        gaussians, report = fit_gaussians(
            views.images, views.cameras, settings.gaussians, settings.seed, None, views.floor, rate
        )
        print(
            f"{'exposures' if rate else 'alike    '}: {report.count} Gaussians, {time.process_time() - begun:.0f} s,"
            f" PSNR inside the object {report.train_psnr_object:.2f} dB, of {len(report.held_out)} held-out"
            f" photographs {report.psnr_object:.2f} dB (cut-out over white {report.psnr:.2f} dB)"
        )
    spread = np.log(report.gains).std(axis=0)
    print(f"exposures vary by {', '.join(f'{100 * s:.1f} %' for s in spread)} in red, green, blue")
    begun = time.process_time()
    mesh = reconstruct(gaussians, views.cameras, views.images, settings.geometry.surface, views.floor)
    body = photographed(mesh, settings.photographs.edge, views.floor)
    points = sample_volume(body, settings.simulation.particles, settings.seed)
    print(
        f"surface: {len(mesh.faces)} faces, {1e3 * mesh.volume:.3f} l; repaired: {len(body.faces)} faces, edges of"
        f" {1e3 * np.median(body.edges_unique_length):.1f} mm, {1e3 * body.volume:.3f} l, {len(points)} particles,"
        f" {time.process_time() - begun:.0f} s"
    )
    save_gaussians(args.out / "gaussians.ply", gaussians)
    write_mesh(args.out / "mesh.ply", body.vertices, body.faces)
    draw(args.out / "held_out.png", views, gaussians, report, body)


def make_mattes(transforms: Path, folder: Path, longest: int, settings: Config) -> None:
    """Poses and masks of photographs, and those that agree as mattes in the simulator's box."""
    out = transforms.parent.parent
    poses = _poses(out, folder, settings.seed)
    network = Saliency(fetch_network(out))
    pixels, masks, lenses = [], [], [lens.pinhole().resized(longest) for lens in poses.lenses]
    begun = time.process_time()
    for name, lens in zip(poses.names, poses.lenses):
        pixels.append(undistorted(read_picture(folder / Path(name).name), lens, longest))
        masks.append(photograph_mask(pixels[-1], network, name))
    Ks = np.stack([lens.K for lens in lenses])
    first = (agreement(masks, poses.viewmats, Ks) >= LEAST_AGREEMENT).sum()
    masks = redrawn_masks(pixels, masks, poses.viewmats, Ks)
    agreed = agreement(masks, poses.viewmats, Ks)
    chosen = np.flatnonzero(agreed >= LEAST_AGREEMENT)
    print(
        f"{first} of {len(masks)} first masks agree, {len(chosen)} of those drawn anew (IoU"
        f" {agreed[chosen].min():.2f} to {agreed[chosen].max():.2f}, {time.process_time() - begun:.0f} s)"
    )
    box = _placed(poses.viewmats[chosen], [lenses[i] for i in chosen], [masks[i] for i in chosen], settings)
    frames = []
    for i, viewmat in zip(chosen, box):
        pose = (np.linalg.inv(viewmat) @ OPENGL_TO_OPENCV).tolist()
        frame = {"file_path": f"{Path(poses.names[i]).stem}.png", "transform_matrix": pose}
        frames.append(({**frame, **lenses[i].intrinsics()}, pixels[i], masks[i]))
    write_mattes(transforms, frames, {"photographs": {"floor": None}})


def _poses(out: Path, folder: Path, seed: int) -> Poses:
    files = out / "poses.json", out / "points.ply"
    if not files[0].is_file():
        pictures = sorted(
            p for p in folder.iterdir() if p.suffix.lower() in (".jpg", ".jpeg", ".png", ".webp")
        )
        poses = find_poses({PHOTOGRAPHS: pictures}, PHOTOGRAPHS, out / "colmap", seed=seed)
        save_poses(*files, poses)
    poses = load_poses(*files)
    assert all(group_of(name) == PHOTOGRAPHS for name in poses.names)
    print(f"{len(poses.names)} photographs have a place, reprojection error {poses.error:.2f} px")
    return poses


def _placed(viewmats: np.ndarray, lenses: list, masks: list, settings: Config) -> np.ndarray:
    """World to camera with the object in the middle of the box, up being the mean of what is up in the pictures."""
    up = -viewmats[:, 1, :3].mean(axis=0)
    up /= np.linalg.norm(up)
    across = np.cross(up, np.eye(3)[np.abs(up).argmin()])
    across /= np.linalg.norm(across)
    turn = np.stack([across, up, np.cross(across, up)])
    cameras = [
        Cameras(torch.from_numpy(viewmat)[None], torch.from_numpy(lens.K)[None], lens.width, lens.height)
        for viewmat, lens in zip(viewmats, lenses)
    ]
    alphas = [torch.from_numpy(mask.astype(np.float64)) for mask in masks]
    hull = visual_hull(alphas, cameras, 48, spare=len(cameras) // 10)
    cells = hull.occupied.nonzero().double()
    points = (hull.origin + (cells + 0.5) * hull.voxel).numpy() @ turn.T
    scale = SIDE / float(np.ptp(points, axis=0).max())
    middle = 0.5 * (points.min(axis=0) + points.max(axis=0))
    found = []
    for viewmat in viewmats:  # x_box = scale (turn x - middle) + MIDDLE
        rotation = viewmat[:3, :3] @ turn.T
        shift = scale * (viewmat[:3, 3] + rotation @ middle) - rotation @ np.array(MIDDLE)
        found.append(np.block([[rotation, shift[:, None]], [np.zeros((1, 3)), np.ones((1, 1))]]))
    return np.stack(found)


def draw(
    path: Path, views: StaticViews, gaussians: Gaussians, report: GaussianFitReport, body: trimesh.Trimesh
) -> None:
    """Held-out photographs beside the Gaussians and the surface, seen from there."""
    shown = []
    for view in report.held_out[:MOST_SHOWN]:
        rgba = views.images[view].numpy()
        photograph = rgba[..., :3] * rgba[..., 3:] + 1 - rgba[..., 3:]
        columns = [photograph, *(_seen(g, views.cameras[view]) for g in (gaussians, _shaded(body)))]
        label = f"view {view}, gains {', '.join(f'{g:.2f}' for g in report.gains[view])}"
        joined = np.concatenate(columns, axis=1).clip(0, 1)
        shown.append((label, (255 * joined).round().astype(np.uint8)))
    picture_sheet(path, shown, "held-out photograph, Gaussians (mean exposure), surface", 2)


def _seen(gaussians: Gaussians, camera: Cameras) -> np.ndarray:
    pictures, _ = rasterize(
        gaussians.means[None], gaussians.covars()[None], gaussians.opacities, gaussians.sh(), camera.viewmats,
        camera.Ks, camera.width, camera.height, eps2d=0.0,
    )  # fmt: skip
    return pictures[0, 0].numpy()


def _shaded(body: trimesh.Trimesh) -> Gaussians:
    """A small Gaussian on each face of a finer mesh, grey by the direction of its normal."""
    fine = body.subdivide()
    normals = torch.from_numpy(fine.face_normals.copy()).float()
    light = torch.nn.functional.normalize(torch.tensor([0.5, 1.0, 0.7]), dim=0)
    grey = 0.2 + 0.35 * (1 + normals @ light)
    count, size = len(normals), 0.5 * float(np.sqrt(fine.area_faces.mean()))
    return Gaussians(
        means=torch.from_numpy(fine.triangles_center.copy()).float(),
        quats=torch.tensor([1.0, 0, 0, 0]).expand(count, 4),
        scales=torch.full((count, 3), size),
        opacities=torch.full((count,), 0.99),
        sh0=((grey - 0.5) / 0.28209479)[:, None, None].expand(-1, 1, 3).contiguous(),
        shN=torch.zeros(count, 0, 3),
    )


if __name__ == "__main__":
    main()
