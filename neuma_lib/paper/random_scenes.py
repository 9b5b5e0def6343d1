"""The benchmark of random scenes: a row for each scene, and statistics over all."""

from collections.abc import Mapping, Sequence
from fractions import Fraction
from statistics import geometric_mean
from typing import Any

import numpy as np

from neuma_lib.errors import InputError
from neuma_lib.evaluation.text_tables import as_csv, as_markdown
from neuma_lib.paper.claims import RMSE, counted, verdict_lines
from neuma_lib.paper.tables import TRUE_LAW

CLOSE = 2.0  # maximum error of a velocity or spin that counts as right [%]
WITHIN = 2.0  # maximum error in estimated standard deviations
BETTER_SHARE, WITHIN_SHARE = Fraction(11, 12), Fraction(10, 12)  # claimed shares of the scenes

RULE = (
    "These claims count scenes, which are independent trials. A claim *holds* if the count is reached, else it *does "
    "not hold*."
)
"""Explanation of the verdicts for readers of the table."""


def failure(metrics: Mapping[str, Any]) -> str | None:
    """What failed in a run, from its metrics.json. None if nothing did."""
    if metrics["diverged"]:
        return f"a particle {metrics['diverged']['happened']} in step {metrics['diverged']['step']}"
    return None if metrics["stable"] else "its training diverged"


def random_table(
    scenes: Sequence[Mapping[str, Any]], titles: Mapping[str, str], seed: int, is_development: bool = False
) -> tuple[str, str, list[str]]:
    """CSV and Markdown with a row for each scene, and sentences on all scenes.

    Args:
        scenes: each with ``name``, ``family``, ``prior``, ``metrics`` {method: content of metrics.json} and ``start``,
            the content of initial_state.json.
        titles: method -> name. The first is the prior, the second the method that claims are about.
        is_development: whether methods are developed on these scenes. There are no verdicts then.

    Raises:
        InputError: there are no scenes.
    """
    if not scenes:
        raise InputError("random.count", "there are no random scenes", "Set it to a positive number")

    def start(key: str) -> np.ndarray:
        return np.array([scene["start"][key] for scene in scenes])

    rmse = {m: np.array([scene["metrics"][m][RMSE] for scene in scenes]) for m in titles}
    failed = [{m: what for m in titles if (what := failure(scene["metrics"][m]))} for scene in scenes]
    velocity, spin = start("velocity_error_in_plane_percent"), start("angular_velocity_error_viewing_percent")
    depth, depth_std = start("velocity_error_depth"), start("velocity_std_depth")
    depth_in_std = abs(depth) / depth_std
    # Of the axis of the camera with the largest error.
    spin_in_std = abs(start("angular_velocity_error_camera") / start("angular_velocity_std_camera")).max(1)
    prior, method, *_ = titles
    ratio, title = rmse[method] / rmse[prior], titles[method]
    columns = [
        ("scene", "scene", [scene["name"] for scene in scenes]),
        *((key, key, [scene[key] for scene in scenes]) for key in ("family", "prior")),
        *((f"{m}_rmse_mm", f"{titles[m]} (mm)", values) for m, values in rmse.items()),
        ("ratio", f"{title} / {titles[prior]}", ratio),
        ("velocity_error_in_plane_percent", "velocity in plane (%)", velocity),
        ("velocity_error_depth", "in depth (m/s)", depth),
        ("velocity_std_depth", "its estimated std", depth_std),
        ("velocity_error_depth_in_std", "in std", depth_in_std),
        ("spin_error_viewing_percent", "spin in plane (%)", spin),
        ("spin_error_percent", "spin (%)", start("angular_velocity_error_percent")),
        ("spin_error_in_std", "in std", spin_in_std),
        ("failures", "failures", ["; ".join(f"{titles[m]}: {what}" for m, what in row.items()) for row in failed]),
    ]  # fmt: skip

    def count(met: Sequence[bool]) -> str:
        return f"{sum(met)} of {len(scenes)}"

    medians = ", ".join(f"{np.median(values):.1f} mm ({titles[m]})" for m, values in rmse.items())
    sentences = [
        f"{title} is better than {titles[prior]} on {count(rmse[method] < rmse[prior])}; medians {medians}; "
        f"RMSE {geometric_mean(ratio):.2f} times as large (geometric mean).",
        f"A run failed on {count([bool(row) for row in failed])}.",
        f"Velocity in plane within {CLOSE:g} % on {count(velocity <= CLOSE)}, spin in plane on {count(spin <= CLOSE)}.",
        f"Error in depth within {WITHIN:g} estimated standard deviations on {count(depth_in_std <= WITHIN)}, "
        f"spin about every axis on {count(spin_in_std <= WITHIN)}.",
    ]
    if TRUE_LAW in titles:
        sentences.append(
            f"{title} is closer to the truth than the true law, simulated as the reconstruction is, on "
            f"{count(rmse[method] < rmse[TRUE_LAW])}: there it has absorbed discretisation, or errors of the start."
        )

    def claim(text: str, share: float | Fraction, met: Sequence[bool], numbers: str = ""):
        return counted(f"{text} on", met, share, "random scenes", numbers, whole="all")

    plane = np.maximum(velocity, spin)
    verdicts = [
        claim(
            f"{title} is closer than its prior",
            BETTER_SHARE,
            ratio < 1,
            f"errors {ratio.min():.2f} to {ratio.max():.2f} times as large",
        ),
        claim("no training diverges and no prediction breaks off", 1, [not row for row in failed]),
        claim(
            f"velocity and spin are within {CLOSE:g} % in plane",
            1,
            plane <= CLOSE,
            f"at most {plane.max():.2g} %",
        ),
        claim(
            f"the velocity in depth is within {WITHIN:g} estimated standard deviations",
            WITHIN_SHARE,
            depth_in_std <= WITHIN,
            f"at most {depth_in_std.max():.2g} of them",
        ),
    ]
    names, headings, values = zip(*columns)
    rows = list(zip(*values))
    use = "Methods are developed on these scenes: results are not reported. " if is_development else ""
    text = [
        f"# Random scenes, seed {seed}",
        "",
        f"{use}Numbers of methods are tracer RMSE.",
        "",
        *(f"- {sentence}" for sentence in sentences),
        "",
        *as_markdown(headings, [[v if isinstance(v, str) else f"{v:.3g}" for v in row] for row in rows]),
        "",
        "Velocity and spin: error of the estimate from the frames before contact, also in units of its estimated "
        "standard deviation. In plane: velocity across the viewing direction, spin about it.",
        "",
        *([] if is_development else [*verdict_lines(verdicts), RULE, ""]),
    ]
    return as_csv([names, *rows]), "\n".join(text), sentences
