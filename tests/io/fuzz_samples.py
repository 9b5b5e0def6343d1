"""Valid small files of every kind that the library reads, and their readers, for `tests.io.fuzz`."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import torch
from PIL import Image

from neuma_lib.capture import released
from neuma_lib.capture.calibration import poses
from neuma_lib.capture.frames import read_timeline
from neuma_lib.capture.motion.timing import read_sound
from neuma_lib.capture.pictures import copy_pictures, read_picture
from neuma_lib.config.photographs import PhotographsConfig
from neuma_lib.coupling.initial_motion import InitialMotion
from neuma_lib.evaluation.lpips import read_plain_pickle
from neuma_lib.io.checkpoint import Checkpoint
from neuma_lib.io.compressed_splats import save_compressed
from neuma_lib.io.datasets.layouts import take_video
from neuma_lib.io.exported import about_law, read_about
from neuma_lib.io.files import read_json, write_json
from neuma_lib.io.gaussians import load_gaussians, save_gaussians
from neuma_lib.io.hdf5 import read_arrays, write_arrays
from neuma_lib.io.images import load_videos, read_image_set
from neuma_lib.io.laws import load_law, load_prior, save_adaptor, save_law, save_prior
from neuma_lib.io.mesh import read_mesh, write_mesh
from neuma_lib.io.particles import (
    load_initial_state,
    load_motion,
    load_reconstruction,
    save_binding,
    save_particles,
)
from neuma_lib.io.photographs import load_static
from neuma_lib.io.positions import read_positions
from neuma_lib.io.splats import load_splat
from neuma_lib.io.weights import read_torch, read_weights
from neuma_lib.mechanics.analytic import analytic_law
from neuma_lib.mechanics.neural import neural_law
from neuma_lib.mechanics.structured import structured_law
from neuma_lib.methods.constants import Constants
from neuma_lib.methods.pac_nerf.field import RadianceField
from neuma_lib.methods.pac_nerf.io import load_field, save_field
from neuma_lib.methods.pac_nerf.lattice import Lattice
from neuma_lib.methods.pac_nerf.rendering import Opacity
from neuma_lib.methods.spring_gaus.body import SpringBody
from neuma_lib.methods.spring_gaus.io import load_springs, save_springs
from neuma_lib.methods.spring_gaus.network import Springs
from neuma_lib.paper.image_grid import ImageGrid, load_image_grid, save_image_grid
from neuma_lib.project.capture_folder import read_settings
from neuma_lib.project.loading import load, read_yaml
from neuma_lib.project.released_captures import sequence
from neuma_lib.project.timings import timings_table
from neuma_lib.viewer.scene import nearest_binding, true_motion
from tests.io.fuzz import Reader, gunzip, header_of, pickle_of, regzip, with_header, with_pickle
from tests.support.films import ffmpeg, film
from tests.support.image_layouts import write_pac_nerf, write_spring_gaus
from tests.support.splat_files import ball, write_splat, write_spz

ROOT = Path(__file__).resolve().parents[2]
LAW = {
    "elasticity": {"name": "hencky", "E": 1e5, "nu": 0.3},
    "plasticity": {"name": "von_mises", "yield_stress": 1e3},
}


def readers(folder: Path) -> list[Reader]:
    """All readers, each with its own folder."""
    torch.set_num_threads(1)
    made: list[Reader] = []

    def add(name: str, write, read, **options) -> None:
        place = folder / str(len(made))
        place.mkdir()
        path = write(place)
        made.append(Reader(name, read, path, **options))

    for group in (_hdf5, _weights, _splats, _json, _pictures, _films, _others):
        group(add)
    return made


def _hdf5(add) -> None:
    rng = np.random.default_rng(0)

    def truth(folder: Path) -> Path:
        arrays = {
            "x": rng.random((3, 9, 3), np.float32),
            "v": rng.random((3, 9, 3), np.float32),
            "F": np.tile(np.eye(3, dtype=np.float32), (3, 9, 1, 1)),
            "frames": np.arange(3),
            "time": np.arange(3.0),
            "vol0": np.ones(9, np.float32),
            "mass": np.ones(9, np.float32),
            "tracers": rng.random((3, 4, 3), np.float32),
        }
        about = {"dt": 1e-3, "bodies": [{"law": LAW}], "simulation": {"dt": 1e-3}}
        write_arrays(folder / "truth.h5", arrays, about)
        return folder / "truth.h5"

    def body(folder: Path) -> Path:
        gaussians, x = ball(count=20), torch.from_numpy(rng.random((30, 3), np.float32))
        save_gaussians(folder / "gaussians.ply", gaussians)
        save_particles(folder / "particles.h5", x, torch.ones(30), {"added": 0})
        save_binding(folder / "binding.h5", nearest_binding(gaussians.means.double(), x.double()))
        motion = {"v0": [0.0, -1.0, 0.0], "angular_velocity": [0.0] * 3, "centre": [0.5] * 3}
        write_json(folder / "velocity.json", {**motion, "frames": [0, 1], "camera_axes": np.eye(3).tolist()})
        return folder / "binding.h5"

    def read_body(path: Path) -> None:
        names = ("particles.h5", "binding.h5", "gaussians.ply")
        made = load_reconstruction(*(path.with_name(name) for name in names), 1000.0)
        binding = made.binding
        assert len(binding.indptr) == 21 and len(made.vol0) == len(made.x0) == binding.shape[1]
        assert binding.indices.min() >= 0 and binding.indices.max() < len(made.x0)
        assert binding.counts.min() >= 0 and len(binding.values) == len(binding.indices) == binding.indptr[-1]

    def read_start(path: Path) -> None:
        names = ("particles.h5", "binding.h5", "gaussians.ply", "velocity.json")
        state, _ = load_initial_state(*(path.with_name(name) for name in names), [1000.0])
        assert state.x.shape == state.v.shape and state.v.isfinite().all()
        InitialMotion.of(read_json(path.with_name("velocity.json")))

    def particles(folder: Path) -> Path:
        return body(folder).with_name("particles.h5")

    def velocity(folder: Path) -> Path:
        return body(folder).with_name("velocity.json")

    def pictures(folder: Path) -> Path:
        grid = ImageGrid(rng.integers(0, 255, (1, 2, 4, 5, 3)).astype(np.uint8), ("a",), ("b", "c"), {})
        save_image_grid(folder / "figure.h5", grid)
        return folder / "figure.h5"

    def in_viewer(path: Path) -> None:
        names = ("particles.h5", "binding.h5", "gaussians.ply")
        true_motion(path, load_reconstruction(*(path.with_name(name) for name in names), 1.0), 1e-3)

    def shown(folder: Path) -> Path:
        body(folder)
        return truth(folder)

    def predicted(folder: Path) -> Path:
        np.savez(folder / "positions.npz", x=rng.random((3, 9, 3)), frames=np.arange(3))
        return folder / "positions.npz"

    add("positions.npz", predicted, lambda path: read_positions([path]))
    add("truth.h5", truth, lambda path: read_arrays(path, required=("x", "F")))
    add("rollout.h5", truth, load_motion)
    add("binding.h5", body, read_body)
    add("particles.h5", particles, read_body)
    add("velocity.json", velocity, read_start, is_text=True)
    add("truth.h5 (viewer)", shown, in_viewer, is_slow=True)
    add("figure.h5", pictures, load_image_grid)


def _weights(add) -> None:
    def prior(folder: Path) -> Path:
        save_prior(folder / "prior.safetensors", neural_law(seed=0), {"scene": "a"})
        return folder / "prior.safetensors"

    def adaptor(folder: Path) -> Path:
        law = structured_law(LAW, 1e-3, seed=0)
        law.attach_adaptor(4, 4.0, 0)
        save_adaptor(folder / "adaptor.safetensors", law, 4, 4.0, {"stable": True})
        return folder / "adaptor.safetensors"

    def exported(folder: Path) -> Path:
        law = analytic_law(LAW)
        save_law(folder / "law.safetensors", law, about_law(law, 1e-3))
        return folder / "law.safetensors"

    def read_exported(path: Path) -> None:
        read_about(path)
        load_law(path)

    def field(folder: Path) -> Path:
        lattice = Lattice((0.0, 0.0, 0.0), 0.1, (3, 4, 3))
        save_field(folder / "field.safetensors", RadianceField(lattice, Opacity(1e-4, 0.1)), {"seed": 0})
        return folder / "field.safetensors"

    def springs(folder: Path) -> Path:
        x = torch.rand(30, 3, generator=torch.Generator().manual_seed(0))
        body = SpringBody.of(x, 12, 4, 2, 0.5, 4)
        save_springs(folder / "springs.safetensors", body, Springs(body.network, 1.0, 1.0), {"stable": True})
        return folder / "springs.safetensors"

    def read_springs(path: Path) -> None:
        index, springs, _ = load_springs(path, torch.zeros(1))
        assert index.min() >= 0 and 0 <= springs.network.neighbours.min()
        assert springs.network.neighbours.max() < len(springs.network.anchors)

    def released(folder: Path) -> Path:
        parts: dict = {"elasticity": {}, "plasticity": {}}
        for name, value in neural_law(seed=0).prior_state().items():
            part, _, key = name.partition(".")
            parts[part][key] = value.clone()
        torch.save(parts, folder / "released.pt")
        return folder / "released.pt"

    def checkpoint(folder: Path) -> Path:
        layer = torch.nn.Linear(3, 2)
        optimizer = torch.optim.Adam(layer.parameters())
        layer(torch.ones(3)).sum().backward()
        optimizer.step()
        state = {
            "weights": layer.state_dict(),
            "optimizer": optimizer.state_dict(),
            "losses": [0.5],
            "best": None,
        }
        Checkpoint(folder / "state.pt", {"commit": "a"}).save(state)
        return folder / "state.pt"

    def read_checkpoint(path: Path) -> None:
        read_torch(path)
        Checkpoint(path, {"commit": "a"}).load()

    json_header = {"unpack": header_of, "pack": with_header}
    pickled = {"unpack": pickle_of, "pack": with_pickle}
    add("weights.safetensors", prior, read_weights, **json_header)
    add("prior.safetensors", prior, load_prior, **json_header)
    add("adaptor.safetensors", adaptor, lambda path: load_law(None, path), **json_header)
    add("law.safetensors", exported, read_exported, **json_header)
    add("field.safetensors", field, load_field, **json_header)
    add("springs.safetensors", springs, read_springs, **json_header)
    add("released.pt", released, load_prior, **pickled)
    add("state.pt", checkpoint, read_checkpoint, **pickled)


def _splats(add) -> None:
    def written(name: str, write):
        def make(folder: Path) -> Path:
            write(folder / name, ball(count=40, degree=1))
            return folder / name

        return make

    def cube(folder: Path, text: bool = False) -> Path:
        corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], float)
        faces = [[0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1]]
        faces += [[2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3]]
        write_mesh(folder / "mesh.ply", corners, np.array(faces))
        if text:
            rows = [" ".join(map(str, c)) for c in corners] + [f"3 {' '.join(map(str, f))}" for f in faces]
            header = (folder / "mesh.ply").read_bytes().partition(b"end_header\n")[0].decode()
            header = header.replace("binary_little_endian", "ascii")
            (folder / "mesh.ply").write_text(header + "end_header\n" + "\n".join(rows) + "\n")
        return folder / "mesh.ply"

    def read_solid(path: Path) -> None:
        mesh = read_mesh(path)
        assert mesh.faces.min() >= 0 and mesh.faces.max() < len(mesh.vertices)

    def check(gaussians) -> None:
        assert len(gaussians) and (gaussians.scales > 0).all()
        assert all(value.isfinite().all() for value in vars(gaussians).values())

    add("gaussians.ply", written("a.ply", save_gaussians), lambda path: check(load_gaussians(path)))
    add("splat.ply", written("a.ply", save_compressed), lambda path: check(load_splat(path)))
    add("splat.splat", written("a.splat", write_splat), lambda path: check(load_splat(path)))
    spz = written("a.spz", lambda path, g: write_spz(path, g, degree=1))
    add("splat.spz", spz, lambda path: check(load_splat(path)), unpack=gunzip, pack=regzip)
    add("mesh.ply", cube, read_solid)
    add("mesh.ply (ASCII)", lambda folder: cube(folder, text=True), read_solid)


def _json(add) -> None:
    def identified(folder: Path) -> Path:
        fit = {
            "law": LAW,
            "constants": {"E": {"value": 1e5, "log_std": 0.1}},
            "unbounded": {"values": [0.0] * 3, "covariance": np.eye(3).tolist()},
        }
        content = {"family": "a", "ties": ["b"], "law": LAW, "best": fit, "families": {"a": fit, "b": fit}}
        write_json(folder / "identified.json", content)
        return folder / "identified.json"

    def read_identified(path: Path) -> None:
        Constants().load({"identified": path}, {}, 1e-3)

    def saved_poses(folder: Path) -> Path:
        lens = {"fl_x": 20.0, "fl_y": 20.0, "cx": 8.0, "cy": 6.0, "w": 16, "h": 12}
        picture = {"name": "photographs/a.png", "world_to_camera": np.eye(4).tolist(), "lens": lens}
        content = {"reprojection_error_px": 0.5, "lost": [], "unsure": {}, "pictures": [picture]}
        write_json(folder / "poses.json", content)
        write_json(folder / "lenses.json", {"left": lens})
        rows = np.zeros(
            2, [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("red", "u1"), ("green", "u1"), ("blue", "u1")]
        )
        from neuma_lib.io.ply import write_ply

        write_ply(folder / "points.ply", rows)
        return folder / "poses.json"

    def read_poses(path: Path) -> None:
        poses.load_poses(path.with_name("poses.json"), path.with_name("points.ply"))

    def lenses(folder: Path) -> Path:
        return saved_poses(folder).with_name("lenses.json")

    def points(folder: Path) -> Path:
        return saved_poses(folder).with_name("points.ply")

    def calibration(folder: Path) -> Path:
        write_json(folder / "cameras_calib.json", {"a": {"rvecs": [0.1, 0, 0], "tvecs": [[0], [0], [1]]}})
        return folder / "cameras_calib.json"

    def frames(folder: Path) -> Path:
        place = folder / "dynamic/sequences/bun"
        place.mkdir(parents=True)
        write_json(place / "0.json", {"hit_frame": 3, "a": ["0.png"], "b": ["0.png"]})
        return place / "0.json"

    add("identified.json", identified, read_identified, is_text=True)
    add("poses.json", saved_poses, read_poses, is_text=True)
    add("points.ply", points, read_poses)
    add("lenses.json", lenses, poses.read_lenses, is_text=True)
    add("cameras_calib.json", calibration, released._poses, is_text=True)
    add("0.json (frames)", frames, lambda path: sequence(path.parents[3], "bun"), is_text=True)


def _pictures(add) -> None:
    rng = np.random.default_rng(0)

    def matte(path: Path) -> None:
        pixels = rng.integers(0, 255, (12, 16, 4)).astype(np.uint8)
        pixels[..., 3] = 0
        pixels[3:9, 4:12, 3] = 255
        Image.fromarray(pixels).save(path)

    def image_set(folder: Path, **more) -> Path:
        frames = []
        for k in range(4):
            matte(folder / f"{k}.png")
            frames.append(
                {"file_path": f"{k}.png", "transform_matrix": np.eye(4).tolist(), "view": 0, "step": k}
            )
        write_json(
            folder / "transforms.json", {"fl_x": 20.0, "cx": 8.0, "w": 16, "h": 12, "frames": frames, **more}
        )
        return folder / "transforms.json"

    def mattes(folder: Path) -> Path:
        return image_set(folder, photographs={"floor": 0.0})

    def matte_file(folder: Path) -> Path:
        return image_set(folder).with_name("1.png")

    def read_set(path: Path) -> None:
        path = path.with_name("transforms.json")
        read_image_set(path)
        load_videos(path, [0])

    def photograph(suffix: str):
        def make(folder: Path) -> Path:
            exif = Image.Exif()
            exif[0x0112] = 6
            image = Image.fromarray(rng.integers(0, 255, (24, 32, 3)).astype(np.uint8))
            image.save(folder / f"a{suffix}", exif=exif)
            return folder / f"a{suffix}"

        return make

    def read_photograph(path: Path) -> None:
        read_picture(path)
        copy_pictures({"photographs/a": path}, path.parent / "copy")

    def pac_nerf(folder: Path) -> Path:
        write_pac_nerf(folder, cameras=2, frames=2)
        return folder / "all_data.json"

    def spring_gaus(folder: Path) -> Path:
        write_spring_gaus(folder, cameras=2, frames=2)
        return folder / "camera.json"

    def take(path: Path) -> None:
        take_video(path, path.parent / "taken/transforms.json", [0, 10], 10)

    add("transforms.json", image_set, read_set, is_text=True)
    add(
        "transforms.json (photographs)",
        mattes,
        lambda p: load_static(p, PhotographsConfig(lacking=1.0)),
        is_text=True,
    )
    add("matte.png", matte_file, read_set)
    for suffix in (".png", ".jpg", ".webp"):
        add(f"photograph{suffix}", photograph(suffix), read_photograph)
    add("all_data.json", pac_nerf, take, is_text=True)
    add("camera.json", spring_gaus, take, is_text=True)


def _films(add) -> None:
    def short(folder: Path) -> Path:
        return film(folder / "a.mp4", [3000 * k for k in range(4)])

    def sound(folder: Path) -> Path:
        ffmpeg("-f", "lavfi", "-i", "sine=d=0.2", folder / "a.wav")
        return folder / "a.wav"

    add("film.mp4", short, read_timeline, is_slow=True)
    add("sound.wav", sound, read_sound, is_slow=True)


def _others(add) -> None:
    def capture(folder: Path) -> Path:
        (folder / "capture.yaml").write_text("board: {square: 0.03}\ndensity: 1000\n")
        return folder / "capture.yaml"

    def settings(folder: Path) -> Path:
        (folder / "config.yaml").write_bytes((ROOT / "config/config.yaml").read_bytes())
        return folder / "config.yaml"

    def cameras(folder: Path) -> Path:
        (folder / "cameras.bin").write_bytes(struct.pack("<QIiQQ4d", 1, 7, 1, 64, 48, 50.0, 50.0, 32.0, 24.0))
        return folder / "cameras.bin"

    def images(folder: Path) -> Path:
        row = struct.pack("<I7dI", 1, 1.0, 0, 0, 0, 0, 0, 1.0, 7) + b"a.png\0" + struct.pack("<Q", 0)
        (folder / "images.bin").write_bytes(struct.pack("<Q", 2) + row + row)
        return folder / "images.bin"

    def benchmark(folder: Path) -> Path:
        (folder / "benchmarks").mkdir()
        (folder / "benchmarks/train.tsv").write_text("s\tmax_rss\tcpu_time\n12.5\t300.0\t9.0\n")
        return folder / "benchmarks/train.tsv"

    def pickled(folder: Path) -> Path:
        import pickle

        (folder / "a.ckpt").write_bytes(pickle.dumps({"a": {"b": np.ones((2, 3), np.float32)}}))
        return folder / "a.ckpt"

    add("capture.yaml", capture, read_settings)
    add("config.yaml", settings, lambda path: load(read_yaml(path), ROOT), is_slow=True)
    add("cameras.bin", cameras, released.read_cameras)
    add("images.bin", images, released.read_images)
    add("benchmark.tsv", benchmark, lambda path: timings_table(path.parents[1]))
    add("lpips.ckpt", pickled, lambda path: read_plain_pickle(path.read_bytes(), str(path)))
