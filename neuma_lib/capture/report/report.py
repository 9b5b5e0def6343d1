"""The report of a capture: a self-contained HTML file with its pictures and videos."""

import base64
import math
from collections.abc import Mapping, Sequence
from html import escape
from io import BytesIO
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

from jinja2 import Environment, StrictUndefined
from markupsafe import Markup
from PIL import Image

from neuma_lib.capture.pictures import read_picture
from neuma_lib.capture.report.page import Check
from neuma_lib.coupling.bodies import BODY_COLOURS
from neuma_lib.evaluation.calibration import GRID, describe_families, interval, kind_of

_PICTURE_WIDTH, _QUALITY = 1000, 80  # maximum width [px] and JPEG quality of pictures in the page
STRESS_UNITS = {
    **dict.fromkeys(("E", "G", "K", "mu", "lam", "kappa", "yield_stress", "cohesion"), "Pa"),
    **dict.fromkeys(("crush", "tension", "fibre_modulus"), "Pa"),
    "viscosity": "Pa s",
    "consistency": "Pa sⁿ",
}
"""Units of constants that are proportional to stress."""
OTHER_UNITS = {"friction_angle": "°", "dilation_angle": "°", "relaxation_time": "s"}
_UNKNOWN = 100.0  # ratio of the upper end of an interval to the value, above which a constant is unknown
MEASURES = {
    "psnr": ("PSNR, object [dB]", 1),
    "ssim": ("SSIM, object", 3),
    "lpips_vgg": ("LPIPS, object", 3),
    "iou": ("mask IoU", 3),
    "scene_psnr": ("PSNR, whole picture [dB]", 1),
    "scene_ssim": ("SSIM, whole picture", 3),
    "scene_lpips_alex": ("LPIPS, whole picture", 3),
}
"""Columns of the table of measures: heading and number of decimals."""


class Film(NamedTuple):
    """Comparison of prediction and video: whether the law was learned from this video, the mp4, and a caption."""

    take: str
    camera: str
    learned: bool
    video: Path | None
    caption: str = ""


def page(
    title: str,
    method: str,
    *,
    summary: Sequence[str] = (),
    warnings: Sequence[str] = (),
    checks: Mapping[str, Sequence[Check]] = MappingProxyType({}),
    pictures: Mapping[str, Mapping[str, Path]] = MappingProxyType({}),
    films: Sequence[Film] = (),
    rows: Sequence[Mapping[str, Any]] = (),
    own: str = "",
    curves: Path | None = None,
    identified: Mapping[str, Any] | None = None,
    scale: float = 1.0,
) -> str:
    """The report of a capture as HTML, from the template ``report.html``. Missing files are reported in the page.

    Args:
        title: name of the capture.
        method: title of the learned law.
        summary: lines below the title.
        warnings: of `neuma_lib.capture.report.warnings`.
        checks: by stage.
        pictures: caption -> file, by stage.
        films: comparisons of prediction and video.
        rows: measures, of `neuma_lib.capture.report.images.image_rows`.
        own: the learned method, whose rows are highlighted.
        curves: picture of the stress curves, if any.
        identified: content of identified.json, if any, of one body or several.
        scale: simulated metres per metre of the room.
    """
    failed = sum(not check.good for group in checks.values() for check in group)
    result = {0: "All checks passed.", 1: "One check failed."}.get(failed, f"{failed} checks failed.")
    environment = Environment(
        autoescape=True, finalize=_escaped, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    template = Path(__file__).with_suffix(".html").read_text(encoding="utf-8")
    return environment.from_string(template).render(
        title=title,
        method=method,
        summary=[*summary, *([result] if checks else [])],
        films=_films(films),
        headings=[heading for heading, _ in MEASURES.values()],
        places=_places(rows, own),
        curves=_uri(curves),
        laws=_laws(identified, scale) if identified else {},
        frictions=[_friction(pair) for pair in (identified or {}).get("pairs", ())],
        warnings=warnings,
        checks=checks,
        pictures={
            group: [{"caption": caption, "uri": _uri(file)} for caption, file in files.items()]
            for group, files in pictures.items()
        },
    )


def picture_uri(path: str | Path) -> str:
    """A picture, reduced to the width of the page, as a data URI. Raises InputError for a file that is no picture."""
    pixels, width = Image.fromarray(read_picture(path)), _PICTURE_WIDTH
    if pixels.width > width:
        pixels = pixels.resize((width, round(pixels.height * width / pixels.width)), Image.Resampling.LANCZOS)
    content = BytesIO()
    pixels.save(content, "JPEG", quality=_QUALITY)
    return _encoded("image/jpeg", content.getvalue())


def room_value(name: str, value: float, scale: float) -> tuple[float, str]:
    """Convert a constant of the simulation to units of the room, and return its unit.

    Stresses are divided by the square of the scale, since lengths are scaled and times and densities are not.
    """
    if name in STRESS_UNITS:
        return value / scale**2, STRESS_UNITS[name]
    return value, OTHER_UNITS.get(name, "")


def number(value: float) -> str:
    """Three significant digits, with a power of ten for large and small values."""
    if value == 0 or not math.isfinite(value):
        return f"{value:g}"
    if 1e-3 <= abs(value) < 1e4:
        return f"{float(f'{value:.3g}'):g}"
    exponent = math.floor(math.log10(abs(value)))
    power = str(exponent).translate(str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹"))
    return f"{value / 10**exponent:.2f} × 10{power}"


def prefixed(value: float, unit: str) -> tuple[float, str]:
    """Factor and unit with an SI prefix that suit a value."""
    if unit.startswith("Pa") and value > 0:
        for power, letter in ((9, "G"), (6, "M"), (3, "k")):
            if value >= 10**power:
                return 10.0**-power, f"{letter}{unit}"
    return 1.0, unit


def _escaped(value: Any) -> Any:
    """Escape a value of the template as `html.escape` does. Output of macros is HTML already."""
    return value if hasattr(value, "__html__") else Markup(escape(str(value)))


def _encoded(kind: str, content: bytes) -> str:
    return f"data:{kind};base64,{base64.b64encode(content).decode()}"


def _uri(file: Path | None) -> str | None:
    """Data URI of a picture or an mp4. None if the file is missing."""
    if file is None or not Path(file).is_file():
        return None
    return (
        _encoded("video/mp4", Path(file).read_bytes()) if Path(file).suffix == ".mp4" else picture_uri(file)
    )


def _kind(learned: bool) -> str:
    return "training" if learned else "held out"


def _films(films: Sequence[Film]) -> dict[str, list[dict[str, Any]]]:
    """Videos by take."""
    takes: dict[str, list[dict[str, Any]]] = {}
    for film in films:
        entry = {"camera": film.camera, "caption": film.caption, "kind": _kind(film.learned)}
        takes.setdefault(film.take, []).append(entry | {"uri": _uri(film.video)})
    return takes


def _places(rows: Sequence[Mapping[str, Any]], own: str) -> list[dict[str, Any]]:
    """Measures by take and camera, with a row for each law."""
    places: dict[tuple[str, str, bool], dict[str, Any]] = {}
    for row in rows:
        take, camera, learned = row["throw"], row["camera"], row["learned"]
        place = places.setdefault((take, camera, learned), {"whole": take == "all", "rows": []})
        name = "All frames" if take == "all" else f"{take}, {camera}"
        place["heading"] = f"{name} ({_kind(learned)})"
        cells = [f"{row[key]:.{digits}f}" if key in row else "–" for key, (_, digits) in MEASURES.items()]
        place["rows"].append({"title": row["title"], "own": row["method"] == own, "cells": cells})
    return list(places.values())


def _laws(identified: Mapping[str, Any], scale: float) -> dict[str, dict[str, Any]]:
    """The identified law of each body by name, or of the only one, without a name."""
    if "bodies" not in identified:
        return {"": {**_law(identified, scale), "hidden": None}}
    return {
        body: {
            **_law(own, scale),
            "hidden": f"{100 * max(identified['hidden'][body]):.0f} %",
            "colour": ", ".join(f"{100 * part:.0f}%" for part in colour),
        }
        for (body, own), colour in zip(identified["bodies"].items(), BODY_COLOURS, strict=False)
    }


def _friction(pair: Mapping[str, Any]) -> dict[str, str]:
    """The friction between two bodies."""
    value = pair["friction"]
    ends = _ends(value, pair["log_std"], GRID)
    return {"bodies": " and ".join(pair["bodies"]), "value": number(value), "interval": ends}


def _ends(value: float, log_std: float, kind: str) -> str:
    """The interval of a constant."""
    low, high = interval(value, log_std, quantity=kind)
    return "unknown" if high > _UNKNOWN * value else f"{number(low)} to {number(high)}"


def _law(identified: Mapping[str, Any], scale: float) -> dict[str, Any]:
    """The identified family, its constants in units of the room, and the losses of all families."""
    constants = []
    for name, entry in identified.get("material", identified["best"])["quantities"].items():
        value, unit = room_value(name, entry["value"], scale)
        prefix, unit = prefixed(value, unit)
        value *= prefix
        ends = _ends(value, entry["log_std"], kind_of(identified))
        text = f"{number(value)} {unit}".strip()
        constants.append({"name": name, "value": text, "interval": ends, "determined": entry["determined"]})
    if (lowest := identified.get("contact_friction", {}).get("at_least")) is not None:
        bound = {"value": f"at least {number(lowest)}", "interval": "the body may stick", "determined": False}
        constants.append({"name": "contact_friction", **bound})
    families = identified["families"]
    known = {name: fit for name, fit in families.items() if "held_out_loss" in fit}
    order = sorted(known, key=lambda name: known[name].get("score", known[name]["held_out_loss"]))
    return {
        "family": identified["family"],
        "ties": identified.get("ties"),
        "probabilities": describe_families(identified),
        "constants": constants,
        "families": [(name, f"{known[name]['held_out_loss']:.2e}") for name in order],
        "dropped": [name for name in families if name not in known],
        "scale": number(scale) if scale != 1 else None,
        "square": number(scale**2),
    }
