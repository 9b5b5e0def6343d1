"""Nearest neighbours against all distances and against a KD-tree."""

import time

import pytest
import torch
from scipy.spatial import cKDTree

from neuma_lib.geometry.nearest import nearest

pytestmark = pytest.mark.core

BOXES = {  # of points: sides and offset
    "one": (1, (1.0, 1.0, 1.0), 0.0),
    "box": (500, (0.3, 0.2, 0.1), 0.5),
    "line": (40, (1.0, 0.0, 0.0), 0.0),
    "same": (7, (0.0, 0.0, 0.0), 0.2),
    "sheet": (900, (1.0, 1.0, 0.01), -1.0),
}
REACH = [1.0, 0.3, 100.0, 1.0, 0.01]  # of queries about the origin, inside, next to and far from the points


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_nearest_of_many_sets_against_all_distances(dtype):
    """Sets of other sizes, flat ones and single points among them, all in one call."""
    generator = torch.Generator().manual_seed(0)
    sets = [
        torch.rand(n, 3, generator=generator).to(dtype) * torch.tensor(sides, dtype=dtype) + offset
        for n, sides, offset in BOXES.values()
    ]
    queries = [torch.randn(20 + k, 3, generator=generator).to(dtype) * reach for k, reach in enumerate(REACH)]
    sizes, counts = [len(points) for points in sets], [len(q) for q in queries]
    actual = nearest(torch.cat(sets), sizes, torch.cat(queries), counts)
    first = 0
    for points, q, rows in zip(sets, queries, actual.split(counts), strict=True):
        rows, first = rows - first, first + len(points)
        assert 0 <= int(rows.min()) and int(rows.max()) < len(points)
        least = torch.cdist(q.double(), points.double(), compute_mode="donot_use_mm_for_euclid_dist").amin(1)
        distance = (q.double() - points[rows].double()).norm(dim=1)
        torch.testing.assert_close(distance, least, rtol=8 * torch.finfo(dtype).eps, atol=0)


def balls(*counts: int) -> list[torch.Tensor]:
    """Points in a ball of 0.13 m."""
    generator = torch.Generator().manual_seed(1)
    return [
        torch.nn.functional.normalize(torch.randn(n, 3, generator=generator, dtype=torch.float64), dim=1)
        * torch.rand(n, 1, generator=generator, dtype=torch.float64) ** (1 / 3)
        * 0.13
        for n in counts
    ]


@pytest.mark.parametrize("shift", [0.0, 0.004, 0.2])
def test_nearest_of_a_body_against_a_tree(shift):
    """A body and its double moved, as in training: the same neighbours as of a KD-tree where they are unique."""
    ball, goal = balls(600, 2400)
    moved = ball + torch.tensor([0.0, shift, 0.0])
    assert nearest(goal, [2400], moved, [600]).tolist() == cKDTree(goal).query(moved)[1].tolist()
    assert nearest(moved, [600], goal, [2400]).tolist() == cKDTree(moved).query(goal)[1].tolist()


def test_the_cost_of_queries_far_from_the_points():
    """Points of a body that has burst take some 9 times as long as points of its double, instead of 31 times."""
    n = 20_000
    ball, double = balls(n, n)

    def core_seconds(queries: torch.Tensor) -> float:
        times = []
        for _ in range(4):
            started = time.process_time()
            nearest(ball, [n], queries, [n])
            times.append(time.process_time() - started)
        return min(times)

    assert core_seconds(4 * double) < 18 * core_seconds(double)
