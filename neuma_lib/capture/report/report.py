"""The report of a capture: a self-contained HTML file with its pictures and videos."""

from __future__ import annotations

import base64
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from html import escape
from io import BytesIO
from pathlib import Path
from typing import Any

from PIL import Image

from neuma_lib.capture.report.page import Check
from neuma_lib.io.files import reading
from neuma_lib.io.images import open_image

PICTURE_WIDTH = 1000
"""Maximum width of a picture in the page [px]."""
QUALITY = 80
"""JPEG quality of pictures."""
STRESS_UNITS = {
    **dict.fromkeys(("E", "G", "K", "mu", "lam", "kappa", "yield_stress", "cohesion"), "Pa"),
    **dict.fromkeys(("crush", "tension", "fibre_modulus"), "Pa"),
    "viscosity": "Pa s",
    "consistency": "Pa sⁿ",
}
"""Units of constants that are proportional to stress."""
OTHER_UNITS = {"friction_angle": "°", "dilation_angle": "°", "relaxation_time": "s"}
BARS = 2
"""Standard deviations of an error bar."""
UNKNOWN = 100.0
"""Factor of an error bar above which a constant is unknown."""
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

STYLE = """
:root { color-scheme: light; }
* { box-sizing: border-box; }
body { margin: 0 auto; max-width: 62rem; padding: 1rem; background: #fff; color: #1c1c1c;
  font: 16px/1.5 system-ui, -apple-system, "Segoe UI", Roboto, "DejaVu Sans", sans-serif; }
h1 { font-size: 1.6rem; line-height: 1.2; margin: .5rem 0 .2rem; }
h2 { font-size: 1.2rem; margin: 2.2rem 0 .6rem; border-bottom: 1px solid #ddd; padding-bottom: .2rem; }
h3 { font-size: 1rem; margin: 1.2rem 0 .4rem; }
p, ul { margin: .5rem 0; }
ul { padding-left: 1.2rem; }
li { margin: .35rem 0; }
nav { font-size: .9rem; }
nav a { color: #0a58a0; margin-right: .8rem; white-space: nowrap; }
.lead { color: #555; }
.wide { overflow-x: auto; }
table { border-collapse: collapse; font-size: .88rem; width: 100%; }
th, td { text-align: left; padding: .3rem .6rem .3rem 0; border-bottom: 1px solid #eee; vertical-align: top; }
th { font-weight: 600; color: #444; }
td.n, th.n { text-align: right; font-variant-numeric: tabular-nums; padding: .3rem 0 .3rem .8rem; }
tr.own td { font-weight: 600; }
tr.first td, tr.first th { border-top: 2px solid #ccc; }
.good { color: #0a6b2d; white-space: nowrap; }
.bad { color: #a31515; font-weight: 600; white-space: nowrap; }
img, video { display: block; max-width: 100%; height: auto; margin: .4rem 0; }
video { width: 100%; max-width: 40rem; background: #f4f4f4; }
figure { margin: .8rem 0; }
figcaption { font-size: .88rem; color: #555; }
details { margin: .5rem 0; }
summary { cursor: pointer; color: #0a58a0; }
.warnings li::marker { color: #a35a00; }
.open { color: #a35a00; white-space: nowrap; }
.missing { color: #777; font-style: italic; }
"""


@dataclass(frozen=True)
class Film:
    """Comparison of prediction and video for a camera.

    Attributes:
        take, camera: of the video.
        learned: whether the law was learned from it.
        video: the mp4. None if missing.
        caption: line below it.
    """

    take: str
    camera: str
    learned: bool
    video: Path | None
    caption: str = ""


@dataclass(frozen=True)
class Report:
    """Content of the page.

    Attributes:
        title: name of the capture.
        method: title of the learned law.
        summary: lines below the title.
        warnings: of `neuma_lib.capture.report.warnings`.
        checks: by stage.
        pictures: caption -> file, by stage. Missing files are reported in the page.
        films: comparisons of prediction and video.
        rows: measures, of `neuma_lib.capture.report.images.image_rows`.
        own: the learned method, whose rows are highlighted.
        curves: picture of the stress curves, if any.
        identified: content of identified.json, if any.
        scale: simulated metres per metre of the room.
    """

    title: str
    method: str
    summary: Sequence[str] = ()
    warnings: Sequence[str] = ()
    checks: Mapping[str, Sequence[Check]] = field(default_factory=dict)
    pictures: Mapping[str, Mapping[str, Path]] = field(default_factory=dict)
    films: Sequence[Film] = ()
    rows: Sequence[Mapping[str, Any]] = ()
    own: str = ""
    curves: Path | None = None
    identified: Mapping[str, Any] | None = None
    scale: float = 1.0


def page(report: Report) -> str:
    """The report as HTML."""
    failed = sum(not check.good for checks in report.checks.values() for check in checks)
    parts = {
        "Prediction": _films(report.films),
        "Measures": _measures(report.rows, report.own),
        "The law": _law(report),
        "Warnings": _warnings(report.warnings),
        "Checks": _checks(report.checks),
        "Input": _pictures(report.pictures),
    }
    result = {0: "All checks passed.", 1: "One check failed."}.get(failed, f"{failed} checks failed.")
    summary = [*report.summary, result] if report.checks else report.summary
    names = {heading: heading.lower().replace(" ", "-") for heading in parts}
    links = " ".join(f'<a href="#{anchor}">{escape(heading)}</a>' for heading, anchor in names.items())
    body = "\n".join(
        f'<h2 id="{names[heading]}">{escape(heading)}</h2>\n{text}' for heading, text in parts.items()
    )
    return (
        '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{escape(report.title)}: {escape(report.method)}</title>\n<style>{STYLE}</style>\n</head>\n<body>\n"
        f'<h1>{escape(report.title)}</h1>\n<p class="lead">{escape(report.method)}</p>\n'
        f"{_paragraphs(summary)}\n<nav>{links}</nav>\n{body}\n</body>\n</html>\n"
    )


def picture_uri(path: str | Path, width: int = PICTURE_WIDTH) -> str:
    """A picture as a data URI of at most ``width`` pixels. Raises InputError for a file that is no picture."""
    with open_image(Path(path).read_bytes(), path) as image:
        with reading(path, "an image"):
            pixels = image.convert("RGB")
    if pixels.width > width:
        pixels = pixels.resize((width, round(pixels.height * width / pixels.width)), Image.Resampling.LANCZOS)
    content = BytesIO()
    pixels.save(content, "JPEG", quality=QUALITY)
    return _uri("image/jpeg", content.getvalue())


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


def _uri(kind: str, content: bytes) -> str:
    return f"data:{kind};base64,{base64.b64encode(content).decode()}"


def _paragraphs(lines: Iterable[str]) -> str:
    return "\n".join(f"<p>{escape(line)}</p>" for line in lines)


def _missing(what: str) -> str:
    return f'<p class="missing">{escape(what)}</p>'


def _table(head: Sequence[str], rows: Iterable[tuple[str, Sequence[str]]], numbers: int) -> str:
    """A table whose last ``numbers`` columns are right-aligned. Rows are (class, cells), cells are HTML."""
    first = len(head) - numbers
    kinds = ["" if k < first else ' class="n"' for k in range(len(head))]
    lines = ["<tr>" + "".join(f"<th{k}>{cell}</th>" for k, cell in zip(kinds, head, strict=True)) + "</tr>"]
    for name, cells in rows:
        row = "".join(f"<td{k}>{cell}</td>" for k, cell in zip(kinds, cells, strict=True))
        lines.append(f'<tr class="{name}">{row}</tr>' if name else f"<tr>{row}</tr>")
    return '<div class="wide"><table>\n' + "\n".join(lines) + "\n</table></div>"


def _films(films: Sequence[Film]) -> str:
    if not films:
        return _missing("There are no videos.")
    parts = [
        "<p>Top: the video, and the prediction over the empty scene. Bottom: their difference, from white (none) to "
        "black, and the prediction of the prior, if it differs.</p>"
    ]
    for take in dict.fromkeys(film.take for film in films):
        mine = [film for film in films if film.take == take]
        kind = "training" if mine[0].learned else "held out"
        parts.append(f"<h3>{escape(take)} ({kind})</h3>")
        for film in mine:
            if film.video is None or not Path(film.video).is_file():
                parts.append(_missing(f"The video of {film.camera} is missing."))
                continue
            source = _uri("video/mp4", Path(film.video).read_bytes())
            parts.append(
                f'<figure><video controls autoplay loop muted playsinline preload="auto" src="{source}"></video>'
                f"<figcaption>{escape(film.camera)}{': ' if film.caption else ''}{escape(film.caption)}</figcaption>"
                "</figure>"
            )
    return "\n".join(parts)


def _measures(rows: Sequence[Mapping[str, Any]], own: str) -> str:
    if not rows:
        return _missing("No pictures were measured.")
    places = dict.fromkeys((row["throw"], row["camera"], row["learned"]) for row in rows)
    parts = {whole: [place for place in places if (place[0] == "all") == whole] for whole in (True, False)}
    tables = {whole: _places(rows, own, part) for whole, part in parts.items() if part}
    return (
        "<p>PSNR, SSIM and mask IoU: higher is better. LPIPS (VGG for the object, AlexNet for the whole picture): lower"
        " is better. The object is compared over white, on the bounding box of predicted and true object. For the whole"
        " picture, the frame is compared with the prediction over the empty scene. Most of it is background, which is"
        " the same for any prediction, and the object's shadow is missing in the prediction.</p>\n"
        + tables.get(True, "")
        + (f"\n<details><summary>Each camera</summary>{tables[False]}</details>" if False in tables else "")
    )


def _places(rows: Sequence[Mapping[str, Any]], own: str, places: Iterable[tuple[str, str, bool]]) -> str:
    """Table of measures by take and camera, with a row for each law."""
    lines = []
    for take, camera, learned in places:
        kind = "training" if learned else "held out"
        where = f"All frames ({kind})" if take == "all" else f"{take}, {camera} ({kind})"
        lines.append(f'<tr class="first"><th colspan="{1 + len(MEASURES)}">{escape(where)}</th></tr>')
        for row in rows:
            if (row["throw"], row["camera"], row["learned"]) == (take, camera, learned):
                values = (
                    f"{row[name]:.{digits}f}" if name in row else "–"
                    for name, (_, digits) in MEASURES.items()
                )
                cells = "".join(f'<td class="n">{cell}</td>' for cell in values)
                mark = ' class="own"' if row["method"] == own else ""
                lines.append(f"<tr{mark}><td>{escape(row['title'])}</td>{cells}</tr>")
    head = "".join(f'<th class="n">{escape(heading)}</th>' for heading, _ in MEASURES.values())
    table = "\n".join([f"<tr><th>law</th>{head}</tr>", *lines])
    return f'<div class="wide"><table>\n{table}\n</table></div>'


def _law(report: Report) -> str:
    parts = []
    if report.curves is not None and Path(report.curves).is_file():
        parts += [
            "<h3>Stress curves</h3>",
            f'<figure><img alt="stress curves" src="{picture_uri(report.curves)}"><figcaption>Kirchhoff stress in'
            " units of the room. Top: elastic law under axial stretch with free sides. Middle: elastic law under shear."
            " Bottom: shear at a constant rate with yielding and flow. Blue: the range of deformation of the object."
            " Coloured bands: 95 % intervals, for laws with an estimate of uncertainty.</figcaption></figure>",
        ]
    else:
        parts.append(_missing("There are no stress curves."))
    if report.identified is None:
        parts.append(_missing("No family of laws was identified."))
    else:
        parts.append(_identified(report.identified, report.scale))
    return "\n".join(parts)


def _identified(identified: Mapping[str, Any], scale: float) -> str:
    family = escape(identified["family"])
    tied = f", tied with {escape(', '.join(identified['ties']))}" if identified.get("ties") else ""
    lines = []
    for name, entry in identified["best"]["quantities"].items():
        value, unit = room_value(name, entry["value"], scale)
        prefix, unit = prefixed(value, unit)
        value *= prefix
        factor = math.exp(min(BARS * entry["log_std"], 700.0))  # without overflow
        ends = "unknown" if factor > UNKNOWN else f"{number(value / factor)} to {number(value * factor)}"
        mark = (
            '<span class="good">determined</span>'
            if entry["determined"]
            else '<span class="open">not determined</span>'
        )
        lines.append(("", [escape(name), f"{number(value)} {escape(unit)}".strip(), ends, mark]))
    constants = _table(["constant", "value", "two standard deviations", ""], lines, 0)
    families = [
        ("own" if name == identified["family"] else "", [escape(name), f"{fit['held_out_loss']:.2e}"])
        for name, fit in sorted(
            ((n, f) for n, f in identified["families"].items() if "held_out_loss" in f),
            key=lambda pair: pair[1].get("score", pair[1]["held_out_loss"]),
        )
    ]
    dropped = [name for name, fit in identified["families"].items() if "held_out_loss" not in fit]
    rest = f"<p>Dropped early: {escape(', '.join(dropped))}.</p>" if dropped else ""
    table = _table(["family", "mean squared residual of the last frames"], families, 1) if families else ""
    scaled = (
        f"<p>Simulated lengths are {number(scale)} times those of the room. Stresses are in units of the room, those "
        f"of the simulation divided by {number(scale**2)}.</p>"
        if scale != 1
        else ""
    )
    return (
        f"<h3>Identified family: {family}{tied}</h3>\n{scaled}{constants}\n"
        f"<details><summary>All families</summary>{table}{rest}</details>"
    )


def _warnings(warnings: Sequence[str]) -> str:
    if not warnings:
        return "<p>There are no warnings.</p>"
    return '<ul class="warnings">\n' + "\n".join(f"<li>{escape(line)}</li>" for line in warnings) + "\n</ul>"


def _checks(groups: Mapping[str, Sequence[Check]]) -> str:
    if not groups:
        return _missing("There are no checks.")
    parts = []
    marks = {True: '<span class="good">✓ passed</span>', False: '<span class="bad">✗ failed</span>'}
    for group, checks in groups.items():
        parts.append(f"<h3>{escape(group)}</h3>")
        if not checks:
            parts.append(_missing("Nothing was checked."))
            continue
        lines = [
            ("", [marks[bool(check.good)], *map(escape, (check.what, check.value, check.wanted))])
            for check in checks
        ]
        parts.append(_table(["", "check", "measured", "expected"], lines, 0))
    return "\n".join(parts)


def _pictures(groups: Mapping[str, Mapping[str, Path]]) -> str:
    if not groups:
        return _missing("There are no pictures.")
    parts = []
    for group, files in groups.items():
        figures = [
            f'<figure><figcaption>{escape(caption)}</figcaption><img alt="{escape(caption)}" loading="lazy" '
            f'src="{picture_uri(file)}"></figure>'
            if Path(file).is_file()
            else _missing(f"{caption}: the picture is missing.")
            for caption, file in files.items()
        ]
        parts.append(f"<details><summary>{escape(group)}</summary>\n" + "\n".join(figures) + "\n</details>")
    return "\n".join(parts)
