"""Motions for other programs: independent readers find the simulated motion in the files."""

import dataclasses
import json
import struct
from pathlib import Path

import imageio.v2 as imageio
import numpy as np
import pytest
import torch
import trimesh
from PIL import Image
from plyfile import PlyData
from scipy.spatial.transform import Rotation

from neuma_lib.coupling.binding import Binding
from neuma_lib.coupling.frames import axes_of, gaussians_at, local_rotations
from neuma_lib.coupling.nearest_binding import bind_nearest
from neuma_lib.coupling.reconstruction import Reconstruction
from neuma_lib.data.blender.blend import write_blend
from neuma_lib.evaluation.plotting.rendering import frontal, renders, seen_around
from neuma_lib.evaluation.video import write_gif, write_mp4
from neuma_lib.geometry.moving_surface import moving_surface, vertex_colours
from neuma_lib.geometry.obstacles import obstacles
from neuma_lib.io.gaussians import save_gaussians
from neuma_lib.io.gltf import linear, write_glb
from neuma_lib.io.usd import write_usd
from neuma_lib.sim.colliders import Collider
from neuma_lib.splatting.extent import SEEN, outermost
from neuma_lib.splatting.gaussians import covariances, rotations
from neuma_lib.splatting.spherical_harmonics import colours
from tests.support.blends import read_blend
from tests.support.splat_files import ball

TURN = rotations(torch.tensor([0.9, 0.2, -0.3, 0.25], dtype=torch.float64))
STRETCH = torch.tensor([[1.2, 0.1, 0.0], [0.1, 0.8, 0.05], [0.0, 0.05, 1.1]], dtype=torch.float64)
SHIFT = torch.tensor([0.1, 0.4, -0.2], dtype=torch.float64)


@pytest.fixture(scope="module")
def body():
    """A ball of Gaussians of degree 3 with particles in it."""
    g = ball(300, degree=3).to(dtype=torch.float64)
    x0 = 0.9 * ball(200, seed=7).means.double()
    ones = torch.ones(200, dtype=torch.float64)
    return Reconstruction(x0, ones, ones, g, bind_nearest(g.means, g.covars(), x0), affine=True)


def moved(body, A):
    """The state of the particles under x -> A x + SHIFT."""
    return body.x0 @ A.T + SHIFT, A.expand(len(body.x0), 3, 3).contiguous()


def test_bodies_of_a_surface_are_nodes_with_their_names(tmp_path):
    """Two moving cubes of one mesh: an independent reader finds each by its name, with its vertices and colours."""
    cube, times = trimesh.creation.box((0.1, 0.1, 0.1)), np.array([0.0, 0.5])
    both = trimesh.util.concatenate([cube, cube.subdivide()])
    counts = [len(cube.vertices), len(both.vertices) - len(cube.vertices)]
    vertices = np.stack([both.vertices, both.vertices + 0.2])
    colors = np.repeat([[1.0, 0, 0], [0, 0, 1.0]], counts, axis=0)
    names = list(zip(("duck", "ball"), counts, strict=True))
    write_glb(tmp_path / "a.glb", vertices, both.faces, times, colors, bodies=names)
    scene = trimesh.load(tmp_path / "a.glb", process=False)
    assert set(scene.geometry) == {"duck", "ball"}
    content = json.loads((tmp_path / "a.glb").read_bytes()[20:].split(b"BIN")[0][:-4].decode().rstrip())
    assert [channel["target"]["node"] for channel in content["animations"][0]["channels"]] == [0, 1]
    for (name, count), color, first in zip(names, ([255, 0, 0], [0, 0, 255]), (0, counts[0]), strict=True):
        part = scene.geometry[name]
        np.testing.assert_allclose(part.vertices, both.vertices[first : first + count], atol=1e-7)
        assert part.is_watertight
        np.testing.assert_array_equal(
            part.visual.vertex_attributes["color"][:, :3], np.tile(color, (count, 1)) / 255
        )


def test_bodies_of_a_surface_are_meshes_of_usd_with_their_names(tmp_path):
    """A name that USD does not allow, or that another body has, is changed."""
    pytest.importorskip("pxr")
    from pxr import Usd, UsdGeom

    cube = trimesh.creation.box((0.1, 0.1, 0.1))
    both = trimesh.util.concatenate([cube, cube.subdivide()])
    counts = [len(cube.vertices), len(both.vertices) - len(cube.vertices)]
    vertices, colors = np.stack([both.vertices, both.vertices + 0.2]), np.ones((len(both.vertices), 3))
    write_usd(
        tmp_path / "b.usda", vertices, both.faces, np.zeros(2), colors, bodies=[("one", n) for n in counts]
    )
    stage = Usd.Stage.Open(str(tmp_path / "b.usda"))
    assert [part.GetName() for part in stage.GetDefaultPrim().GetChildren()] == ["one", "one_2"]
    names = list(zip(("duck", "ball+seed=2"), counts, strict=True))
    write_usd(tmp_path / "a.usda", vertices, both.faces, np.array([0.0, 0.5]), colors, bodies=names)
    stage = Usd.Stage.Open(str(tmp_path / "a.usda"))
    parts = stage.GetDefaultPrim().GetChildren()
    assert [part.GetName() for part in parts] == ["duck", "ball_seed_2"]
    for part, first, solid in zip(parts, (0, counts[0]), (cube, cube.subdivide()), strict=True):
        mesh = UsdGeom.Mesh(part)
        points = np.array(mesh.GetPointsAttr().Get(12.0))  # 24 codes a second
        np.testing.assert_allclose(points, both.vertices[first : first + len(points)] + 0.2, atol=1e-7)
        own = trimesh.Trimesh(points, np.array(mesh.GetFaceVertexIndicesAttr().Get()).reshape(-1, 3))
        assert own.is_watertight and own.volume == pytest.approx(solid.volume)


def test_a_body_named_as_an_obstacle_keeps_its_name(tmp_path, surface, around):
    """Three meshes of both formats have three names, and the body has its own."""
    pytest.importorskip("pxr")
    from pxr import Usd

    count = surface[0].shape[1]
    write_glb(tmp_path / "a.glb", *surface, around, [("obstacle 1", count)])
    sizes = {name: len(part.vertices) for name, part in trimesh.load(tmp_path / "a.glb").geometry.items()}
    assert len(sizes) == 3 and sizes["obstacle 1"] == count and "obstacle 2" in sizes
    write_usd(tmp_path / "a.usda", *surface, around, [("obstacle_1", count)])
    stage = Usd.Stage.Open(str(tmp_path / "a.usda"))
    parts = [part.GetName() for part in stage.GetDefaultPrim().GetChildren()]
    assert parts == ["obstacle_1", "obstacle_1_2", "obstacle_2"]


def test_scales_and_rotations_make_the_covariances_again():
    g = ball(500).to(dtype=torch.float64)
    flat = dataclasses.replace(g, scales=g.scales * torch.tensor([1.0, 0.1, 1e-4]))
    for gaussians in (g, flat):
        scales, quats = axes_of(gaussians.covars())
        assert torch.linalg.det(rotations(quats)).min() > 0
        again = covariances(quats, scales)
        size = gaussians.scales.amax(dim=1).square()
        assert ((again - gaussians.covars()).abs().amax(dim=(1, 2)) / size).max() < 1e-12
    singular = torch.zeros(1, 3, 3, dtype=torch.float64)
    assert torch.isfinite(axes_of(singular)[0].log()).all()  # as files store them


def test_exported_gaussians_are_those_of_the_body_carried_along(body):
    """Means and covariances of x -> A x + b, and harmonics turned by the rotation of A = R S."""
    A = TURN @ STRETCH
    exported = gaussians_at(body, *moved(body, A))
    torch.testing.assert_close(exported.means, body.gaussians.means @ A.T + SHIFT, atol=1e-12, rtol=0)
    torch.testing.assert_close(exported.covars(), A @ body.gaussians.covars() @ A.T, atol=1e-12, rtol=1e-9)
    R = local_rotations(body, A.expand(len(body.x0), 3, 3))
    torch.testing.assert_close(R, TURN.expand_as(R), atol=1e-12, rtol=0)
    seen = torch.nn.functional.normalize(body.gaussians.means + 0.1, dim=1)
    sh, turned = body.gaussians.sh(), exported.sh()
    torch.testing.assert_close(colours(turned, seen @ TURN.T), colours(sh, seen), atol=1e-12, rtol=0)
    unrotated = gaussians_at(body, *moved(body, A), rotate_harmonics=False)
    assert torch.equal(unrotated.sh(), sh)


def test_local_rotations_are_rotations_even_where_a_body_is_turned_inside_out(body):
    mirrored = torch.diag(torch.tensor([1.0, 1.0, -0.01], dtype=torch.float64)).expand(200, 3, 3)
    R = local_rotations(body, mirrored)
    torch.testing.assert_close(torch.linalg.det(R), torch.ones(300, dtype=torch.float64))
    empty = dataclasses.replace(body.binding, indptr=torch.zeros(301, dtype=torch.int64), indices=torch.zeros(0).long(),
                                values=torch.zeros(0).double())  # fmt: skip
    R = local_rotations(dataclasses.replace(body, binding=empty), mirrored)
    torch.testing.assert_close(R, torch.eye(3, dtype=torch.float64).expand(300, 3, 3))
    assert isinstance(empty, Binding)


def test_frames_open_as_3dgs_files(tmp_path, body):
    exported = gaussians_at(body, *moved(body, TURN))
    save_gaussians(tmp_path / "0000.ply", exported)
    rows = PlyData.read(tmp_path / "0000.ply")["vertex"]
    names = [p.name for p in rows.properties]
    rest = [f"f_rest_{i}" for i in range(45)]
    assert names == [*"xyz", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2", *rest, "opacity",
                     "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]  # fmt: skip
    positions = np.stack([rows[axis] for axis in "xyz"], axis=1)
    np.testing.assert_array_equal(positions, exported.means.numpy().astype(np.float32))


@pytest.fixture(scope="module")
def surface():
    """A sphere that is sheared, falls and turns, in four frames: vertices, faces, times, colours, and the mesh."""
    mesh = trimesh.creation.icosphere(subdivisions=2, radius=0.1)
    x0 = 0.095 * ball(400, seed=3).means.numpy().astype(np.float64)
    maps = [np.eye(3) + k * np.array([[0, 0.1, 0], [0, -0.05, 0.1], [0.02, 0, 0]]) for k in range(4)]
    x = np.stack([x0 @ A.T + [0.5, 0.5 - 0.1 * k, 0.5] for k, A in enumerate(maps)])
    mesh.apply_translation([0.5, 0.5, 0.5])
    vertices = moving_surface(mesh, x)
    exact = np.stack([(mesh.vertices - 0.5) @ A.T + [0.5, 0.5 - 0.1 * k, 0.5] for k, A in enumerate(maps)])
    np.testing.assert_allclose(vertices, exact, atol=1e-9)
    colors = np.clip(mesh.vertices - 0.4, 0, 0.2) * 5
    return vertices, np.asarray(mesh.faces), np.array([0.0, 0.1, 0.25, 0.5]), colors


@pytest.fixture(scope="module")
def around(surface):
    """A box at rest and a capsule that falls and turns by 3 rad, at the times of the surface."""
    turning = Collider(
        "capsule", (0.1, 0.05), (0.2, 0.5, 0.5), (0.3, 0.0, 0.0), velocity=(0, -0.5, 0), spin=(0, 0, 6)
    )
    return obstacles([Collider("box", (0.1, 0.2, 0.3), (0.7, 0.2, 0.5)), turning], surface[2])


def test_vertices_have_the_colours_of_the_gaussians_around_them():
    g = ball(2000)
    g = dataclasses.replace(g, sh0=(g.means[:, None] > 0).float() * 2 - 1)  # by octant
    mesh = trimesh.creation.icosphere(subdivisions=1)
    rgb = vertex_colours(mesh, g)
    inside = np.abs(mesh.vertices).min(axis=1) > 0.3  # well inside of an octant
    expected = 0.5 + 0.2820948 * (2 * (mesh.vertices > 0) - 1)
    assert inside.sum() > 5
    np.testing.assert_allclose(rgb[inside], expected[inside], atol=1e-6)


def test_gltf_holds_the_motion(tmp_path, surface, around):
    vertices, faces, times, colors = surface
    write_glb(tmp_path / "a.glb", *surface, around)
    loaded = trimesh.load(tmp_path / "a.glb", process=False)
    mesh = next(iter(loaded.geometry.values()))
    np.testing.assert_array_equal(mesh.vertices, vertices[0].astype(np.float32))
    np.testing.assert_array_equal(mesh.faces, faces)
    data = (tmp_path / "a.glb").read_bytes()
    magic, version, size, length, kind = struct.unpack("<4sIII4s", data[:20])
    assert (magic, version, size, kind) == (b"glTF", 2, len(data), b"JSON")
    content, body = json.loads(data[20 : 20 + length]), data[28 + length :]

    def array(index):
        entry = content["accessors"][index]
        view = content["bufferViews"][entry["bufferView"]]
        assert view["byteOffset"] % 4 == 0
        raw = np.frombuffer(body[view["byteOffset"] :][: view["byteLength"]], "<f4")
        raw = raw.reshape(entry["count"], -1)
        if "min" in entry:
            np.testing.assert_array_equal(raw.min(axis=0), np.float32(entry["min"]))
            np.testing.assert_array_equal(raw.max(axis=0), np.float32(entry["max"]))
        return raw

    primitive = content["meshes"][0]["primitives"][0]
    base = array(primitive["attributes"]["POSITION"]).astype(np.float64)
    targets = np.stack([array(target["POSITION"]) for target in primitive["targets"]])
    sampler = content["animations"][0]["samplers"][0]
    np.testing.assert_array_equal(array(sampler["input"])[:, 0], np.float32(times))
    weights = array(sampler["output"]).reshape(len(times), -1)
    animated = base + np.einsum("tk,kvc->tvc", weights, targets)
    np.testing.assert_allclose(animated, vertices, atol=2 * np.finfo(np.float32).eps)  # metres, below 1
    np.testing.assert_allclose(array(primitive["attributes"]["COLOR_0"]), linear(colors), atol=1e-7)
    for k, obstacle in enumerate(around, 1):  # another reader applies the pose at the start
        pose, name = loaded.graph[f"obstacle {k}"]
        placed = trimesh.transform_points(loaded.geometry[name].vertices, pose)
        np.testing.assert_allclose(placed, obstacle.placed(0), atol=1e-6)
    channels = {
        (c["target"]["node"], c["target"]["path"]): c["sampler"] for c in content["animations"][0]["channels"]
    }
    assert set(channels) == {(0, "weights"), (2, "translation"), (2, "rotation")}
    moved, turned = (
        array(content["animations"][0]["samplers"][channels[2, path]]["output"])
        for path in ("translation", "rotation")
    )
    np.testing.assert_allclose(moved, around[1].poses[:, :3, 3], atol=1e-7)
    np.testing.assert_allclose(Rotation.from_quat(turned).as_matrix(), around[1].poses[:, :3, :3], atol=1e-6)
    assert ((turned[1:] * turned[:-1]).sum(axis=1) > 0).all()  # the shorter way between two frames
    write_glb(tmp_path / "b.glb", *(part[:1] if k in (0, 2) else part for k, part in enumerate(surface)))
    still = (tmp_path / "b.glb").read_bytes()
    assert b"animations" not in still and b"targets" not in still


@pytest.mark.parametrize("kind", ["usda", "usdc"])
def test_usd_holds_the_motion_and_its_own_validators_find_nothing(tmp_path, surface, around, kind):
    pytest.importorskip("pxr")
    from pxr import Usd, UsdGeom, UsdValidation

    vertices, faces, times, _ = surface
    for again in range(2):
        write_usd(tmp_path / f"{again}.{kind}", *surface, around)
    assert (tmp_path / f"0.{kind}").read_bytes() == (tmp_path / f"1.{kind}").read_bytes()
    assert len(list(tmp_path.iterdir())) == 2
    stage = Usd.Stage.Open(str(tmp_path / f"0.{kind}"))
    mesh = UsdGeom.Mesh(stage.GetDefaultPrim().GetChild("surface"))
    rate = stage.GetTimeCodesPerSecond()
    np.testing.assert_allclose(np.array(mesh.GetPointsAttr().GetTimeSamples()) / rate, times, rtol=1e-12)
    for time, frame in zip(times, vertices, strict=True):
        np.testing.assert_array_equal(
            np.array(mesh.GetPointsAttr().Get(time * rate)), frame.astype(np.float32)
        )
    np.testing.assert_array_equal(np.array(mesh.GetFaceVertexIndicesAttr().Get()).reshape(-1, 3), faces)
    for k, obstacle in enumerate(around, 1):
        part = UsdGeom.Mesh(stage.GetDefaultPrim().GetChild(f"obstacle_{k}"))
        for frame, time in enumerate(times):
            pose = np.array(part.ComputeLocalToWorldTransform(time * rate))
            corners = np.array(part.GetPointsAttr().Get()) @ pose[:3, :3] + pose[3, :3]
            np.testing.assert_allclose(corners, obstacle.placed(frame), atol=1e-6)
    assert UsdGeom.GetStageUpAxis(stage) == "Y" and UsdGeom.GetStageMetersPerUnit(stage) == 1
    validators = UsdValidation.ValidationRegistry().GetOrLoadAllValidators()
    assert len(validators) > 10
    errors = UsdValidation.ValidationContext(validators).Validate(stage)
    assert [error.GetMessage() for error in errors] == []


def test_films_have_all_frames(tmp_path):
    video = np.full((12, 16, 16, 3), 255, np.uint8)
    for k in range(12):
        video[k, :, k, 0] = 20 * k
    write_gif(tmp_path / "a.gif", video, 30.0)
    with Image.open(tmp_path / "a.gif") as image:
        assert image.n_frames == 12
        for k in range(12):
            image.seek(k)
            assert np.asarray(image.convert("RGB"))[0, :, 0].argmin() == k  # the column that is not white
    write_mp4(tmp_path / "a.mp4", video, 30.0)
    assert len(imageio.mimread(tmp_path / "a.mp4")) == 12


def test_the_outermost_points_are_where_gaussians_end():
    """One ellipsoid: its points are on the surface of opacity SEEN, and nothing of it is far beyond their hull."""
    torch.manual_seed(0)
    axes = TURN @ torch.diag(torch.tensor([0.3, 0.1, 0.02], dtype=torch.float64))
    covars = torch.stack([axes @ axes.T, 1e4 * torch.eye(3, dtype=torch.float64)])
    means = torch.stack([SHIFT, 50 + SHIFT])
    opacities = torch.tensor([0.8, 0.9 * SEEN], dtype=torch.float64)  # the second is too faint
    points = outermost(means, covars, opacities)
    r = torch.linalg.solve(axes, (points - SHIFT).T).norm(dim=0)
    torch.testing.assert_close(0.8 * (-0.5 * r.square()).exp(), torch.full_like(r, SEEN))
    seen_from = torch.nn.functional.normalize(torch.randn(500, 3, dtype=torch.float64), dim=1)
    ends = r[0] * (seen_from @ covars[0] * seen_from).sum(dim=1).sqrt()
    missed = ends - (seen_from @ (points - SHIFT).T).amax(dim=1)
    assert -1e-12 < missed.min() and missed.max() < 0.04 * ends.max()
    assert len(outermost(means[1:], covars[1:], torch.tensor([0.0]))) == 0


def test_a_film_cuts_nothing_that_is_seen(body):
    """Large Gaussians around few particles: the border of the picture stays white, and the body fills the picture."""
    g = body.gaussians
    large = dataclasses.replace(g, scales=0.25 + 0 * g.scales, sh0=-3 + 0 * g.sh0, shN=g.shN[:, :0])
    body = dataclasses.replace(body, gaussians=large).to(torch.float32)
    states = zip(moved(body, torch.eye(3)), moved(body, STRETCH.float()), strict=True)
    x, F = map(torch.stack, states)

    def dark(points):
        """Largest darkness of border and picture, and the share of columns that are dark."""
        images = 255 - renders(body, frontal(points, 64, 64), x, F)[..., 0].astype(int)
        border = max(images[:, :, edge].max() for edge in (0, -1))
        return max(border, images[:, [0, -1]].max()), images.max(), (images.max(axis=(0, 1)) > 25).mean()

    border, darkest, filled = dark(seen_around(body, x, F))
    assert border < 0.1 * darkest and filled > 0.7
    assert dark(x.numpy())[0] > 0.5 * darkest, "as if centres were framed"


@pytest.mark.slow
def test_blend_holds_the_motion(tmp_path, surface, around):
    """Read back by another Blender process; between two frames the surface is between them."""
    vertices, _, times, _ = surface
    write_blend(tmp_path / "a.blend", tmp_path / "a.png", *surface, around)
    with Image.open(tmp_path / "a.png") as image:
        alpha = np.asarray(image)[..., 3]
    assert 0.005 < (alpha > 128).mean() < 0.5
    read = read_blend(tmp_path / "a.blend", [*times.tolist(), float(times[1:3].mean())])
    # times are single precision in Blender, a frame is 1/24 s
    np.testing.assert_allclose(read["co"][:4], vertices, atol=1e-5)
    np.testing.assert_allclose(read["co"][4], vertices[1:3].mean(axis=0), atol=1e-5)
    np.testing.assert_allclose(read["world"][:3, :3] @ [0, 1, 0], [0, 0, 1], atol=1e-6)  # y is up: z
    stand = np.array([[1, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]])
    np.testing.assert_allclose(read["poses"][:, :4], [stand @ each.poses for each in around], atol=1e-5)
    assert Path(tmp_path / "a.blend").stat().st_size > 1000
