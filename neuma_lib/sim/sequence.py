"""Recorded launches that a CPU repeats for consecutive steps without Python in between.

A launch of Warp on a CPU is a C function of a launch size and a structure of arguments. A sequence keeps both at fixed
addresses. For each step a native loop writes the arguments that depend on the step and calls the functions. As during
any call of ctypes other Python threads run, but signals wait, so that calls have to be short.
"""

import ctypes
from collections.abc import Mapping, Sequence
from functools import cache
from typing import NamedTuple

import numpy as np
import warp as wp

from neuma_lib.device import start_warp

start_warp()

FOREVER = 2**62  # modulus of an index that is the step itself


class Index(NamedTuple):
    """An argument that depends on the step n: base + stride ((n + offset) mod modulus).

    It is a number, or the address of an array in bytes.
    """

    offset: int = 0
    modulus: int = FOREVER
    base: int = 0
    stride: int = 1


class Repeated:
    """A recorded launch with its own copy of the arguments.

    Args:
        launch: the launch, whose arguments are copied.
        indices: arguments that depend on the step by position.
        values: other arguments that differ from those of the launch by position.
    """

    def __init__(self, launch: wp.Launch, indices: Mapping[int, Index] = {}, values: Mapping[int, int] = {}):
        self._given = launch, indices, values
        bounds, *arguments = launch.params
        kind, offsets = _structure(tuple(map(type, arguments)))
        self.launch, self._arguments = launch, kind(*arguments)
        for position, value in values.items():
            setattr(self._arguments, f"a{position}", value)
        start = ctypes.addressof(self._arguments)
        function = ctypes.cast(launch.hooks.forward, ctypes.c_void_p).value
        self.program = [function, ctypes.addressof(bounds), start, len(indices)]
        for position, index in indices.items():
            is_address = ctypes.sizeof(arguments[position]) >= 8  # also the first member of an array
            self.program += [start + offsets[position], int(is_address), *index]

    def earlier(self) -> "Repeated":
        """The launch for the step before."""
        launch, indices, values = self._given
        shifted = {position: index._replace(offset=index.offset - 1) for position, index in indices.items()}
        return Repeated(launch, shifted, values)


class LaunchSequence:
    """Launches in the order of a step."""

    def __init__(self, launches: Sequence[Repeated]):
        self._launches = tuple(launches)  # keeps their memory
        numbers = [len(launches), *(number for launch in launches for number in launch.program)]
        self._program = np.array(numbers, dtype=np.int64)
        template = _repeat_launch()
        kind, _ = _structure(tuple(map(type, template.params[1:])))
        self._arguments = kind(self._program.ctypes.data)
        self._function = template.hooks.forward
        self._call = ctypes.byref(template.params[0]), ctypes.byref(self._arguments)

    def run(self, first: int, steps: int = 1, direction: int = 1) -> None:
        """Run steps ``first``, ``first + direction`` and so on."""
        self._arguments.a1, self._arguments.a2, self._arguments.a3 = first, steps, direction
        self._function(*self._call)


@cache
def _structure(types: tuple[type, ...]) -> tuple[type[ctypes.Structure], list[int]]:
    """The structure of arguments of some types in which a launch passes them, and the offsets of its members."""
    fields = [(f"a{i}", kind) for i, kind in enumerate(types)]
    result = type("Arguments", (ctypes.Structure,), {"_fields_": fields})
    return result, [getattr(result, name).offset for name, _ in fields]


@cache
def _repeat_launch() -> wp.Launch:
    return wp.launch(_repeat(), dim=1, inputs=[0, 0, 0, 0], device="cpu", record_cmd=True)


@cache
def _repeat() -> wp.Kernel:
    """Kernel (program, first, steps, direction)."""

    @wp.func_native("""
    typedef void (*Function)(void*, void*);
    const int64_t* const start = (const int64_t*)program;
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
    def repeat_native(program: wp.uint64, first: int, steps: int, direction: int): ...

    @wp.kernel(enable_backward=False, module="neuma_lib.sim.sequence")
    def repeat(program: wp.uint64, first: int, steps: int, direction: int):
        repeat_native(program, first, steps, direction)

    return repeat
