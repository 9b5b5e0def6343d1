"""A simulation that runs while one watches and acts on it: in a thread of its own, which nothing blocks for long.

Everything from outside is a command in a queue; the thread carries it out between two frames. What it shows is the last
`Snapshot`. Lengths are metres in the simulated box; the floor is tilted by turning gravity the other way, and whoever
draws the box turns it (`LiveSimulation.floor`).
"""

from __future__ import annotations

import queue
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from neuma_lib.errors import InputError, NonFiniteError
from neuma_lib.io.exported import SAME_STEP
from neuma_lib.mechanics.adaptor import AdaptableLaw
from neuma_lib.mechanics.law import Law
from neuma_lib.mechanics.time_step import step_dependence
from neuma_lib.sim.model import MPMModel, consecutive
from neuma_lib.sim.rollout import rollout
from neuma_lib.sim.state import State, Trajectory

FRAME = 1 / 30
"""Time between two pictures [s], to a whole number of steps, where that much can be computed in it."""
BUSY = 0.06
"""Seconds of computing that a frame may take: more than ten frames a second, with time left to draw."""
PIVOT = np.array([0.5, 0.0, 0.5])
"""Point of the floor that the box turns about [m]."""
IDLE = 0.2
"""Seconds between looks at nothing happening."""
EARTH = 9.8
FASTEST = 10.0
"""Largest speed that a throw or a hand gives [m/s]."""
_HAND = 0.08
"""Time in which a held body reaches the hand [s]."""
_NEW = 0.2
"""Share of the last frame in running means."""
_GAP = 1.5
"""Between bodies, and to the walls, when one is put into the box [cells]."""


@dataclass(frozen=True)
class Snapshot:
    """What there is at one time.

    Attributes:
        number: of the frame, from 0; grows with every one.
        time: simulated since the last reset [s].
        x, v, F, total: positions [m], velocities [m/s], elastic and total deformation gradients of all particles, on
            the CPU.
        counts: particles of each body.
        dt: time step [s].
        pace: simulated over real time.
        rate: frames a second.
        trouble: what went wrong, or None; the simulation then waits for a reset.
        notice: why the last command was not carried out, or None.
    """

    number: int
    time: float
    x: Tensor
    v: Tensor
    F: Tensor
    total: Tensor
    counts: tuple[int, ...]
    dt: float
    pace: float
    rate: float
    trouble: str | None
    notice: str | None


def _undeformed(x: Tensor) -> Tensor:
    """Deformation gradients (N, 3, 3) of particles (N, 3) at rest."""
    return torch.eye(3, dtype=x.dtype, device=x.device).expand(len(x), 3, 3)


def _check_steps(laws: Sequence[Law], dts: Sequence[float]) -> None:
    """Whether bodies can share the smallest of the steps that their laws were learned at.

    Raises:
        InputError: one that was learned at a longer step is another material at that one (`step_dependence`).
    """
    least = min(dts)
    for law, dt in zip(laws, dts, strict=True):
        if dt - least > SAME_STEP * least and step_dependence(law) != "none":
            raise InputError(
                f"bodies of one simulation share a time step, here {1e3 * least:g} ms, and the law {law.name} is "
                f"another material there than at the {1e3 * dt:g} ms that it was learned at: reset, which leaves one "
                "body, or take a law of the same step"
            )


def tilted(about_x: float, about_z: float) -> np.ndarray:
    """Rotation (3, 3) of the box when its floor is tilted about the axes x and z [degrees]."""
    a, b = np.radians([about_x, about_z])
    x = np.array([[1, 0, 0], [0, np.cos(a), -np.sin(a)], [0, np.sin(a), np.cos(a)]])
    z = np.array([[np.cos(b), -np.sin(b), 0], [np.sin(b), np.cos(b), 0], [0, 0, 1]])
    return z @ x


class LiveSimulation:
    """Bodies in the box, simulated by a thread.

    Args:
        constants: of `MPMModel`, without dt and gravity.
        start: the first body with its motion; a reset goes back to it. It is simulated on the device that it is on.
        law: of the first body, on that device, too.
        dt: time step that the law was learned at [s].

    Attributes:
        floor: rotation (3, 3) of the box.
    """

    def __init__(self, constants: Mapping[str, Any], start: State, law: Law, dt: float):
        self._constants = {key: value for key, value in constants.items() if key not in ("dt", "gravity")}
        self._start, self._first_law, self._first_dt = start, law, dt
        self._strength, self.floor = EARTH, np.eye(3)
        self._weight = 1.0
        self._commands: queue.SimpleQueue[Callable[[], None]] = queue.SimpleQueue()
        self._news, self._closing = threading.Condition(), False
        self._running, self._hand, self._trouble, self._notice = True, None, None, None
        self._number, self._steps_a_frame, self._span, self._moved = 0, 1, FRAME, 0.0
        self._measured = time.perf_counter()
        self._restart()
        self._thread = threading.Thread(target=self._loop, name="live simulation", daemon=True)

    # ---- from any thread ---------------------------------------------------------------------------------------------

    def open(self) -> LiveSimulation:
        """Start the thread."""
        self._thread.start()
        return self

    def close(self) -> None:
        """End the thread, after the frame that it is at."""
        self._closing = True
        self._commands.put(lambda: None)
        self._thread.join(timeout=10)

    @property
    def snapshot(self) -> Snapshot:
        """The last one."""
        return self._snapshot

    def wait(self, number: int, timeout: float = 10.0) -> Snapshot:
        """The first snapshot seen whose number is at least ``number``, or the last one when the time is up [s]."""
        with self._news:
            self._news.wait_for(lambda: self._snapshot.number >= number, timeout)
            return self._snapshot

    def do(self, timeout: float = 10.0) -> Snapshot:
        """Wait until all commands given so far are carried out; the snapshot after them."""
        reached: queue.SimpleQueue[int] = queue.SimpleQueue()
        self._commands.put(lambda: reached.put(self._number))
        try:
            return self.wait(reached.get(timeout=timeout), timeout)
        except queue.Empty:
            return self._snapshot

    def reset(self) -> None:
        """Back to the start: the first body alone, with gravity, floor, law and weight as they are set."""
        self._tell(self._restart)

    def run(self, running: bool) -> None:
        """Go on or pause."""
        self._tell(lambda: setattr(self, "_running", running))

    def set_gravity(self, strength: float) -> None:
        """Gravity downward in the room [m/s^2]."""
        self._tell(lambda: setattr(self, "_strength", float(strength)))

    def set_floor(self, about_x: float, about_z: float) -> None:
        """Tilt the box about two axes [degrees]."""
        self._tell(lambda: setattr(self, "floor", tilted(about_x, about_z)))

    def set_weight(self, weight: float) -> None:
        """Weight of the adaptors: 0 is the prior, 1 as trained. Laws without one stay as they are."""
        self._tell(lambda: self._weigh(weight))

    def set_law(self, law: Law, dt: float) -> None:
        """Another material for the first body, with the time step that it was learned at [s].

        Where other bodies cannot take that step (`_check_steps`) the snapshot says so, and nothing changes.
        """
        self._tell(lambda: self._swap(law, dt))

    def throw(self, velocity: Sequence[float]) -> None:
        """Give the first body one velocity [m/s], in the room's axes."""
        self._tell(lambda: self._throw(velocity))

    def drop(self, height: float) -> None:
        """Take the first body, undeformed, to a height above the floor [m] and let it go."""
        self._tell(lambda: self._lift(height))

    def hold(self, place: Sequence[float] | None) -> None:
        """Draw the centre of the first body to a place [m], in the room's axes; None lets go."""
        self._tell(lambda: setattr(self, "_hand", None if place is None else np.array(place, float)))

    def add(self, body: State, law: Law, dt: float) -> None:
        """Put another body at rest above all others; where there is no room or no common step the snapshot says so."""
        self._tell(lambda: self._add(body, law, dt))

    def to_box(self, vector: Sequence[float]) -> np.ndarray:
        """A direction of the room in the axes of the box."""
        return self.floor.T @ np.asarray(vector, float)

    def place_in_box(self, place: Sequence[float]) -> np.ndarray:
        """A point of the room in the coordinates of the box, which turns about `PIVOT`."""
        return self.to_box(np.asarray(place, float) - PIVOT) + PIVOT

    def _tell(self, command: Callable[[], None]) -> None:
        def obeyed() -> None:
            self._notice = None
            command()

        self._commands.put(obeyed)

    # ---- in the thread -----------------------------------------------------------------------------------------------

    @property
    def model(self) -> MPMModel:
        """Constants of the next steps; the time step is the smallest that a law was learned at."""
        gravity = self.to_box((0.0, -self._strength, 0.0))
        return MPMModel(**self._constants, dt=min(self._dts), gravity=tuple(gravity.tolist()))

    def _loop(self) -> None:
        due = time.perf_counter()
        while not self._closing:
            due = min(due, time.perf_counter())
            while not self._commands.empty():
                self._obey(self._commands.get())
            moving, before = self._running and not self._trouble, self._time
            if moving:
                try:
                    self._advance()
                except (InputError, NonFiniteError) as error:
                    self._trouble = str(error)
                except Exception as error:  # whatever a law from elsewhere does, a reset has to work
                    self._trouble = f"{type(error).__name__}: {error}"
            self._measure()
            self._publish()
            # a frame lasts as long as what it simulates; of the time by which one is late, the next make up one frame
            now = time.perf_counter()
            due = max(due + self._time - before, now - FRAME) if moving else now + IDLE
            self._rest(due, moving)

    def _obey(self, command: Callable[[], None]) -> None:
        """Carry out a command; one that cannot be leaves everything as it is."""
        try:
            command()
        except InputError as error:
            self._notice = str(error)

    def _rest(self, until: float, moving: bool) -> None:
        """Carry out commands until a time of the clock, or the first of them alone where nothing moves."""
        while (left := until - time.perf_counter()) > 0:
            try:
                self._obey(self._commands.get(timeout=left))
            except queue.Empty:
                return
            if not moving:
                return

    def _advance(self) -> None:
        """The steps of one frame: as many as real time asks for, or as can be computed in time."""
        model, began = self.model, time.perf_counter()
        wanted = max(1, round(FRAME / model.dt))
        steps = min(self._steps_a_frame, wanted)
        if self._hand is not None:
            self._follow_hand(steps * model.dt)
        with torch.no_grad():
            bodies = consecutive(self._laws, self._counts)
            path = rollout(model, bodies, self._state, steps=steps, frames=[steps], total=True)
        self._take(path)
        self._time += steps * model.dt
        each = (time.perf_counter() - began) / steps
        self._steps_a_frame = max(1, min(int(BUSY / each), 2 * self._steps_a_frame))

    def _take(self, path: Trajectory) -> None:
        x, v, F, C, total = (value[-1] for value in (path.x, path.v, path.F, path.C, path.F_total))
        for name, value in (("position", x), ("velocity", v), ("deformation", F)):
            if not value.isfinite().all():
                raise NonFiniteError("live", f"a {name} is not finite: the law diverges here")
        # the rollout counts the total deformation from the F that it began with
        self._total = total @ torch.linalg.solve(self._state.F, self._total)
        self._state = replace(self._state, x=x, v=v, F=F, C=C)

    def _measure(self) -> None:
        """Running means of the time between frames and of what is simulated in it: frames a second and pace are their
        ratios, which means of ratios would exceed where frames are uneven."""
        now = time.perf_counter()
        span, moved = now - self._measured, max(self._time - self._measured_time, 0.0)
        self._measured, self._measured_time = now, self._time
        self._span += _NEW * (span - self._span)
        self._moved += _NEW * (moved - self._moved)

    def _publish(self) -> None:
        state = self._state
        shown = (value.cpu() for value in (state.x, state.v.expand_as(state.x), state.F, self._total))
        snapshot = Snapshot(
            self._number, self._time, *shown,
            tuple(self._counts), min(self._dts), self._moved / self._span, 1 / self._span, self._trouble,
            self._notice,
        )  # fmt: skip
        self._number += 1
        with self._news:
            self._snapshot = snapshot
            self._news.notify_all()

    def _restart(self) -> None:
        self._state, self._counts = self._start, [len(self._start.x)]
        self._laws, self._dts = [self._first_law], [self._first_dt]
        self._total = _undeformed(self._start.x)
        self._time = self._measured_time = 0.0
        self._hand = self._trouble = None
        self._publish()

    def _weigh(self, weight: float) -> None:
        self._weight = float(weight)
        for law in self._laws:
            adapted = isinstance(law, AdaptableLaw) and all(part.adaptor for part in law.parts.values())
            if adapted and law.parts:
                law.set_adaptor_weight(self._weight)

    def _swap(self, law: Law, dt: float) -> None:
        _check_steps([law, *self._laws[1:]], [dt, *self._dts[1:]])
        self._first_law, self._first_dt = law, dt
        self._laws[0], self._dts[0] = law, dt
        self._weigh(self._weight)

    def _first(self) -> slice:
        return slice(0, self._counts[0])

    def _set_velocity(self, velocity: np.ndarray) -> None:
        """One velocity for the first body, in the axes of the box, at most `FASTEST`."""
        if not np.isfinite(velocity).all():
            raise InputError("throw: a velocity is not finite")
        velocity = velocity * min(1.0, FASTEST / max(float(np.linalg.norm(velocity)), 1e-9))
        state, own = self._state, self._first()
        v, C = state.v.expand_as(state.x).clone(), state.C.clone()
        v[own], C[own] = torch.from_numpy(velocity).to(v), 0.0
        self._state = replace(state, v=v, C=C)

    def _throw(self, velocity: Sequence[float]) -> None:
        self._hand = None
        self._set_velocity(self.to_box(velocity))

    def _follow_hand(self, span: float) -> None:
        model, x = self.model, self._state.x[self._first()]
        centre, half = x.mean(dim=0), 0.5 * (x.amax(dim=0) - x.amin(dim=0))
        margin = _GAP * model.dx + half.double().cpu().numpy()
        target = np.clip(self.place_in_box(self._hand), np.minimum(margin, 0.5), np.maximum(1 - margin, 0.5))
        self._set_velocity((target - centre.double().cpu().numpy()) / max(_HAND, span))

    def _lift(self, height: float) -> None:
        start, own = self._start, self._first()
        if not np.isfinite(height):
            raise InputError("drop: the height is not a number")
        low, high = (float(end) for end in torch.aminmax(start.x[:, 1]))
        highest = 1 - _GAP * self.model.dx - (high - low)
        lifted = start.x.clone()
        lifted[:, 1] += min(max(height, 0.0), max(highest, 0.0)) - low
        values = {name: getattr(self._state, name).clone() for name in ("x", "F", "C")}
        v = self._state.v.expand_as(self._state.x).clone()
        rest = _undeformed(lifted)
        values["x"][own], v[own], values["F"][own], values["C"][own] = lifted, 0.0, rest, 0.0
        total = self._total.clone()
        total[own] = rest
        self._state, self._total, self._hand = replace(self._state, v=v, **values), total, None
        if len(self._counts) == 1:
            self._trouble = None  # nothing is left of what diverged

    def _add(self, body: State, law: Law, dt: float) -> None:
        _check_steps([*self._laws, law], [*self._dts, dt])
        gap = _GAP * self.model.dx
        low, high = body.x.amin(dim=0), body.x.amax(dim=0)
        floor = float(self._state.x[:, 1].max()) + gap
        if floor + float(high[1] - low[1]) > 1 - gap:
            raise InputError("no room above what is there: reset, or wait until it lies lower")
        shift = 0.5 - 0.5 * (low + high)
        shift[1] = floor - low[1]
        added = replace(body, x=body.x + shift, v=torch.zeros_like(body.x), F=None, C=None)
        self._state = State.joined([self._state, added])
        self._total = torch.cat([self._total, _undeformed(body.x)])
        self._counts, self._laws, self._dts = (
            [*self._counts, len(body.x)],
            [*self._laws, law],
            [*self._dts, dt],
        )
        self._weigh(self._weight)
