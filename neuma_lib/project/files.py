"""The files that a viewer reads, and access control for them."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from neuma_lib.errors import InputError
from neuma_lib.io.files import existing
from neuma_lib.methods.base import ModelSource


@dataclass(frozen=True)
class RunFiles:
    """A predicted motion."""

    # name, title: of the method
    name: str
    title: str
    rollout: str  # file of the motion
    law: ModelSource | None  # source of its law; None: the motion follows from no law
    gaussian_motion: str = "mean"  # how Gaussians follow their particles


@dataclass(frozen=True)
class SceneFiles:
    """The files of a scene."""

    name: str  # the scene, with the seeds of its replicate
    simulation: dict[str, Any]  # arguments of `MPM`
    density: Any  # of the body, as for `load_reconstruction`
    # particles, binding, gaussians, velocity: files of the reconstructed body
    particles: str
    binding: str
    gaussians: str
    velocity: str | None
    # truth, transforms: files of the true motion and of the observed images, or None
    truth: str | None
    transforms: str | None
    runs: tuple[RunFiles, ...]  # predicted motions
    roots: tuple[str, ...]  # folders that may be read; other files, and links to them, are rejected

    @property
    def files(self) -> list[str]:
        """All files except the images, without duplicates."""
        body = (self.particles, self.binding, self.gaussians, self.velocity, self.truth, self.transforms)
        laws = [file for run in self.runs for file in (run.rollout, *(run.law.paths if run.law else ()))]
        return list(dict.fromkeys([*filter(None, body), *laws]))

    def plain(self) -> dict[str, Any]:
        """Dicts, lists and scalars; inverse of `of_plain`."""
        return asdict(self)

    @classmethod
    def of_plain(cls, plain: Mapping[str, Any]) -> "SceneFiles":
        """Inverse of `plain`."""
        runs = (RunFiles(**{**run, "law": run["law"] and ModelSource(**run["law"])}) for run in plain["runs"])
        return cls(**{**plain, "runs": tuple(runs), "roots": tuple(plain["roots"])})

    def checked(self, path: str | Path) -> Path:
        """Resolved path of a file in the folders. Raises InputError if it is missing or outside of them."""
        return inside(path, self.roots)


def inside(path: str | Path, roots: Sequence[str | Path]) -> Path:
    """Path of a file with links resolved. Raises InputError if it does not exist or is outside all folders."""
    resolved = existing(path).resolve()
    if not any(resolved.is_relative_to(Path(root).resolve()) for root in roots):
        problem = f"is outside {' and '.join(map(str, roots))}, the only folders that the viewer reads"
        raise InputError(path, problem, "Copy it there")
    return resolved
