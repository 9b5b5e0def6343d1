"""A law to pass on: what is known of it, and a page of what it says."""

from __future__ import annotations

import subprocess
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from matplotlib.figure import Figure

from neuma_lib.config.figures import FiguresConfig
from neuma_lib.errors import InputError
from neuma_lib.evaluation.figures.material_response import VISITED
from neuma_lib.evaluation.material_point import Visited, largest_shear_stress
from neuma_lib.evaluation.plotting import style
from neuma_lib.evaluation.response import tests_within
from neuma_lib.evaluation.stress import STRAINED
from neuma_lib.io.exported import about_law, read_about
from neuma_lib.io.files import one_line, read_json
from neuma_lib.io.hdf5 import read_arrays
from neuma_lib.io.laws import load_law, save_law
from neuma_lib.mechanics.law import Law

TESTS = {
    "uniaxial": ("axial stretch, sides free", "axial stress"),
    "shear": ("elastic shear", "shear stress"),
    "yield": ("total shear at {rate:g}/s", "shear stress"),
}
UNSEEN = Visited(stretch=(0.8, 1.2), shear=(-0.3, 0.3), pressed=1.0)
"""Range of the tests of a law of which nobody says what it went through."""


def export_law(
    path: str | Path,
    law: Law,
    dt: float | None,
    apart: bool = False,
    any_step: bool = False,
    metrics: str | Path | None = None,
    rollout: str | Path | None = None,
    page: str | Path | None = None,
    **known: Any,
) -> dict[str, Any]:
    """Write a law with what is known of it.

    Args:
        path: ``.safetensors``.
        dt: time step that it was learned at [s].
        apart, any_step: as of `save_law` and `about_law`.
        metrics, rollout: metrics.json and rollout.h5 of its method, or None.
        page: picture of `law_page`.
        known: further keys of `neuma_lib.io.exported`.

    Returns:
        what the file says of the law.

    Raises:
        InputError: another ending, files that cannot be read, ``apart`` without an adaptor. Nothing is written then.
    """
    if Path(path).suffix != ".safetensors":
        raise InputError(f"{path}: a law is written as .safetensors; name the file so")
    if metrics is not None:
        known["metrics"] = _numbers(read_json(metrics))
    if rollout is not None:
        arrays, _ = read_arrays(rollout, required=("F",), only=("F",))
        known["visited"] = visited_by(law, torch.from_numpy(arrays["F"]))
    about = about_law(law, dt, any_step, **known)
    figure = law_page(law, about) if page else None
    save_law(path, law, about, apart)
    if figure is not None:
        style.save(figure, page)
    return about


def show_law(path: str | Path, page: str | Path | None = None) -> dict[str, Any]:
    """What the file of a law says of it; draws its page if asked to."""
    about = read_about(path)
    if page is not None:
        style.save(law_page(load_law(path), about), page)
    return about


def visited_by(law: Law, F: torch.Tensor) -> dict[str, Any] | None:
    """Ranges of the elastic deformation gradients F (T, N, 3, 3) of a motion, from the first frame in which something
    is deformed: ``stretch``, ``shear``, ``pressed`` (`Visited`) and ``shear_stress``, the largest [Pa]. None if nothing
    ever is."""
    deformed = (F - torch.eye(3, dtype=F.dtype)).abs().flatten(1).amax(1) > STRAINED
    if not deformed.any():
        return None
    F = F[int(deformed.int().argmax()) :].reshape(-1, 3, 3)
    seen = Visited.of(F)
    return {**vars(seen), "shear_stress": largest_shear_stress(law, F)}


@style.styled
def law_page(law: Law, about: Mapping[str, Any]) -> Figure:
    """Three tests of a material point: uniaxial stretch, elastic shear, and shear at a constant rate with the return
    map; blue ground: what the law went through in its scene."""
    seen, largest = _ranges(about)
    settings, dt = FiguresConfig(), about.get("dt") or 1e-3
    tests = tests_within(seen, largest or 0.0, settings.shear_rate, settings.total_shear, dt)
    figure = style.new_figure(style.PAGE, 0.3 * style.PAGE)
    for axes, (name, (xlabel, ylabel)) in zip(figure.subplots(1, len(TESTS)), TESTS.items(), strict=True):
        test = tests[name]
        if largest is not None:
            low, high = (1e-3 * np.asarray(test.visited)) if test.by_stress else test.visited
            span = axes.axhspan if test.by_stress else axes.axvspan
            span(low, high, color=VISITED, linewidth=0, zorder=0)
        axes.plot(test.x, 1e-3 * test.curve(law, test.x), color=style.BLUE)
        axes.axhline(0, color=style.GREY, linewidth=0.4, zorder=0.5)
        axes.set(xlabel=xlabel.format(rate=settings.shear_rate), ylabel=f"{ylabel} [kPa]")
    where = " / ".join(one_line(about[key], 60) for key in ("scene", "method") if about.get(key)) or law.name
    step = f", learned at dt = {dt:g} s" if about.get("dt") else ""
    figure.suptitle(f"{where}: {one_line(about.get('kind'), 20)}{step}".replace("$", r"\$"))
    return figure


def head_commit(root: str | Path) -> str | None:
    """The commit of a project, with "+" behind it where files differ from it; None without git."""
    commands = ["rev-parse", "HEAD"], ["status", "--porcelain", "--untracked-files=no"]
    try:
        commit, changes = (
            subprocess.run(
                ["git", "-C", root, *words], capture_output=True, text=True, check=True
            ).stdout.strip()
            for words in commands
        )
    except (OSError, subprocess.CalledProcessError):
        return None
    return commit + ("+" if changes else "")


def _ranges(about: Mapping[str, Any]) -> tuple[Visited, float | None]:
    """Visited ranges and largest shear stress [Pa]; `UNSEEN` and None where they are not known."""
    found = about.get("visited")
    if found is None:
        return UNSEEN, None
    try:
        pairs = {key: tuple(map(float, found[key])) for key in ("stretch", "shear")}
        if not all(len(pair) == 2 and np.isfinite(pair).all() for pair in pairs.values()):
            raise ValueError
        return Visited(**pairs, pressed=float(found["pressed"])), float(found["shear_stress"])
    except (KeyError, TypeError, ValueError):
        raise InputError(
            f"the visited ranges in its metadata are not those of export-law: {one_line(found)}"
        ) from None


def _numbers(metrics: Any) -> dict[str, Any] | None:
    """Single numbers and truth values of a metrics.json; curves are left out."""
    kept = (int, float, bool)
    return {k: v for k, v in metrics.items() if type(v) in kept} if isinstance(metrics, dict) else None
