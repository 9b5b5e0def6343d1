"""Checks of a capture, each with what to expect, and its pages."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

from neuma_lib.capture.agreement import LEAST_AGREEMENT
from neuma_lib.capture.flight import flight_checks
from neuma_lib.capture.gravity import gravity_checks

MOST_ERROR = 1.0
"""Mean reprojection error that good photographs stay below [px]."""
MOST_RESIDUAL = 0.5
"""Distance of the board's corners from the print that a flat board, measured well, stays below [mm]."""
MOST_UNSURE = 0.3
"""Deviation of a fixed camera's direction that its picture and those of the photographs leave [degrees]."""
LEAST_FLOOR = 0.2
"""Share of the points that lie on a floor with texture."""
MOST_LEFT_OUT = 0.1
"""Share of the photographs whose masks may disagree with the others."""
MOST_JUMP = 0.1
"""Change of a mask's area from frame to frame of free flight that good masks stay below."""
LEAST_OVERLAP = 0.9
"""IoU of filmed masks and those of the placed object, in free flight."""
MOST_TURN = 5.0
"""Deviation of the object's pose that good videos stay below, about its worst axis [degrees]."""
LEAST_PSNR = 20.0
"""PSNR inside the object that Gaussians of good photographs have in photographs that were kept from the fit [dB]."""


class Check(NamedTuple):
    """A check: what was looked at, what was found and wanted, and whether that agrees."""

    what: str
    found: str
    wanted: str
    good: bool


def checks(room: Mapping[str, Any], videos: Mapping[str, Mapping[str, Any]]) -> list[Check]:
    """Checks of a capture.

    Args:
        room: report of `neuma_lib.capture.room.report`.
        videos: `Timeline.plain` by name of the video.
    """
    registered, pictures = room["registered"], room["pictures"]
    lost = f" (not {', '.join(room['lost'])})" if room["lost"] else ""
    found = [
        Check("pictures with a place", f"{registered} of {pictures}{lost}", "all", registered == pictures)
    ]
    if (error := room["reprojection_error_px"]) is not None:
        found.append(
            Check("reprojection error", f"{error:.2f} px", f"< {MOST_ERROR:g} px", error < MOST_ERROR)
        )
    for name, (x, y, turn) in room.get("unsure", {}).items():
        text = f"+-{turn:.2f} degrees, the lens's centre +-{x:.1f} and +-{y:.1f} px"
        wanted = f"< {MOST_UNSURE:g} degrees"
        found.append(Check(f"direction of {name.split('/')[0]}", text, wanted, turn < MOST_UNSURE))
    if board := room["board"]:
        off = board["residual_mm"]
        text = f"{off:.2f} mm ({board['corners']} corners, {board['pictures']} pictures)"
        found.append(
            Check("board's corners off the print", text, f"< {MOST_RESIDUAL:g} mm", off < MOST_RESIDUAL)
        )
    if (share := room["share_of_points_on_floor"]) is not None:
        text, wanted = f"{100 * share:.0f} % of the points", f"> {100 * LEAST_FLOOR:.0f} %"
        found.append(Check("floor", text, wanted, share > LEAST_FLOOR))
    for name, video in videos.items():
        slow = f", slowed {video['stretch']:g} times in the file" if video["stretch"] != 1 else ""
        text = f"{video['frames']} at {video['rate']:.2f} a second{slow}"
        missing = len(video["lost_before"])
        text += (
            f", missing at {missing} places" if missing else "" if video["steady"] else ", at a varying rate"
        )
        found.append(Check(f"frames of {name}", text, "none missing", not missing))
    return found


def motion_checks(
    photographs: Mapping[str, Any],
    videos: Mapping[str, Mapping[str, Any]],
    flights: Mapping[str, Mapping[str, Any]],
) -> list[Check]:
    """Checks of masks and free flight.

    Args:
        photographs: report of the masks of the photographs.
        videos: of the masks of each video, by its name.
        flights: `neuma_lib.capture.flight.report` by throw.
    """
    count, out = photographs["photographs"], photographs["left_out"]
    text = f"{count - len(out)} of {count}" + (f" (not {', '.join(out)})" if out else "")
    what = f"masks of photographs that agree (IoU > {LEAST_AGREEMENT})"
    found = [Check(what, text, "nearly all", len(out) <= MOST_LEFT_OUT * count)]
    for name, report in videos.items():
        jump = report["largest_jump"]
        text = "no free flight" if jump is None else f"{100 * jump:.1f} %"
        good = jump is not None and jump < MOST_JUMP
        found.append(Check(f"area of {name}, frame to frame", text, f"< {100 * MOST_JUMP:.0f} %", good))
    for throw, flight in flights.items():
        found += [Check(*values) for values in flight_checks(throw, flight)]
    return found


def object_checks(fit: Mapping[str, Any]) -> list[Check]:
    """Checks of the Gaussians of the object as photographed, by the report of their fit."""
    psnr = fit["psnr_object"]
    text = f"{psnr:.1f} dB inside the object ({len(fit['held_out'])} photographs, {fit['count']} Gaussians)"
    return [Check("PSNR of photographs kept from the fit", text, f"> {LEAST_PSNR:g} dB", psnr > LEAST_PSNR)]


def registration_checks(placed: Mapping[str, Mapping[str, Any]]) -> list[Check]:
    """Checks of the object's place in the videos, by the report of each throw's registration."""
    found = []
    for throw, report in placed.items():
        turn = max(report["rotation_std_deg_principal"])
        text, wanted = f"+-{turn:.1f} degrees", f"< {MOST_TURN:g} degrees"
        found.append(Check(f"pose of the object in {throw}", text, wanted, turn < MOST_TURN))
        found += [Check(*values) for values in gravity_checks(throw, report)]
        for camera, after in report["after"].items():
            text, wanted = f"IoU {after['iou']:.3f}", f"> {LEAST_OVERLAP:g}"
            what = f"placed object in {throw}, {camera}"
            found.append(Check(what, text, wanted, after["iou"] > LEAST_OVERLAP))
    return found


def markdown(title: str, found: list[Check], pictures: Mapping[str, str], missing: str | None = None) -> str:
    """The page.

    Args:
        title: of the page.
        found: the checks.
        pictures: caption -> file, relative to the page.
        missing: what the capture still lacks.
    """
    lines = [f"# {title}", "", "| check | found | wanted | |", "|---|---|---|---|"]
    for check in found:
        lines.append(
            f"| {check.what} | {check.found} | {check.wanted} | {'ok' if check.good else '**look**'} |"
        )
    lines += ["", missing] if missing else []
    for caption, file in pictures.items():
        lines += ["", f"## {caption}", "", f"![{caption}]({file})"]
    return "\n".join(lines) + "\n"
