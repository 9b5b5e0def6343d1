"""A small drop of an ellipsoid in the layouts of Spring-Gaus' real captures and of NeuMA's copy."""

import json
import struct
from pathlib import Path

import numpy as np
from PIL import Image
from scipy.spatial.transform import Rotation

from neuma_lib.capture.calibration.lens import Lens
from neuma_lib.capture.released import CALIBRATED_SIZE, MIDDLE, RATE, video_lens
from neuma_lib.project.released_captures import GROUND
from tests.support.board_pictures import looking_at

OBJECT = "bun"
UNIT = 0.75  # metres to the files' unit
RADII = np.array([0.05, 0.04, 0.035])  # of the ellipsoid, in the files' unit
START = np.array([*MIDDLE, GROUND[OBJECT] - 0.127])  # it touches the ground in the frame CONTACT
VELOCITY = np.array([0.1, -0.05, 1.2])  # z is down
SPIN = Rotation.from_rotvec([0.4, 0.2, -0.3]).as_rotvec()
COUNT, CONTACT = 12, 7
SIZE = (96, 54)
FOCAL = (6000.0, 6010.0)  # of the photographs' camera at its full size
CAMERAS = ("C0733", "C0787", "C0801")
PHOTOGRAPHS = 10
STATIC_UNIT = 3.0  # the photographs' world to the files' unit
TURN = Rotation.from_rotvec([0.3, -1.0, 0.5])  # in which the object lies in the photographs


def motion(k):
    """Middle and turn in frame k: free fall, in metres, until the contact, where it stays."""
    t = min(k, CONTACT) / RATE
    return START + VELOCITY * t + np.array([0, 0, 9.81 / UNIT]) * t * t / 2, Rotation.from_rotvec(SPIN * t)


def drawn(viewmat, lens, middle, turn, radii=RADII):
    """Picture (H, W, 3) and mask (H, W) of the ellipsoid before grey."""
    x, y = np.meshgrid(np.arange(lens.width) + 0.5, np.arange(lens.height) + 0.5)
    K = lens.K
    rays = np.stack([(x - K[0, 2]) / K[0, 0], (y - K[1, 2]) / K[1, 1], np.ones_like(x)], axis=-1)
    rays = rays.reshape(-1, 3)
    eye, rays = -viewmat[:3, :3].T @ viewmat[:3, 3], rays @ viewmat[:3, :3]
    at, rays = turn.inv().apply(eye - middle) / radii, turn.inv().apply(rays) / radii
    a, b, c = (rays**2).sum(axis=1), rays @ at, at @ at - 1
    hit = b * b - a * c > 0
    body = at + ((-b[hit] - np.sqrt((b * b - a * c)[hit])) / a[hit])[:, None] * rays[hit]
    pixels = np.full((lens.height * lens.width, 3), 90, np.uint8)
    grain = np.sin(4 * body[:, 0] + 1) * np.sin(5 * body[:, 1]) * np.sin(3 * body[:, 2] + 2)
    pixels[hit] = np.clip((205, 95, 50) * (1 + 0.35 * grain[:, None]), 0, 255)
    return pixels.reshape(lens.height, lens.width, 3), hit.reshape(lens.height, lens.width)


def full_lens():
    return Lens(
        *CALIBRATED_SIZE, np.array([[FOCAL[0], 0, 2376.0], [0, FOCAL[1], 1336.0], [0, 0, 1]]), np.zeros(5)
    )


def poses():
    """World to camera of each video camera."""
    target = START + (0, 0, 0.1)
    angles = dict(zip(CAMERAS, (0.2, 1.6, 2.9)))
    return {
        name: looking_at(START + (0.7 * np.cos(a), 0.7 * np.sin(a), -0.15), target, up=(0.0, 0.0, -1.0))
        for name, a in angles.items()
    }


def calibration(names):
    entries = {}
    for name, viewmat in zip(names, poses().values()):
        turn = Rotation.from_matrix(viewmat[:3, :3]).as_rotvec()
        entries[name] = {
            "rvecs": [[v] for v in turn.tolist()],
            "tvecs": [[v] for v in viewmat[:3, 3].tolist()],
        }
    return entries


def write_picture(folder, name, pixels, mask, suffix=".jpg", mask_folder=None):
    for path in (folder, mask_folder):
        path.mkdir(parents=True, exist_ok=True)
    Image.fromarray(pixels).save(folder / f"{name}{suffix}", quality=98)
    Image.fromarray(255 * mask.astype(np.uint8)).save(mask_folder / f"{name}.png")


def write_cameras(path):
    path.parent.mkdir(parents=True, exist_ok=True)
    lens = full_lens()
    values = (*FOCAL, *lens.K[:2, 2])
    path.write_bytes(struct.pack("<QIiQQ4d", 1, 7, 1, *CALIBRATED_SIZE, *values))


def static_poses():
    """World to camera of the photographs, in their own world, whose y is down."""
    angles = np.linspace(0, 2 * np.pi, PHOTOGRAPHS, endpoint=False)
    rings = [0.25 if k % 2 else -0.3 for k in range(PHOTOGRAPHS)]
    eyes = [STATIC_UNIT * np.array([0.5 * np.cos(a), h, 0.5 * np.sin(a)]) for a, h in zip(angles, rings)]
    return [looking_at(eye, (0.0, 0.0, 0.0), up=(0.0, -1.0, 0.0)) for eye in eyes]


def write_spring_gaus(root):
    """``real_capture`` with one object."""
    root = Path(root)
    lens = video_lens(full_lens(), SIZE)
    names = [f"{k:05d}.jpg" for k in range(COUNT)]
    for camera, viewmat in poses().items():
        for k in range(COUNT):
            seen = drawn(viewmat, lens, *motion(k))
            folders = (root / f"dynamic/videos_images/{camera}", root / f"dynamic/videos_masks/{camera}")
            write_picture(folders[0], f"{k:05d}", *seen, mask_folder=folders[1])
    (root / f"dynamic/sequences/{OBJECT}").mkdir(parents=True)
    listed = {"hit_frame": CONTACT, **dict.fromkeys(CAMERAS, names)}
    (root / f"dynamic/sequences/{OBJECT}/0.json").write_text(json.dumps(listed))
    (root / "dynamic/cameras_calib.json").write_text(json.dumps(calibration(CAMERAS)))
    colmap = root / f"static/colmap/{OBJECT}"
    write_cameras(colmap / "cameras.bin")
    content = struct.pack("<Q", PHOTOGRAPHS)
    small = Lens(*SIZE, np.diag([SIZE[0] / CALIBRATED_SIZE[0], SIZE[1] / CALIBRATED_SIZE[1], 1]) @ full_lens().K,
                 np.zeros(5))  # fmt: skip
    for k, viewmat in enumerate(static_poses()):
        x, y, z, w = Rotation.from_matrix(viewmat[:3, :3]).as_quat()
        content += struct.pack("<I7dI", k + 1, w, x, y, z, *viewmat[:3, 3], 7)
        content += f"DSC{k:03d}.JPG".encode() + b"\0" + struct.pack("<Q2dQ", 1, 1.0, 2.0, 3)
        pixels, mask = drawn(viewmat, small, np.zeros(3), TURN, STATIC_UNIT * RADII)
        large = np.asarray(Image.fromarray(pixels).resize((2 * SIZE[0], 2 * SIZE[1])))
        folders = (root / f"static/images/{OBJECT}", root / f"static/masks/{OBJECT}")
        write_picture(folders[0], f"DSC{k:03d}", large, mask, ".JPG", folders[1])
    (colmap / "images.bin").write_bytes(content)
    return root


def write_neuma(root):
    """The folder above that of one object."""
    root = Path(root)
    lens = video_lens(full_lens(), SIZE)
    for view, viewmat in enumerate(poses().values()):
        for k in range(COUNT):
            folders = (root / OBJECT / "dynamics", root / OBJECT / "dynamic_masks")
            write_picture(
                folders[0], f"r_{view}_{k}", *drawn(viewmat, lens, *motion(k)), mask_folder=folders[1]
            )
    calib = calibration([f"r_{view}" for view in range(len(CAMERAS))])
    (root / OBJECT / "cameras_calib.json").write_text(json.dumps(calib))
    write_cameras(root / OBJECT / "sparse/0/cameras.bin")
    return root
