"""The model card of an exported law: what it has seen, at which discretisation, and what it is not for."""

from collections.abc import Mapping
from typing import Any

from neuma_lib.io.files import one_line

_STEPS = {
    "none": "holds at any time step",
    "follows": "the step is a constant of its return map, which follows that of the simulation",
    "fixed": "its return map is a network of this step",
}
_METRICS = {
    "tracer_rmse_mm": "tracer RMSE [mm]",
    "chamfer_excess": "excess of the Chamfer distance [1e-4 m^2]",
    "diverged_at_step": "diverged at step",
}


def law_card(about: Mapping[str, Any]) -> str:
    """Markdown from the metadata of a law's file (`neuma_lib.io.exported`)."""
    visited = about.get("visited") if isinstance(about.get("visited"), Mapping) else {}
    numbers = about.get("metrics") if isinstance(about.get("metrics"), Mapping) else {}
    step = _STEPS.get(about.get("step"), "")
    rows = {
        "kind": about.get("kind"),
        "scene, method": " / ".join(_text(about[key]) for key in ("scene", "method") if about.get(key)),
        "prior, weight of its correction": about.get("prior")
        and f"{_text(about['prior'])}, {about.get('weight')}",
        "time step [s]": about.get("dt") and f"{_text(about['dt'])}; {step}",
        "grid": about.get("grid") and f"{_text(about['grid'])} cells along the unit cube",
        "gravity [m/s^2]": about.get("gravity"),
        "assumed density [kg/m^3]": about.get("density"),
        "metres of the simulator per filmed metre": about.get("scale"),
        "principal stretches": visited.get("stretch"),
        "elastic shear": visited.get("shear"),
        "volume ratio of compressed states": visited.get("pressed"),
        "largest shear stress [Pa]": visited.get("shear_stress"),
        **{text: numbers.get(key) for key, text in _METRICS.items()},
        "commit": about.get("commit"),
    }
    known = [f"| {name} | {_text(value)} |" for name, value in rows.items() if value not in (None, "")]
    limits = [
        "States outside the ranges above, where nothing was learned."
        if visited
        else "Large deformations without a test: the range of states that it has seen is unknown.",
        "Another density: motion in a video determines stiffness relative to density, which was assumed.",
        "Strength, fatigue, temperature or rates that the video does not show, and design where failure does harm.",
    ]
    if about.get("grid"):
        limits.append(
            f"Other grids: it has absorbed discretisation errors of {about['grid']} cells, so that its constants are "
            "not those of the material."
        )
    if about.get("step") == "fixed" and about.get("any_step") is not True:
        limits.append("Other time steps, at which its return map is another material.")
    if numbers.get("diverged_at_step") is not None:
        limits.append("Its own scene after the step at which it diverged.")
    lines = ["# Model card of a law", "", "| | |", "|---|---|", *known, "", "It is not for:", ""]
    lines += [f"- {limit}" for limit in limits]
    return "\n".join(
        [*lines, "", "`neuma law show` prints the metadata that this page was generated from.", ""]
    )


def _text(value: Any) -> str:
    if isinstance(value, float):
        return f"{value:.4g}"
    if isinstance(value, list | tuple):
        return ", ".join(map(_text, value))
    return one_line(value, 80).replace("|", "/")
