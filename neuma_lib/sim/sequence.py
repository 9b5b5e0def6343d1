"""Recorded launches that a CPU repeats for consecutive steps without Python in between.

A launch of Warp on a CPU is a C function of a launch size and a structure of arguments. A sequence keeps both at fixed
addresses. For each step a native loop writes the arguments that depend on the step and calls the functions. As during
any call of ctypes other Python threads run, but signals wait, so that calls have to be short.
"""

# No `from __future__ import annotations` here: Warp reads the annotations of kernels as objects.
import ctypes
from collections.abc import Sequence
from functools import cache
from typing import NamedTuple

import numpy as np
import warp as wp

from neuma_lib.device import start_warp

start_warp()

FOREVER = 2**62
"""Modulus of an index that is the step itself."""


class Index(NamedTuple):
    """An argument that depends on the step n: base + stride ((n + offset) mod modulus).

    It is a number, or the address of an array in bytes.
    """

    offset: int = 0
    modulus: int = FOREVER
    base: int = 0
    stride: int = 1


class Repeated(NamedTuple):
    """A recorded launch, and its arguments that depend on the step by their position."""

    launch: wp.Launch
    indices: dict[int, Index]


class LaunchSequence:
    """Launches in the order of a step."""

    def __init__(self, launches: Sequence[Repeated]):
        self._kept = []  # memory that the program refers to
        program = [len(launches)]
        for launch, indices in launches:
            arguments, addresses = _arguments(launch)
            self._kept += [launch, arguments]
            function = ctypes.cast(launch.hooks.forward, ctypes.c_void_p).value
            program += [
                function,
                ctypes.addressof(launch.params[0]),
                ctypes.addressof(arguments),
                len(indices),
            ]
            for position, index in indices.items():
                is_address = (
                    ctypes.sizeof(launch.params[position + 1]) >= 8
                )  # also the first member of an array
                program += [addresses[position], int(is_address), *index]
        self._program = wp.array(np.array(program, dtype=np.int64), device="cpu")
        inputs = [self._program, 0, 0, 0]
        self._run = wp.launch(_repeat(), dim=1, inputs=inputs, device="cpu", record_cmd=True)
        self._arguments, _ = _arguments(self._run)
        self._call = [ctypes.byref(value) for value in (self._run.params[0], self._arguments)]

    def run(self, first: int, steps: int = 1, direction: int = 1) -> None:
        """Run steps ``first``, ``first + direction`` and so on."""
        self._arguments.a1, self._arguments.a2, self._arguments.a3 = first, steps, direction
        self._run.hooks.forward(*self._call)


def _arguments(launch: wp.Launch) -> tuple[ctypes.Structure, list[int]]:
    """The structure that a launch passes to its function, and the addresses of its members."""
    values = launch.params[1:]
    fields = [(f"a{i}", type(value)) for i, value in enumerate(values)]
    kind = type("Arguments", (ctypes.Structure,), {"_fields_": fields})
    result = kind(*values)
    return result, [ctypes.addressof(result) + getattr(kind, name).offset for name, _ in fields]


@cache
def _repeat() -> wp.Kernel:
    """Kernel (program, first, steps, direction)."""

    @wp.func_native("""
    typedef void (*Function)(void*, void*);
    const int64_t* const start = (const int64_t*)program.data;
    for (int s = 0, n = first; s < steps; ++s, n += direction) {
        const int64_t* next = start + 1;
        for (int64_t k = 0; k < start[0]; ++k) {
            const int64_t* const call = next;
            next += 4;
            for (int64_t i = 0; i < call[3]; ++i, next += 6) {
                const int64_t value = next[4] + next[5] * ((n + next[2]) % next[3]);
                if (next[1])
                    *(int64_t*)next[0] = value;
                else
                    *(int*)next[0] = value;
            }
            ((Function)call[0])((void*)call[1], (void*)call[2]);
        }
    }
    """)
    def repeat_native(program: wp.array(dtype=wp.int64), first: int, steps: int, direction: int): ...

    @wp.kernel(enable_backward=False, module="neuma_lib.sim.sequence")
    def repeat(program: wp.array(dtype=wp.int64), first: int, steps: int, direction: int):
        repeat_native(program, first, steps, direction)

    return repeat
