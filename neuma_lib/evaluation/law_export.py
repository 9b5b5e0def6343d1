"""Export a law and its metadata to one file, with a model card next to it, and read them."""

import subprocess
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import torch

from neuma_lib.errors import InputError
from neuma_lib.evaluation.law_card import law_card
from neuma_lib.evaluation.material_point import Visited, largest_shear_stress
from neuma_lib.evaluation.stress import deformed_frames
from neuma_lib.extras import require
from neuma_lib.io.exported import about_law, read_about
from neuma_lib.io.files import read_json, write_text
from neuma_lib.io.hdf5 import read_arrays
from neuma_lib.io.laws import load_law, save_law
from neuma_lib.mechanics.law import Law


def export_law(
    path: str | Path,
    law: Law,
    dt: float | None,
    separate_adaptor: bool = False,
    any_time_step: bool = False,
    metrics: str | Path | None = None,
    rollout: str | Path | None = None,
    page: str | Path | None = None,
    **known: Any,
) -> dict[str, Any]:
    """Write a law, its metadata, and its model card (`neuma_lib.evaluation.law_card`).

    Args:
        path: ``.safetensors``. The card has the same name with ``.md``.
        dt: time step that it was learned at [s].
        separate_adaptor, any_time_step: see `save_law` and `about_law`.
        metrics, rollout: metrics.json and rollout.h5 of its method, or None.
        page: file for the picture of `neuma_lib.evaluation.law_page`.
        known: further keys of `neuma_lib.io.exported`.

    Returns:
        the metadata.

    Raises:
        InputError: another suffix, unreadable files, or no adaptor to keep separate. Nothing is written then.
    """
    if Path(path).suffix != ".safetensors":
        raise InputError(path, "the suffix is not .safetensors", "Give the file that suffix")
    if metrics is not None:
        known["metrics"] = _numbers(read_json(metrics))
    if rollout is not None:
        arrays, _ = read_arrays(rollout, required=("F",), only=("F",))
        known["visited"] = visited_by(law, torch.from_numpy(arrays["F"]))
    about = about_law(law, dt, any_time_step, **known)
    write_page = _drawn(law, about, page) if page else None
    save_law(path, law, about, separate_adaptor)
    write_text(Path(path).with_suffix(".md"), law_card(about))
    if write_page is not None:
        write_page()
    return about


def show_law(path: str | Path, page: str | Path | None = None) -> dict[str, Any]:
    """Metadata of a law's file. Draws its page if ``page`` is given."""
    about = read_about(path)
    if page is not None:
        _drawn(load_law(path), about, page)()
    return about


def _drawn(law: Law, about: Mapping[str, Any], page: str | Path) -> Callable[[], None]:
    """Draw a law's page and return the function that writes it. Raises InputError if matplotlib is missing."""
    require("matplotlib", "workflow")
    from neuma_lib.evaluation.law_page import law_page
    from neuma_lib.evaluation.plotting import style

    return partial(style.save, law_page(law, about), page)


def visited_by(law: Law, F: torch.Tensor) -> dict[str, Any] | None:
    """Ranges of the elastic deformation gradients F (T, N, 3, 3) of a motion, from the first deformed frame on.

    Returns:
        ``stretch``, ``shear``, ``pressed`` (`Visited`) and ``shear_stress``, the largest [Pa]. None if undeformed.
    """
    deformed = deformed_frames(F)
    if not deformed.any():
        return None
    F = F[int(deformed.int().argmax()) :].reshape(-1, 3, 3)
    return {**vars(Visited.of(F)), "shear_stress": largest_shear_stress(law, F)}


def head_commit(root: str | Path) -> str | None:
    """The commit of a project, followed by "+" if files differ from it. None without git."""

    def git(*words: str) -> str:
        command = ["git", "-C", root, *words]
        return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()

    try:
        changes = git("status", "--porcelain", "--untracked-files=no")
        return git("rev-parse", "HEAD") + ("+" if changes else "")
    except (OSError, subprocess.CalledProcessError):
        return None


def _numbers(metrics: Any) -> dict[str, Any] | None:
    """Scalars of a metrics.json, without curves."""
    kept = (int, float, bool)
    return {k: v for k, v in metrics.items() if type(v) in kept} if isinstance(metrics, dict) else None
