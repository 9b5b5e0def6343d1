"""Which files a viewer reads, and that it reads no others."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from neuma_lib.errors import InputError
from neuma_lib.io.files import existing
from neuma_lib.methods.base import ModelSource


@dataclass(frozen=True)
class RunFiles:
    """A predicted motion.

    Attributes:
        name, title: of the method.
        rollout: file of the motion.
        law: what its law is loaded from. None: it follows from no law.
        gaussian_motion: how Gaussians follow their particles.
    """

    name: str
    title: str
    rollout: str
    law: ModelSource | None
    gaussian_motion: str = "mean"


@dataclass(frozen=True)
class SceneFiles:
    """All that is shown of a scene.

    Attributes:
        name: the scene, with the seeds of its chain.
        simulation: constants of the simulator, as `MPMModel` takes them.
        density: of the body, as `load_body` takes it.
        particles, binding, gaussians, velocity: files of the reconstructed body.
        truth, transforms: files of the true motion and of the observed images, or None.
        runs: predicted motions.
        roots: folders below which files may be read; others, and links to others, are refused.
    """

    name: str
    simulation: dict[str, Any]
    density: Any
    particles: str
    binding: str
    gaussians: str
    velocity: str | None
    truth: str | None
    transforms: str | None
    runs: tuple[RunFiles, ...]
    roots: tuple[str, ...]

    @property
    def files(self) -> list[str]:
        """Every file but the images, each once."""
        body = (self.particles, self.binding, self.gaussians, self.velocity, self.truth, self.transforms)
        laws = [file for run in self.runs for file in (run.rollout, *(run.law.paths if run.law else ()))]
        return list(dict.fromkeys([*filter(None, body), *laws]))

    def plain(self) -> dict[str, Any]:
        """Dicts, lists and scalars; `of_plain` undoes it."""
        return asdict(self)

    @classmethod
    def of_plain(cls, plain: Mapping[str, Any]) -> SceneFiles:
        """What `plain` gave."""
        runs = (RunFiles(**{**run, "law": run["law"] and ModelSource(**run["law"])}) for run in plain["runs"])
        return cls(**{**plain, "runs": tuple(runs), "roots": tuple(plain["roots"])})

    def checked(self, path: str | Path) -> Path:
        """A file that may be read.

        Raises:
            InputError: it does not exist, or lies outside the folders.
        """
        return inside(path, self.roots)


def inside(path: str | Path, roots: Sequence[str | Path]) -> Path:
    """A file with all links followed. Raises InputError where there is none, or it lies outside all of the folders."""
    found = existing(path).resolve()
    if not any(found.is_relative_to(Path(root).resolve()) for root in roots):
        allowed = " and ".join(map(str, roots))
        raise InputError(f"{path} lies outside {allowed}: the viewer reads only below these; copy it there")
    return found
