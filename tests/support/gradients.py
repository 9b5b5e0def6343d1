"""Comparison of gradients with central differences."""

import pytest
import torch


def check_directional_derivatives(value, tensors, generator, h=1e-6, each=True, floor=0.0, **tolerance):
    """Compare gradients with central differences along random directions.

    Args:
        value: function without arguments of the tensors, which are changed in place and restored.
        tensors: leaves by name.
        generator: source of the directions.
        each: whether every tensor has its own difference, or all change together.
        floor: every difference must be larger than this, so that the comparison is not trivial.
        tolerance: of `pytest.approx`.
    """
    grads = dict(zip(tensors, torch.autograd.grad(value(), list(tensors.values())), strict=True))
    directions = {
        name: torch.randn(t.shape, generator=generator, dtype=t.dtype) for name, t in tensors.items()
    }
    for names in [[name] for name in tensors] if each else [list(tensors)]:
        values = []
        for step in (h, -2 * h, h):
            with torch.no_grad():
                for name in names:
                    tensors[name] += step * directions[name]
                values.append(float(value()))
        difference = (values[0] - values[1]) / (2 * h)
        slope = sum(float((grads[name] * directions[name]).sum()) for name in names)
        assert abs(difference) > floor, names
        assert slope == pytest.approx(difference, **tolerance), names


def check_small_differences(value, points, tolerance):
    """Compare gradients with differences over steps of 1e-7 along a random direction of each point, so small that no
    particle changes between stick and slip, or in and out of contact.

    Args:
        value: function of the points.
        points: tensors in float64.
        tolerance: relative to the slope, or to that of a typical direction if it is larger.
    """
    points = [point.clone().requires_grad_() for point in points]
    grads = torch.autograd.grad(value(*points), points)
    for index, grad in enumerate(grads):
        direction = torch.randn(grad.shape, generator=torch.Generator().manual_seed(index), dtype=grad.dtype)
        direction *= 1e-7 / direction.norm()
        with torch.no_grad():
            ends = [
                value(*(p + sign * direction * (i == index) for i, p in enumerate(points)))
                for sign in (1, -1)
            ]
        slope = float((grad * direction).sum())
        typical = float(grad.norm() * direction.norm()) / direction.numel() ** 0.5
        assert abs(float(ends[0] - ends[1]) / 2 - slope) < tolerance * max(abs(slope), typical)
