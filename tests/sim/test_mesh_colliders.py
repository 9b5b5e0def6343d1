"""Colliders with the shape of a mesh: against closed forms, the torch twin, finite differences and primitives."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
import trimesh

from neuma_lib.geometry.mesh_collider import MARGIN, mesh_collider
from neuma_lib.mechanics.analytic import analytic_law
from neuma_lib.sim.colliders import Collider, DistanceGrid, contact_radius
from neuma_lib.sim.free_flight import free_flight_steps
from neuma_lib.sim.model import MPM, as_regions, contact_clearance
from neuma_lib.sim.rollout import rollout
from neuma_lib.sim.state import State
from tests.support.contact_scenes import assert_equals_twin, assert_gradient_is_the_difference, falling_on
from tests.support.errors import refused
from tests.support.sim_scenes import DT, loss_of, make_law, moving_cube

RADIUS = 0.15


def ball(subdivisions=3, cells=24, **options):
    """A mesh sphere of `RADIUS` whose vertices are on it."""
    mesh = trimesh.creation.icosphere(subdivisions=subdivisions, radius=RADIUS)
    return mesh_collider(mesh, cells, **options)


def narrow_grid(**options):
    """A sphere whose grid ends 1 cm beyond it, less than the radius of the particles."""
    ticks = torch.linspace(-RADIUS - 0.01, RADIUS + 0.01, 21, dtype=torch.float64)
    nodes = torch.stack(torch.meshgrid(ticks, ticks, ticks, indexing="ij"), dim=-1)
    grid = DistanceGrid(
        (nodes.norm(dim=-1) - RADIUS).numpy(), (float(ticks[0]),) * 3, float(ticks[1] - ticks[0])
    )
    return Collider("mesh", distances=grid, **options)


POSE = {"centre": (0.4, 0.22, 0.5), "rotation": (0.1, -0.3, 0.2)}
COLLIDERS = {
    "resting": [ball(friction=0.3, damping=0.3, **POSE)],
    "moving": [ball(friction=0.4, velocity=(0.2, 0.5, -0.3), spin=(1.0, -2.0, 3.0), **POSE)],
    "narrow grid": [narrow_grid(friction=0.3, damping=0.2, **POSE)],
    "two": [ball(friction=0.3, **POSE), ball(2, 17, friction=math.inf, centre=(0.65, 0.25, 0.5))],
}


def test_the_distance_of_a_sphere():
    """Within h^2 / (4 r) of trilinear interpolation and the sagitta of a face, and a normal within h / r.

    Along an axis, interpolation of a convex function is too large by at most h^2 / 8 times its second derivative. The
    three second derivatives of a distance sum to 2 / r at the distance r from the centre. A face of the mesh with the
    circumradius e is inside the sphere by at most e^2 / (2 R). The gradient within a cell differs from that at a
    point of it by at most sqrt(3) h times the largest second derivative, 1 / r; and the faces, tilted by e / R.
    """
    collider = ball(5, 40)
    grid = collider.distances
    mesh = trimesh.creation.icosphere(subdivisions=5, radius=RADIUS)
    circumradius = (mesh.edges_unique_length.max()) / math.sqrt(3)
    sagitta = circumradius**2 / (2 * RADIUS)
    generator = torch.Generator().manual_seed(0)
    direction = torch.nn.functional.normalize(
        torch.randn(5000, 3, generator=generator, dtype=torch.float64), dim=1
    )
    depth = (torch.rand(5000, generator=generator, dtype=torch.float64) - 0.5) * 1.9 * MARGIN
    distance, normal = collider.surface((RADIUS + depth)[:, None] * direction)
    r = RADIUS - 0.95 * MARGIN - math.sqrt(3) * grid.spacing
    error = distance - depth
    assert error.max() < grid.spacing**2 / (4 * r) + sagitta + 1e-6 and error.min() > -1e-6
    assert (normal - direction).norm(dim=1).max() < (math.sqrt(3) * grid.spacing / r + circumradius / RADIUS)


def test_the_distance_of_a_box():
    """Exact, up to the single precision of the grid, where the nearest face is the same at the corners of the cell.

    Elsewhere, near edges and the medial axis, within the spacing. Points outside the grid have a lower bound.
    """
    half = (0.11, 0.07, 0.13)
    meshed = mesh_collider(trimesh.creation.box(extents=2 * np.array(half)), 40)
    exact, grid = Collider("box", half), meshed.distances
    x = 0.5 * (torch.rand(20000, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64) - 0.5)
    distance, normal = meshed.surface(x)
    expected, direction = exact.surface(x)
    low = torch.tensor(grid.lowest, dtype=torch.float64)
    high = low + grid.spacing * (torch.tensor(grid.values.shape) - 1)
    inside = ((x > low) & (x < high)).all(dim=1)
    assert (distance - expected)[inside].abs().max() < grid.spacing
    assert (distance - expected)[~inside].max() < grid.spacing
    corners = torch.cartesian_prod(*[torch.tensor([-1.0, 1.0], dtype=torch.float64)] * 3) * grid.spacing
    _, around = exact.surface(x[:, None] + corners)
    flat = inside & ((around - direction[:, None]).norm(dim=2).max(dim=1).values < 1e-12)
    assert flat.sum() > 1000
    torch.testing.assert_close(distance[flat], expected[flat], rtol=0, atol=1e-7)
    torch.testing.assert_close(normal[flat], direction[flat], rtol=0, atol=1e-4)


@pytest.mark.parametrize("name", COLLIDERS)
def test_equals_the_torch_twin(name):
    """In both precisions."""
    model, start = falling_on(*COLLIDERS[name])
    slow = assert_equals_twin(model, start)
    single = State(
        *(value.float() for value in (start.x, start.v, start.mass, start.vol0)), C=start.C.float()
    )
    path = rollout(model, make_law("neo_hookean", torch.float32), single, steps=40, frames=(40,))
    torch.testing.assert_close(path.x[0].double(), slow[1], rtol=0, atol=1e-5)


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs CUDA")
@pytest.mark.parametrize("name", COLLIDERS)
def test_cuda_equals_cpu(name):
    """States and gradients, direct and as a replayed graph."""
    model, start = falling_on(*COLLIDERS[name])
    law = make_law("neo_hookean")
    results = []
    for device in ("cpu", "cuda", "cuda", "cuda"):
        own = start.to(device)
        own = replace(own, x=own.x.clone().requires_grad_(), v=own.v.clone().requires_grad_())
        path = rollout(model, law, own, steps=40, frames=(20, 40))
        grads = torch.autograd.grad(loss_of(path), (own.x, own.v))
        results.append([value.detach().cpu() for value in (path.x, *grads)])
    for other in results[1:]:
        for a, b in zip(other, results[0], strict=True):
            assert (a - b).abs().max() < 1e-9 * b.abs().max()


@pytest.mark.parametrize("name", COLLIDERS)
def test_finite_differences(name):
    assert_gradient_is_the_difference(*falling_on(*COLLIDERS[name]))


def test_free_flight_ends_where_the_body_touches():
    """The simulated body leaves its parabola in the step in which the first particle touches the mesh."""
    model = MPM(16, 1e-3, contact="particles", colliders=(ball(centre=(0.5, 0.15, 0.5)),))
    law, start = make_law("hencky"), moving_cube((0.0, -2.0, 0.0), centre=(0.5, 0.65, 0.5), side=0.2)
    free = free_flight_steps(model, as_regions(law, len(start.x)), start, 120)
    path = rollout(model, law, start, steps=120, frames=range(121), skip_free_flight=False)
    clear = contact_clearance(model, path.x, start.vol0, range(121))
    assert 20 < free < 100 and clear[free - 1] > 0 >= clear[free] - 2e-3 * model.dx
    strain = (path.F - torch.eye(3)).abs().amax(dim=(1, 2, 3))
    assert strain[:free].max() < 1e-12 < strain[free + 2 :].max()


def test_a_body_rests_on_a_mesh_as_on_a_box():
    """Above the middle of a face, where the distance of a mesh is exact, both colliders give the same states."""
    half = (0.2, 0.1, 0.2)
    box = {"centre": (0.5, 0.2, 0.5), "friction": 0.5, "damping": 0.5}
    shapes = (
        Collider("box", half, **box),
        mesh_collider(trimesh.creation.box(extents=2 * np.array(half)), 32, **box),
    )
    start = moving_cube((0.3, -1.0, 0.0), count=500, centre=(0.5, 0.42, 0.5), side=0.2)
    law = analytic_law({"elasticity": {"name": "neo_hookean", "E": 5e4, "nu": 0.3}}, 5e-4)
    paths = []
    for collider in shapes:
        model = MPM(16, 5e-4, contact="particles", colliders=(collider,))
        paths.append(rollout(model, law, start, steps=600, frames=(100, 300, 600)))
    bottom = paths[0].x[..., 1] - contact_radius(start.vol0)
    assert bottom.min() < 0.3 and bottom[-1].min() > 0.3 - 0.25 / 16
    torch.testing.assert_close(paths[0].x, paths[1].x, rtol=0, atol=1e-5)


def test_equal_meshes_are_equal_keys():
    """A model is a key of pooled workspaces."""
    a, b, other = ball(), ball(), ball(cells=25)
    assert a == b and hash(a) == hash(b) and a != other
    models = [MPM(16, DT, contact="particles", colliders=(collider,)) for collider in (a, b, other)]
    assert len(set(models)) == 2


def test_wrong_meshes_are_refused():
    mesh = trimesh.creation.icosphere(subdivisions=1, radius=0.1)
    with refused("collider.mesh", problem="watertight"):
        mesh_collider(trimesh.Trimesh(mesh.vertices, mesh.faces[1:]))
    with refused("collider.cells"):
        mesh_collider(mesh, 2)
    with refused("collider.distances"):
        Collider("mesh")
    with refused("collider.distances"):
        Collider("sphere", (0.1,), distances=ball().distances)
    with refused("distances.values"):
        DistanceGrid(-np.ones((4, 4, 4)), (0.0, 0.0, 0.0), 0.1)
    with refused("distances.values"):
        DistanceGrid(np.ones(4), (0.0, 0.0, 0.0), 0.1)
    for face in ([0, 1, 1], [3, 1, 1], [1, 0, 1], [1, 3, 1], [1, 1, 0], [1, 1, 3]):
        values = np.ones((4, 4, 4))
        values[tuple(face)] = -1.0
        with refused("distances.values", problem="leaves the grid"):
            DistanceGrid(values, (0.0, 0.0, 0.0), 0.1)
