"""Page of the next experiment: the best candidates as pictures, sentences and a table."""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from scipy.spatial import ConvexHull

from neuma_lib.evaluation.text_tables import as_markdown
from neuma_lib.fitting.next_experiment import Experiment
from neuma_lib.sim.colliders import Collider
from neuma_lib.sim.state import Trajectory
from neuma_lib.splatting.cameras import Cameras

SHOWN = 3  # candidates with a picture
_FRAMES, _PIXELS = 6, 160
_STRONG = math.log(100)  # evidence that distinguishes families

PAGE = """\
# What to film next

{known}

{pictures}

{table}

`after` is the {goal}, now {before}. Columns of constants are the expected standard deviations of their logarithms after
the experiment. `determines` names the constants, or the combination of them, that become determined. The last columns
are the expected logarithms of the Bayes factor of {family} against other families. All are predictions to first order
from simulated and rendered candidates.

    neuma new scene NAME --from {place}
"""
_GOALS = {
    "prediction": "standard deviation of the predicted motion",
    "constants": "geometric mean of the standard deviations of the constants",
    "families": "probability of the rival family relative to the identified one",
}


def describe(candidate: Mapping[str, Any]) -> str:
    """What to do, in a few words."""
    own = candidate["settings"]
    if candidate["kind"] == "camera":
        if abs(own["azimuth"]) == 180:
            return "film the first launch with a second camera from the opposite side"
        side = f"{abs(own['azimuth']):.0f} degrees to the {'right' if own['azimuth'] > 0 else 'left'} of the first"
        above = f", {own['elevation']:.0f} degrees higher" if own["elevation"] else ""
        return f"film the first launch with a second camera {side}{above}"
    if candidate["kind"] == "press":
        (_, (_, high, _), _), (_, (_, low, _), _), _ = frames = own["colliders"][-1]["keyframes"]
        speed = (high - low) / (frames[1][0] - frames[0][0])
        return (
            f"drop it from a height of {own['height']:.2f} m and press it with a platen that moves down by "
            f"{high - low:.2f} m and up again with {speed:.1f} m/s"
        )
    if candidate["kind"] == "hang":
        clamp = own["clamps"][0]
        text = f"hang it at a height of {own['height']:.2f} m, clamped above {clamp['lowest'][1]:.2f} m"
        if "keyframes" in clamp:
            time, away, _ = clamp["keyframes"][1]
            text += f", move the clamp by {math.hypot(*away):.2f} m ({away[1]:+.2f} m upwards) in {time:.2f} s and back"
        return text + (f", and let it go at {clamp['release']:.2f} s" if "release" in clamp else "")
    vx, vy, vz = own["velocity"]
    text = f"launch it at a height of {own['height']:.2f} m with {math.hypot(vx, vy, vz):.1f} m/s"
    text += f" ({-vy:.1f} m/s downwards)"
    if spin := math.hypot(*own["spin"]):
        text += f" and a spin of {spin:.1f} rad/s"
    if turn := math.hypot(*own.get("rotation", (0.0,))):
        text += f", turned by {math.degrees(turn):.0f} degrees"
    return text


def explain(choice: Mapping[str, Any], candidate: Mapping[str, Any]) -> str:
    """Why, in one sentence: what it determines, or what it improves most, and the family that it distinguishes."""
    known, expected = choice["known"], candidate["expected"]
    if determined := candidate["becomes_determined"]:
        each = ", ".join(
            f"{name} ({_percent(own['before'])} to {_percent(own['after'])})"
            for name, own in determined.items()
        )
        reasons = [f"it is expected to determine {each}"]
    else:
        name = min(known, key=lambda key: expected[key] / known[key])
        change = f"from {_percent(known[name])} to {_percent(expected[name])}"
        reasons = [f"it is expected to lower the standard deviation of {name} {change}"]
    if "prediction_std" in candidate:
        pair = [1e3 * each["prediction_std"] for each in (choice, candidate)]
        reasons.append(f"that of the predicted motion from {pair[0]:.2g} mm to {pair[1]:.2g} mm")
    for name, value in candidate["log_bayes_factors"].items():
        if value is None or value >= _STRONG:
            reasons.append(f"to distinguish {choice['family']} from {name}")
    return f"{', and '.join(reasons)}."


def page(choice: Mapping[str, Any], picture: str, place: str) -> str:
    """The page as Markdown.

    Args:
        choice: content of next.json.
        picture: path of the picture relative to the page.
    """
    candidates = choice["candidates"]
    now = ", ".join(f"{name} {_percent(std)}" for name, std in choice["known"].items())
    known = f"The material is identified as {choice['family']}. Standard deviations now: {now}."
    if not choice["useful"]:
        known += " **No candidate gains much.**"
    lines = [
        f"{rank}. {describe(each).capitalize()}: {explain(choice, each)}"
        for rank, each in enumerate(candidates[:SHOWN], 1)
    ]
    rivals = list(candidates[0]["log_bayes_factors"])
    header = [
        "rank",
        "experiment",
        "after",
        *choice["known"],
        "determines",
        *(f"against {name}" for name in rivals),
    ]
    rows = [
        [
            rank,
            describe(each),
            _goal(choice["goal"], each["after"]),
            *(_percent(std) for std in each["expected"].values()),
            ", ".join(each["becomes_determined"]),
            *(
                "excluded" if (v := each["log_bayes_factors"][name]) is None else f"{v:.1f}"
                for name in rivals
            ),
        ]
        for rank, each in enumerate(candidates, 1)
    ]
    return PAGE.format(
        known=known,
        pictures="\n".join([f"![motions of the best candidates]({picture})", "", *lines]),
        table="\n".join(as_markdown(header, rows)),
        goal=_GOALS[choice["goal"]],
        before=_goal(choice["goal"], choice["before"]),
        place=place,
        family=choice["family"],
    )


def _percent(value: float) -> str:
    return f"{100 * value:.0f} %"


def _goal(goal: str, value: float) -> str:
    if goal == "prediction":
        return f"{1e3 * value:.2g} mm"
    return _percent(value) if goal == "constants" else f"{value:.2g}"


@torch.no_grad()
def draw(file: str | Path, motions: Sequence[tuple[Experiment, Trajectory]]) -> None:
    """Draw a row of frames for each motion, with the edges of boxes that it touches.

    Args:
        motions: experiment and path of each. The last camera is used.
    """
    from matplotlib.figure import Figure

    first = motions[0][0].video[-1].cameras
    width, height = first.width, first.height
    figure = Figure(figsize=(1.6 * _FRAMES, (1.6 * height / width + 0.3) * len(motions)), dpi=100)
    axes = figure.subplots(len(motions), _FRAMES, squeeze=False)
    for row, (rank, (experiment, path)) in zip(axes, enumerate(motions, 1), strict=True):
        model, body, cameras = experiment.model, experiment.body, experiment.video[-1].cameras
        selected = np.linspace(0, len(path.frames) - 1, _FRAMES).round().astype(int).tolist()
        magnify = max(1, round(_PIXELS / width))
        scale = cameras.Ks.new_tensor([magnify, magnify, 1.0])
        camera = Cameras(
            cameras.viewmats[:1], cameras.Ks[:1] * scale[:, None], width * magnify, height * magnify
        )
        images = (
            body.particle_gs(camera)(path.x[selected], path.stretch[selected])[:, 0].clamp(0, 1).cpu().numpy()
        )
        for axis, image, k in zip(row, images, selected, strict=True):
            axis.imshow(image)
            time = path.frames[k] * model.dt
            axis.set_title(f"{time:.2f} s", fontsize=7, pad=2)
            for box in (each for each in model.colliders if each.shape == "box"):
                axis.fill(*_edges(box, time, camera), fill=False, linewidth=0.8)
            axis.set(xlim=(-0.5, image.shape[1] - 0.5), ylim=(image.shape[0] - 0.5, -0.5))
            axis.set_xticks([])
            axis.set_yticks([])
        row[0].set_ylabel(f"{rank}", rotation=0, fontsize=11, labelpad=10, va="center")
    figure.tight_layout(pad=0.4)
    figure.savefig(file)


def _edges(box: Collider, time: float, camera: Cameras) -> tuple[np.ndarray, np.ndarray]:
    """Pixels (x, y) of the convex hull of a box at a time [s]."""
    turn, centre = box.pose(time)
    corners = torch.cartesian_prod(*(torch.tensor([-s, s], dtype=torch.float64) for s in box.size))
    pixels, _ = camera.project((corners @ turn.mT + centre).to(camera.Ks))
    flat = pixels.reshape(-1, 2).double().cpu().numpy()
    return tuple(flat[ConvexHull(flat).vertices].T)
