"""Clamped particles and held nodes as Warp functions. `clamps.Clamp` has the rules."""

import functools
from types import SimpleNamespace

import numpy as np
import torch
import warp as wp

from neuma_lib.device import start_warp
from neuma_lib.sim.clamps import Clamp

start_warp()


@functools.cache
def hold_type(dtype: torch.dtype) -> type:
    """Warp's struct of a clamp in a step: the velocity of a point x is A (x - centre) + velocity."""
    real = {torch.float32: wp.float32, torch.float64: wp.float64}[dtype]
    vec3 = wp.types.vector(length=3, dtype=real)
    mat33 = wp.types.matrix(shape=(3, 3), dtype=real)

    @wp.struct
    class Hold:
        holds: wp.int32  # 0 after the release
        A: mat33
        centre: vec3
        velocity: vec3

    return Hold


@functools.lru_cache(maxsize=64)  # many simulations of a model have the same segments of steps
def holds(clamps: tuple[Clamp, ...], times: tuple[float, ...], dt: float, dtype: torch.dtype) -> np.ndarray:
    """Clamps in the steps from some times [s] on, as a structured array (times, clamps) of `hold_type`, which is not to
    be changed."""
    result = np.zeros((len(times), max(1, len(clamps))), dtype=hold_type(dtype).numpy_dtype())
    for k, clamp in enumerate(clamps):
        for n, time in enumerate(times if clamp.moves else times[:1]):
            place = slice(n, n + 1 if clamp.moves else None)
            for name, value in zip(("A", "centre", "velocity"), clamp.in_step(time, dt), strict=True):
                result[name][place, k] = value.numpy()
        result["holds"][:, k] = [clamp.holds(time, dt) for time in times]
    result.setflags(write=False)
    return result


@functools.cache
def clamp_functions(dtype: torch.dtype) -> SimpleNamespace:
    """Functions `held`, whether a particle is held in a step, and `prescribed`, the velocity of a clamp at a point."""
    real = {torch.float32: wp.float32, torch.float64: wp.float64}[dtype]
    vec3 = wp.types.vector(length=3, dtype=real)
    Hold = hold_type(dtype)

    @wp.func
    def held(holds: wp.array2d(dtype=Hold), pose: wp.int32, clamp: wp.int32):
        result = wp.bool(False)
        if clamp >= 0:
            result = holds[pose, clamp].holds > 0
        return result

    @wp.func
    def prescribed(hold: Hold, x: vec3):
        return hold.velocity + hold.A * (x - hold.centre)

    return SimpleNamespace(held=held, prescribed=prescribed)
