"""Interactive simulation of a reconstructed body: the live simulation, its laws, and the bound Gaussians."""

import threading
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from neuma_lib.coupling.bodies import BODY_COLOURS, coloured_solid, join
from neuma_lib.coupling.deformation import arms_at_rest, deform
from neuma_lib.coupling.reconstruction import Reconstruction
from neuma_lib.errors import InputError, NonFiniteError
from neuma_lib.geometry.shapes import place
from neuma_lib.geometry.volume import sample_volume
from neuma_lib.io.particles import load_reconstruction, with_motion
from neuma_lib.io.simulator import with_obstacles
from neuma_lib.mechanics.law import Law
from neuma_lib.methods.base import ModelSource
from neuma_lib.project.files import SceneFiles, inside
from neuma_lib.sim.model import MPM
from neuma_lib.sim.rollout import rollout
from neuma_lib.splatting.gaussians import Gaussians
from neuma_lib.viewer import scalars
from neuma_lib.viewer.live import LiveSimulation, Snapshot

ADDED_SIZE = 0.22  # longest side of an added solid [m]
ADDED_PARTICLES = 500


@dataclass(frozen=True)
class Picture:
    """Gaussians of a snapshot: means (G, 3) [m], covariances (G, 3, 3) [m^2], and the Gaussians at rest."""

    snapshot: Snapshot
    means: Tensor
    covars: Tensor
    gaussians: Gaussians


class Playground:
    """The live simulation of a scene's body.

    Args:
        files: of the scene.
        laws: available laws by name.
        chosen: initial law.
        device: of the simulation; Gaussians are deformed on the CPU.

    Attributes:
        names: of the bodies.

    Raises:
        InputError: files of the body or of the law are damaged or outside the permitted folders (`files.inside`).
    """

    def __init__(
        self,
        files: SceneFiles,
        laws: Mapping[str, ModelSource],
        chosen: str,
        device: torch.device | str = "cpu",
    ):
        self.laws, self.roots, self.device = dict(laws), files.roots, device
        paths = [files.checked(path) for path in (files.particles, files.binding, files.gaussians)]
        first = load_reconstruction(*paths, files.density, gaussian_motion="affine").to(torch.float32)
        if files.velocity:
            start = with_motion(first, files.checked(files.velocity))
        else:
            start = first.state((0.0, 0.0, 0.0))
        self._density = (
            files.density if isinstance(files.density, int | float) else float(start.density.mean())
        )
        self._bodies, self._whole, self.names = [first], [first], [files.name]
        self._arms: dict[int, Tensor] = {}
        self._loaded: dict[str, Law] = {}
        self._constants, self._start = with_obstacles(files.simulation), start.to(device)
        self._constants.pop("clamps", None)  # the user holds the body
        self._changing = threading.Lock()
        self.chosen = chosen
        self.simulation = LiveSimulation(self._constants, self._start, self.law(chosen), self.laws[chosen].dt)

    def law(self, name: str) -> Law:
        """A law by name, loaded on first use."""
        if name not in self.laws:
            raise InputError("law", f"'{name}' is unknown", f"Choose one of {', '.join(self.laws)}")
        if name not in self._loaded:
            law = self.laws[name].load(self._checked).law.requires_grad_(False).to(self.device)
            law.name = name  # messages name it as the list of laws does
            self._try(law, self.laws[name].dt)
            self._loaded[name] = law
        return self._loaded[name]

    def _try(self, law: Law, dt: float) -> None:
        """Take one step to load kernels, because Warp must not load them in the simulating and the drawing thread at
        the same time."""
        model = MPM(**{**self._constants, "dt": dt})
        with torch.no_grad(), suppress(NonFiniteError):  # the simulation reports it
            rollout(model, law, self._start, steps=1, frames=[1], total=True, skip_free_flight=False)

    def _checked(self, path: str | Path) -> Path:
        return inside(path, self.roots)

    def choose(self, name: str) -> str | None:
        """Change the law of the first body without changing its state. Returns the reason if it is impossible."""
        law = self.law(name)
        with self._changing:
            self.simulation.set_law(law, self.laws[name].dt)
            notice = self.simulation.do().notice
        if notice is None:
            self.chosen = name
        return notice

    def reset(self) -> None:
        """Restore the first body at its initial state, and remove all others."""
        with self._changing:
            self.simulation.reset()
            self.simulation.do()
            del self._bodies[1:], self._whole[1:], self.names[1:]

    def add(self, shape: str) -> str | None:
        """Drop a solid with the current law onto the others. Returns the reason if it is impossible."""
        mesh = place(shape, ADDED_SIZE, 0.5, (0.5, 0.5), resolution=48)
        x0 = torch.from_numpy(sample_volume(mesh, ADDED_PARTICLES)).float()
        with self._changing:
            colour = torch.tensor(BODY_COLOURS[len(self._bodies) % len(BODY_COLOURS)])
            body = coloured_solid(mesh, x0, self._density, colour.expand(len(x0), 3))
            self._bodies.append(body)
            self.names.append(shape)
            self._whole.append(join(self._bodies))
            at_rest = body.state((0.0, 0.0, 0.0)).to(self.device)
            self.simulation.add(at_rest, self.law(self.chosen), self.laws[self.chosen].dt)
            notice = self.simulation.do().notice
            if notice:
                del self._bodies[-1], self._whole[-1], self.names[-1]
        return notice

    def picture(self, snapshot: Snapshot, flow: bool = False) -> Picture:
        """The Gaussians of a snapshot; with ``flow`` stretched by the total, not the elastic deformation."""
        index = len(snapshot.counts) - 1
        whole: Reconstruction = self._whole[min(index, len(self._whole) - 1)]
        x, F = snapshot.x, snapshot.total if flow else snapshot.F
        if len(whole.x0) < len(x):  # a body has just been removed
            x, F = x[: len(whole.x0)], F[: len(whole.x0)]
        g = whole.gaussians
        if id(whole) not in self._arms:
            self._arms = {id(whole): arms_at_rest(g.means, whole.binding, whole.x0)}
        arms = self._arms[id(whole)]
        means, covars = deform(g.means, g.covars(), whole.binding, whole.x0, x[None], F[None], arms=arms)
        return Picture(snapshot, means[0], covars[0], g)

    def values(self, snapshot: Snapshot, name: str) -> Tensor:
        """A quantity of `Motion.scalars` for all particles; stresses by the law of the first body."""
        if name == "body":
            return torch.arange(len(snapshot.counts)).repeat_interleave(torch.tensor(snapshot.counts))
        if name == "speed":
            return snapshot.v.norm(dim=-1)
        if name == "plastic_strain":
            return scalars.plastic_strain(snapshot.F, snapshot.total)
        if name == "volume_ratio":
            return scalars.volume_ratio(snapshot.F)
        return scalars.von_mises(self.law(self.chosen), snapshot.F.to(self.device)).cpu()


def first_law(
    files: SceneFiles, laws: Mapping[str, ModelSource], preferred: Sequence[str] = ("neuma",)
) -> str:
    """Initial law of a scene's playground: that of one of its methods, or else the first.

    Raises:
        InputError: there is none.
    """
    own = {run.name: run.law for run in files.runs if run.law is not None}
    for law in (*(own.get(name) for name in preferred), *own.values()):
        names = [name for name, each in laws.items() if each == law]
        if names:
            return names[0]
    if not laws:
        raise InputError(files.name, "has no trained law", "Train one, for example with the method neuma")
    return next(iter(laws))
