"""Interactive simulation in a background thread.

Other threads put commands into a queue, which are executed between two frames, and read the last `Snapshot`. Lengths
are metres in the simulated box. A tilt of the floor rotates gravity in the opposite direction; the display rotates the
box (`LiveSimulation.floor`).
"""

from __future__ import annotations

import functools
import queue
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from neuma_lib.errors import InputError, NonFiniteError
from neuma_lib.io.exported import SAME_STEP
from neuma_lib.mechanics.adaptor import AdaptableLaw
from neuma_lib.mechanics.law import Law
from neuma_lib.mechanics.time_step import step_dependence
from neuma_lib.sim.model import MPM, consecutive, with_fields
from neuma_lib.sim.rollout import rollout
from neuma_lib.sim.state import State, Trajectory

FRAME = 1 / 30  # target time between two frames [s], rounded to steps
BUSY = 0.06  # maximum computing time of a frame [s]: more than ten frames per second, with time to draw
PIVOT = np.array([0.5, 0.0, 0.5])  # centre of the box's rotation, on the floor [m]
IDLE = 0.2  # time between updates of a paused simulation [s]
EARTH = 9.8
MAX_SPEED = 10.0  # maximum speed of a launched or held body [m/s]
_HAND = 0.08  # time in which a held body reaches the pointer [s]
_NEW = 0.2  # weight of the last frame in running means
_GAP = 1.5  # distance of an added body from others and from the walls [cells]


@dataclass(frozen=True)
class Snapshot:
    """State of a live simulation.

    Attributes:
        number: of the frame, from 0, increasing.
        time: simulated time since the last reset [s].
        x, v, F, total: positions [m], velocities [m/s], elastic and total deformation gradients of all particles, on
            the CPU.
        counts: number of particles of each body.
        dt: time step [s].
        pace: simulated over real time.
        rate: frames per second.
        trouble: error that stopped the simulation until a reset, or None.
        notice: reason why the last command was rejected, or None.
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
    """Check that bodies can share the smallest time step of their laws' trainings.

    Raises:
        InputError: a law trained at a longer step depends on it (`step_dependence`).
    """
    smallest = min(dts)
    for law, dt in zip(laws, dts, strict=True):
        if dt - smallest > SAME_STEP * smallest and step_dependence(law) != "none":
            raise InputError(
                f"law {law.name}",
                f"was trained at a time step of {1e3 * dt:g} ms and is another material at {1e3 * smallest:g} ms, the "
                "time step of all bodies",
                "Use reset, which leaves one body, or a law of the same time step",
            )


def tilted(about_x: float, about_z: float) -> np.ndarray:
    """Rotation (3, 3) of a box with its floor tilted about the axes x and z [degrees]."""
    return Rotation.from_euler("xz", [about_x, about_z], degrees=True).as_matrix()


def _queued(command: Callable[..., None]) -> Callable[..., None]:
    """Decorate a method to be executed by the simulation's thread between two frames."""

    @functools.wraps(command)
    def enqueue(self: LiveSimulation, *args) -> None:
        def run() -> None:
            self._notice = None
            command(self, *args)

        self._commands.put(run)

    return enqueue


class LiveSimulation:
    """Bodies in the box, simulated by a thread.

    Args:
        constants: arguments of `MPM`; dt, gravity and clamps are ignored.
        start: initial state of the first body, restored by a reset. The simulation runs on its device.
        law: of the first body, on the same device.
        dt: time step of the law's training [s].

    Attributes:
        floor: rotation (3, 3) of the box.
        snapshot: the last one.
    """

    def __init__(self, constants: Mapping[str, Any], start: State, law: Law, dt: float):
        self._constants = {
            key: value for key, value in constants.items() if key not in ("dt", "gravity", "clamps")
        }
        self._start, self._first_law, self._first_dt = start, law, dt
        self._strength, self.floor = EARTH, np.eye(3)
        self._weight = 1.0
        self._commands: queue.SimpleQueue[Callable[[], None]] = queue.SimpleQueue()
        self._news, self._closing = threading.Condition(), False
        self._running, self._hand, self._trouble, self._notice = True, None, None, None
        self._number, self._steps_per_frame, self._span, self._moved = 0, 1, FRAME, 0.0
        self._measured = time.perf_counter()
        self._restart()
        self._thread = threading.Thread(target=self._loop, name="live simulation", daemon=True)

    # ---- from any thread ---------------------------------------------------------------------------------------------

    def open(self) -> LiveSimulation:
        """Start the thread."""
        self._thread.start()
        return self

    def close(self) -> None:
        """End the thread after the current frame."""
        self._closing = True
        self._commands.put(lambda: None)
        self._thread.join(timeout=10)

    def wait(self, number: int, timeout: float = 10.0) -> Snapshot:
        """Wait for a snapshot with at least this number, or return the last one after a timeout [s]."""
        with self._news:
            self._news.wait_for(lambda: self.snapshot.number >= number, timeout)
            return self.snapshot

    def do(self, timeout: float = 10.0) -> Snapshot:
        """Wait until all previous commands are executed, and return the next snapshot."""
        reached: queue.SimpleQueue[int] = queue.SimpleQueue()
        self._commands.put(lambda: reached.put(self._number))
        try:
            return self.wait(reached.get(timeout=timeout), timeout)
        except queue.Empty:
            return self.snapshot

    @_queued
    def reset(self) -> None:
        """Restore the initial state of the first body alone. Gravity, floor, law and weight stay as set."""
        self._restart()

    @_queued
    def run(self, running: bool) -> None:
        """Continue or pause."""
        self._running = running

    @_queued
    def set_gravity(self, strength: float) -> None:
        """Set the gravity, downwards in the room [m/s^2]."""
        self._strength = float(strength)

    @_queued
    def set_floor(self, about_x: float, about_z: float) -> None:
        """Tilt the box about two axes [degrees]."""
        self.floor = tilted(about_x, about_z)

    @_queued
    def set_weight(self, weight: float) -> None:
        """Set the weight of the adaptors: 0 is the prior, 1 as trained. Has no effect on laws without one."""
        self._weight = float(weight)
        self._apply_weight()

    @_queued
    def set_law(self, law: Law, dt: float) -> None:
        """Change the law of the first body; ``dt`` is the time step of its training [s].

        Rejected with a notice if other bodies cannot use that step (`_check_steps`).
        """
        _check_steps([law, *self._laws[1:]], [dt, *self._dts[1:]])
        self._first_law, self._first_dt = law, dt
        self._laws[0], self._dts[0] = law, dt
        self._apply_weight()
        self._apply_fields()

    @_queued
    def launch(self, velocity: Sequence[float]) -> None:
        """Set a uniform velocity of the first body [m/s], in the room's axes, of at most `MAX_SPEED`."""
        self._hand = None
        self._set_velocity(self.to_box(velocity))
        if (speed := float(np.linalg.norm(velocity))) > MAX_SPEED:
            self._notice = f"The speed of {speed:.3g} m/s is limited to {MAX_SPEED:g} m/s."

    @_queued
    def drop(self, height: float) -> None:
        """Move the first body, undeformed and at rest, to a height above the floor [m], below the ceiling."""
        if not np.isfinite(height):
            raise InputError("height", "is not a number")
        start, own = self._start, self._first()
        low, high = (float(end) for end in torch.aminmax(start.x[:, 1]))
        highest = 1 - _GAP * self.model.dx - (high - low)
        lifted = start.x.clone()
        reached = min(max(height, 0.0), max(highest, 0.0))
        lifted[:, 1] += reached - low
        state, rest = self._state, _undeformed(lifted)
        old = (state.x, state.v.expand_as(state.x), state.F, state.C, state.stuck, self._total)
        x, v, F, C, stuck, total = (array.clone() for array in old)
        x[own], v[own], F[own], C[own], stuck[own], total[own] = lifted, 0.0, rest, 0.0, 0.0, rest
        self._state = replace(state, x=x, v=v, F=F, C=C, stuck=stuck)
        self._total, self._hand = total, None
        if len(self._counts) == 1:
            self._trouble = None  # the diverged state is gone
        if height > reached:
            self._notice = f"The height of {height:.3g} m is limited to {reached:.2f} m by the ceiling."

    @_queued
    def hold(self, place: Sequence[float] | None) -> None:
        """Pull the centre of the first body to a point [m], in the room's axes; None releases it."""
        place = None if place is None else np.array(place, float)
        if place is not None and not (place.shape == (3,) and np.isfinite(place).all()):
            raise InputError("hold", f"{place} is not a point")
        self._hand = place

    @_queued
    def add(self, body: State, law: Law, dt: float) -> None:
        """Add a body at rest above all others. Rejected with a notice if there is no space or no common time step."""
        _check_steps([*self._laws, law], [*self._dts, dt])
        gap = _GAP * self.model.dx
        low, high = body.x.amin(dim=0), body.x.amax(dim=0)
        floor = float(self._state.x[:, 1].max()) + gap
        if floor + float(high[1] - low[1]) > 1 - gap:
            raise InputError("add", "there is no room above the other bodies", "Reset, or wait")
        shift = 0.5 - 0.5 * (low + high)
        shift[1] = floor - low[1]
        added = replace(body, x=body.x + shift, v=torch.zeros_like(body.x), F=None, C=None, stuck=None)
        self._state = State.joined([self._state, added])
        self._total = torch.cat([self._total, _undeformed(body.x)])
        self._counts, self._laws = [*self._counts, len(body.x)], [*self._laws, law]
        self._dts = [*self._dts, dt]
        self._at_rest.append(added)
        self._apply_fields()
        self._apply_weight()

    def to_box(self, vector: Sequence[float]) -> np.ndarray:
        """A direction of the room in the axes of the box."""
        return self.floor.T @ np.asarray(vector, float)

    def place_in_box(self, place: Sequence[float]) -> np.ndarray:
        """A point of the room in the coordinates of the box, which is rotated about `PIVOT`."""
        return self.to_box(np.asarray(place, float) - PIVOT) + PIVOT

    # ---- in the thread -----------------------------------------------------------------------------------------------

    @property
    def model(self) -> MPM:
        """Model of the next steps, with the smallest time step of the laws' trainings."""
        gravity = self.to_box((0.0, -self._strength, 0.0))
        moved = tuple(each.later(self._time) for each in self._constants.get("colliders", ()))
        constants = {**self._constants, "colliders": moved}
        return MPM(**constants, dt=min(self._dts), gravity=tuple(gravity.tolist()))

    def _loop(self) -> None:
        due = time.perf_counter()
        while not self._closing:
            due = min(due, time.perf_counter())
            while not self._commands.empty():
                self._execute(self._commands.get())
            moving, before = self._running and not self._trouble, self._time
            if moving:
                try:
                    self._advance()
                except InputError as error:
                    self._trouble = str(error)
                except Exception as error:  # a reset must work whatever error a law raises
                    self._trouble = f"{type(error).__name__}: {error}"
            self._measure()
            self._publish()
            # a frame takes as long as its simulated time; later frames compensate a delay of at most one frame
            now = time.perf_counter()
            due = max(due + self._time - before, now - FRAME) if moving else now + IDLE
            self._rest(due, moving)

    def _execute(self, command: Callable[[], None]) -> None:
        """Execute a command; a rejected one has no effect."""
        try:
            command()
        except InputError as error:
            self._notice = str(error)
        except Exception as error:  # a command must not end the thread
            self._notice = f"{type(error).__name__}: {error}"

    def _rest(self, until: float, moving: bool) -> None:
        """Execute commands until a time of the clock, or only one command if nothing moves."""
        while (left := until - time.perf_counter()) > 0:
            try:
                self._execute(self._commands.get(timeout=left))
            except queue.Empty:
                return
            if not moving:
                return

    def _advance(self) -> None:
        """Simulate one frame: as many steps as in real time, or fewer if they take too long."""
        model, began = self.model, time.perf_counter()
        steps = min(self._steps_per_frame, max(1, round(FRAME / model.dt)))
        if self._hand is not None:
            self._follow_hand(steps * model.dt)
        try:
            self._take(self._simulated(steps))
        except NonFiniteError as error:
            self._trouble = self._diverged(error)
            return
        self._time += steps * model.dt
        each = (time.perf_counter() - began) / steps
        self._steps_per_frame = max(1, min(int(BUSY / each), 2 * self._steps_per_frame))

    def _simulated(self, steps: int) -> Trajectory:
        bodies = consecutive(self._laws, self._counts)
        with torch.no_grad():
            return rollout(self.model, bodies, self._state, steps=steps, frames=[steps], total=True)

    def _diverged(self, error: NonFiniteError) -> str:
        """The body that diverged, its law, and what the user can change.

        The first particle that leaves may be of a body in contact. The cause is the body with the largest stress per
        density, and thus acceleration, in the last valid step.
        """
        state, steps = self._state, (error.step or 1) - 1
        F = self._simulated(steps).F[-1] if steps else state.F
        pulls = []
        for law, own, density in zip(
            self._laws, F.split(self._counts), state.density.split(self._counts), strict=True
        ):
            with torch.no_grad():
                stress = law.elasticity.evaluate(own, law.elasticity.weights()).flatten(1).norm(dim=1)
            pulls.append(float((stress / density).nan_to_num(nan=torch.inf).max()))
        body = int(np.argmax(pulls))
        law, dt = self._laws[body].name, 1e3 * min(self._dts)
        return (
            f"Body {body + 1} is unstable under the law '{law}': a particle {error.happened}. Lower the speed, the "
            f"height or the gravity, or choose a softer law. A smaller time step than {dt:g} ms needs a law that is "
            "trained with it (dt of its scene in the settings)."
        )

    def _take(self, path: Trajectory) -> None:
        for name, value in (("position", path.x), ("velocity", path.v), ("deformation", path.F)):
            if not value[-1].isfinite().all():
                raise NonFiniteError("live", f"a {name} is not finite")
        # the total deformation of the rollout starts from the initial F
        self._total = path.F_total[-1] @ torch.linalg.solve(self._state.F, self._total)
        self._state = self._state.after(path)

    def _measure(self) -> None:
        """Update running means of real and simulated time per frame. Frame rate and pace are ratios of these means,
        which mean ratios would overestimate for uneven frames."""
        now = time.perf_counter()
        span, moved = now - self._measured, max(self._time - self._measured_time, 0.0)
        self._measured, self._measured_time = now, self._time
        self._span += _NEW * (span - self._span)
        self._moved += _NEW * (moved - self._moved)

    def _publish(self) -> None:
        state = self._state
        arrays = (value.cpu() for value in (state.x, state.v.expand_as(state.x), state.F, self._total))
        snapshot = Snapshot(
            self._number, self._time, *arrays,
            tuple(self._counts), min(self._dts), self._moved / self._span, 1 / self._span, self._trouble,
            self._notice,
        )  # fmt: skip
        self._number += 1
        with self._news:
            self.snapshot = snapshot
            self._news.notify_all()

    def _restart(self) -> None:
        self._state, self._counts = self._start, [len(self._start.x)]
        self._laws, self._dts, self._at_rest = [self._first_law], [self._first_dt], [self._start]
        self._apply_fields()
        self._total = _undeformed(self._start.x)
        self._time = self._measured_time = 0.0
        self._hand = self._trouble = None
        self._publish()

    def _apply_fields(self) -> None:
        at_rest = with_fields(State.joined(self._at_rest), consecutive(self._laws, self._counts))
        self._state = replace(self._state, stiffness=at_rest.stiffness)

    def _apply_weight(self) -> None:
        for law in self._laws:
            adapted = isinstance(law, AdaptableLaw) and all(part.adaptor for part in law.parts.values())
            if adapted and law.parts:
                law.set_adaptor_weight(self._weight)

    def _first(self) -> slice:
        return slice(0, self._counts[0])

    def _set_velocity(self, velocity: np.ndarray) -> None:
        """Set a uniform velocity of the first body, in the axes of the box, limited to `MAX_SPEED`."""
        if not np.isfinite(velocity).all():
            raise InputError("velocity", "is not finite")
        velocity = velocity * min(1.0, MAX_SPEED / max(float(np.linalg.norm(velocity)), 1e-9))
        state, own = self._state, self._first()
        v, C = state.v.expand_as(state.x).clone(), state.C.clone()
        v[own], C[own] = torch.from_numpy(velocity).to(v), 0.0
        self._state = replace(state, v=v, C=C)

    def _follow_hand(self, span: float) -> None:
        model, x = self.model, self._state.x[self._first()]
        centre, half = x.mean(dim=0), 0.5 * (x.amax(dim=0) - x.amin(dim=0))
        margin = _GAP * model.dx + half.double().cpu().numpy()
        target = np.clip(self.place_in_box(self._hand), np.minimum(margin, 0.5), np.maximum(1 - margin, 0.5))
        self._set_velocity((target - centre.double().cpu().numpy()) / max(_HAND, span))
