"""The report of a capture: one HTML file that holds its pictures and videos, and asks for nothing from elsewhere."""

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

from neuma_lib.capture.page import Check
from neuma_lib.io.files import reading
from neuma_lib.io.images import open_image

PICTURE_WIDTH = 1000
"""Most width of a picture in the page [px]."""
QUALITY = 80
"""Of its JPEG."""
STRESS_UNITS = {
    **dict.fromkeys(
        (
            "E",
            "G",
            "K",
            "mu",
            "lam",
            "kappa",
            "yield_stress",
            "cohesion",
            "crush",
            "tension",
            "fibre_modulus",
        ),
        "Pa",
    ),
    "viscosity": "Pa s",
    "consistency": "Pa sⁿ",
}
"""Units of constants that are in proportion to stress."""
OTHER_UNITS = {"friction_angle": "°", "dilation_angle": "°", "relaxation_time": "s"}
BARS = 2
"""Standard deviations of an error bar."""
UNKNOWN = 100.0
"""Factor from which an error bar says that nothing is known."""
MEASURES = {
    "psnr": ("PSNR, object [dB]", 1),
    "ssim": ("SSIM, object", 3),
    "lpips_vgg": ("LPIPS, object", 3),
    "iou": ("mask IoU", 3),
    "scene_psnr": ("PSNR, whole picture [dB]", 1),
    "scene_ssim": ("SSIM, whole picture", 3),
    "scene_lpips_alex": ("LPIPS, whole picture", 3),
}
"""Columns of the table of measures: heading and digits."""

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
.doubts li::marker { color: #a35a00; }
.open { color: #a35a00; white-space: nowrap; }
.missing { color: #777; font-style: italic; }
"""


@dataclass(frozen=True)
class Film:
    """Prediction beside the video of a camera.

    Attributes:
        throw, camera: whose.
        learned: whether the law was learned from it.
        video: the mp4; None: it is missing.
        said: a line below it.
    """

    throw: str
    camera: str
    learned: bool
    video: Path | None
    said: str = ""


@dataclass(frozen=True)
class Report:
    """What the page tells.

    Attributes:
        title: name of the capture.
        method: title of the learned law.
        summary: lines below the title.
        doubts: what to distrust.
        checks: by stage.
        pictures: caption -> file, by stage; files that are not there are said to be missing.
        films: prediction beside every video.
        rows: measures, of `neuma_lib.evaluation.captured_images.image_rows`.
        own: the learned method, whose rows stand out.
        curves: picture of the stress curves; None: there are none.
        identified: content of identified.json; None: nothing was identified.
        scale: metres of the simulator to a metre of the room.
    """

    title: str
    method: str
    summary: Sequence[str] = ()
    doubts: Sequence[str] = ()
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
    off = sum(not check.good for found in report.checks.values() for check in found)
    parts = {
        "Prediction": _films(report.films),
        "Measures": _measures(report.rows, report.own),
        "The law": _law(report),
        "What to distrust": _doubts(report.doubts),
        "Checks": _checks(report.checks),
        "Input": _pictures(report.pictures),
    }
    say = {0: "All checks are good.", 1: "One check is off."}.get(off, f"{off} checks are off.")
    summary = [*report.summary, say] if report.checks else report.summary
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
    """A picture as a data URI, at most ``width`` pixels wide. Raises InputError for a file that is no picture."""
    with open_image(Path(path).read_bytes(), path) as image:
        with reading(path, "an image"):
            pixels = image.convert("RGB")
    if pixels.width > width:
        pixels = pixels.resize((width, round(pixels.height * width / pixels.width)), Image.Resampling.LANCZOS)
    content = BytesIO()
    pixels.save(content, "JPEG", quality=QUALITY)
    return _uri("image/jpeg", content.getvalue())


def room_value(name: str, value: float, scale: float) -> tuple[float, str]:
    """A constant of the simulator's in the units of the room, and its unit.

    Stresses in the room are the simulator's over the square of the scale, since lengths are scaled and times and
    densities are not.
    """
    if name in STRESS_UNITS:
        return value / scale**2, STRESS_UNITS[name]
    return value, OTHER_UNITS.get(name, "")


def number(value: float) -> str:
    """Three digits; powers of ten where there are many zeros."""
    if value == 0 or not math.isfinite(value):
        return f"{value:g}"
    if 1e-3 <= abs(value) < 1e4:
        return f"{float(f'{value:.3g}'):g}"
    exponent = math.floor(math.log10(abs(value)))
    power = str(exponent).translate(str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹"))
    return f"{value / 10**exponent:.2f} × 10{power}"


def prefixed(value: float, unit: str) -> tuple[float, str]:
    """A prefix of SI for a value: the factor on it and its likes, and the unit with the prefix."""
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
    """A table; its last ``numbers`` columns are flush right. Rows are (class, cells), and cells are HTML."""
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
        "<p>Above: the video, and the prediction laid over the picture of the empty scene. Below: where they differ, "
        "darker the more they do, and the prediction of the prior, if it is another.</p>"
    ]
    for throw in dict.fromkeys(film.throw for film in films):
        mine = [film for film in films if film.throw == throw]
        kind = "learned from" if mine[0].learned else "held out"
        parts.append(f"<h3>{escape(throw)} ({kind})</h3>")
        for film in mine:
            if film.video is None or not Path(film.video).is_file():
                parts.append(_missing(f"The video of {film.camera} is missing."))
                continue
            source = _uri("video/mp4", Path(film.video).read_bytes())
            parts.append(
                f'<figure><video controls autoplay loop muted playsinline preload="auto" src="{source}"></video>'
                f"<figcaption>{escape(film.camera)}{': ' if film.said else ''}{escape(film.said)}</figcaption></figure>"
            )
    return "\n".join(parts)


def _measures(rows: Sequence[Mapping[str, Any]], own: str) -> str:
    if not rows:
        return _missing("No pictures were measured.")
    places = dict.fromkeys((row["throw"], row["camera"], row["learned"]) for row in rows)
    parts = {whole: [place for place in places if (place[0] == "all") == whole] for whole in (True, False)}
    tables = {whole: _places(rows, own, part) for whole, part in parts.items() if part}
    return (
        "<p>PSNR, SSIM and mask IoU: more is better. LPIPS (VGG of the object, AlexNet of the whole picture): less is "
        "better. The object: colours over white, on the bounding box of the predicted and the filmed one. The whole "
        "picture: the frame as it was filmed against the prediction over the empty scene; most of it is background, "
        "which is equal whatever is predicted, and the object's shadow is in the frame alone.</p>\n"
        + tables.get(True, "")
        + (f"\n<details><summary>Each camera</summary>{tables[False]}</details>" if False in tables else "")
    )


def _places(rows: Sequence[Mapping[str, Any]], own: str, places: Iterable[tuple[str, str, bool]]) -> str:
    """Table of the measures of some throws and cameras: a line for each, and one for each law below it."""
    lines = []
    for throw, camera, learned in places:
        kind = "learned from" if learned else "held out"
        where = f"All frames {kind}" if throw == "all" else f"{throw}, {camera} ({kind})"
        lines.append(f'<tr class="first"><th colspan="{1 + len(MEASURES)}">{escape(where)}</th></tr>')
        for row in rows:
            if (row["throw"], row["camera"], row["learned"]) == (throw, camera, learned):
                found = (
                    f"{row[name]:.{digits}f}" if name in row else "–"
                    for name, (_, digits) in MEASURES.items()
                )
                cells = "".join(f'<td class="n">{cell}</td>' for cell in found)
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
            f'<figure><img alt="stress curves" src="{picture_uri(report.curves)}"><figcaption>Kirchhoff stress, in the '
            "units of the room. Top: the elastic law under axial stretch, the sides free. Middle: the elastic "
            "law under "
            "shear. Bottom: shear at a constant rate with yielding and flow. Blue ground: what the object went "
            "through. "
            "Coloured bands: 95 % of the laws that the video leaves possible, where a law has such an account."
            "</figcaption></figure>",
        ]
    else:
        parts.append(_missing("There are no stress curves."))
    if report.identified is None:
        parts.append(_missing("No family of laws was identified."))
    else:
        parts.append(_identified(report.identified, report.scale))
    return "\n".join(parts)


def _identified(found: Mapping[str, Any], scale: float) -> str:
    family = escape(found["family"])
    tied = f", which {escape(', '.join(found['ties']))} equal" if found.get("ties") else ""
    lines = []
    for name, entry in found["best"]["quantities"].items():
        value, unit = room_value(name, entry["value"], scale)
        prefix, unit = prefixed(value, unit)
        value *= prefix
        # an exponent that floats have room for
        factor = math.exp(min(BARS * entry["log_std"], 700.0))
        ends = (
            "nothing is known"
            if factor > UNKNOWN
            else f"{number(value / factor)} to {number(value * factor)}"
        )
        mark = (
            '<span class="good">determined</span>'
            if entry["determined"]
            else '<span class="open">not determined</span>'
        )
        lines.append(("", [escape(name), f"{number(value)} {escape(unit)}".strip(), ends, mark]))
    constants = _table(["constant", "value", "two standard deviations", ""], lines, 0)
    families = [
        ("own" if name == found["family"] else "", [escape(name), f"{fit['held_out_loss']:.2e}"])
        for name, fit in sorted(
            ((n, f) for n, f in found["families"].items() if "held_out_loss" in f),
            key=lambda pair: pair[1].get("score", pair[1]["held_out_loss"]),
        )
    ]
    given_up = [name for name, fit in found["families"].items() if "held_out_loss" not in fit]
    rest = f"<p>Given up early: {escape(', '.join(given_up))}.</p>" if given_up else ""
    judged = _table(["family", "mean squared residual of the last frames"], families, 1) if families else ""
    scaled = (
        f"<p>The simulator's lengths are {number(scale)} times those of the room; stresses here are the room's, the "
        f"simulator's over {number(scale**2)}.</p>"
        if scale != 1
        else ""
    )
    return (
        f"<h3>Identified family: {family}{tied}</h3>\n{scaled}{constants}\n"
        f"<details><summary>All families</summary>{judged}{rest}</details>"
    )


def _doubts(doubts: Sequence[str]) -> str:
    if not doubts:
        return "<p>Nothing was found that speaks against the result.</p>"
    return '<ul class="doubts">\n' + "\n".join(f"<li>{escape(line)}</li>" for line in doubts) + "\n</ul>"


def _checks(groups: Mapping[str, Sequence[Check]]) -> str:
    if not groups:
        return _missing("There are no checks.")
    parts = []
    for group, found in groups.items():
        parts.append(f"<h3>{escape(group)}</h3>")
        if not found:
            parts.append(_missing("Nothing was checked."))
            continue
        lines = [
            (
                "",
                [
                    '<span class="good">✓ ok</span>' if check.good else '<span class="bad">✗ look</span>',
                    *map(escape, (check.what, check.value, check.wanted)),
                ],
            )
            for check in found
        ]
        parts.append(_table(["", "check", "found", "wanted"], lines, 0))
    return "\n".join(parts)


def _pictures(groups: Mapping[str, Mapping[str, Path]]) -> str:
    if not groups:
        return _missing("There are no pictures.")
    parts = []
    for group, files in groups.items():
        shown = [
            f'<figure><figcaption>{escape(caption)}</figcaption><img alt="{escape(caption)}" loading="lazy" '
            f'src="{picture_uri(file)}"></figure>'
            if Path(file).is_file()
            else _missing(f"{caption}: the picture is missing.")
            for caption, file in files.items()
        ]
        parts.append(f"<details><summary>{escape(group)}</summary>\n" + "\n".join(shown) + "\n</details>")
    return "\n".join(parts)
