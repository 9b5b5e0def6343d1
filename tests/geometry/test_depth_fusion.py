"""Depth maps fused to a signed distance: planes and balls whose distances are known."""

import pytest
import torch

from neuma_lib.geometry.depth_fusion import fused_distance
from neuma_lib.splatting.cameras import Cameras, look_at

pytestmark = pytest.mark.core

K = torch.tensor([[40.0, 0.0, 32.0], [0.0, 40.0, 32.0], [0.0, 0.0, 1.0]], dtype=torch.float64)
UP = torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64)


def cameras(*eyes):
    eyes = torch.tensor(eyes, dtype=torch.float64)
    poses = look_at(eyes, torch.zeros(3, dtype=torch.float64), UP)
    return Cameras(poses, K.repeat(len(eyes), 1, 1), 64, 64)


def test_distances_to_a_plane_are_cut_at_the_reach_and_end_behind_it():
    """A plane at z = 0, seen from 1 m before it along its normal."""
    seen = cameras((0.0, 0.0, 1.0))
    heights = [0.5, 0.04, 0.0, -0.06, -0.2]
    points = torch.tensor([[0.05, -0.1, z] for z in heights], dtype=torch.float64)
    depth = torch.ones(64, 64, dtype=torch.float64)
    actual = fused_distance(points, [depth], list(seen), 0.1)
    torch.testing.assert_close(actual, torch.tensor([-0.1, -0.04, 0.0, 0.06, 0.1], dtype=torch.float64))
    nothing = fused_distance(points, [torch.full_like(depth, torch.nan)], list(seen), 0.1)
    assert (nothing == 0.1).all(), "no view has information"


def test_views_are_averaged_without_those_from_behind_a_body():
    """A sheet of 0.5 m, seen from both sides: the view of a side determines it, with less weight at depth."""
    seen = cameras((0.0, 0.0, 1.0), (0.0, 0.0, -1.0), (0.0, 0.0, 1.0))
    front, back = (torch.full((64, 64), d, dtype=torch.float64) for d in (0.75, 0.75))
    points = torch.tensor([[0.0, 0.0, 0.22], [0.0, 0.0, -0.22], [9.0, 0.0, 0.0]], dtype=torch.float64)
    actual = fused_distance(points, [front, back, front - 0.02], list(seen), 0.1)
    mean = (0.7 * 0.03 + 0.5 * 0.05) / (0.7 + 0.5)
    torch.testing.assert_close(actual, torch.tensor([mean, 0.03, 0.1], dtype=torch.float64))


def test_the_other_side_of_a_thin_wall_hardly_moves_a_surface():
    """A wall from -0.04 to 0.04 m under a reach of 0.1 m: 4 mm outside it counts as outside, seen from both sides."""
    seen = cameras((0.0, 0.0, 1.0), (0.0, 0.0, -1.0))
    depth = torch.full((64, 64), 0.96, dtype=torch.float64)
    points = torch.tensor([[0.0, 0.0, z] for z in (0.0, 0.036, 0.056)], dtype=torch.float64)
    middle, inside, outside = fused_distance(points, [depth, depth], list(seen), 0.1)
    assert abs(middle - 0.04) < 1e-12 and inside > 0 > outside
    assert abs(outside + 0.012) < 0.01, "without weights it would be at +0.04"
