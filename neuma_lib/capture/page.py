"""One page of a capture: its checks, each with what to expect, and its pictures."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

MOST_ERROR = 1.0
"""Mean reprojection error that good photographs stay below [px]."""
MOST_RESIDUAL = 0.5
"""Distance of the board's corners from the print that a flat board, measured well, stays below [mm]."""
LEAST_FLOOR = 0.2
"""Share of the points that lie on a floor with texture."""


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
