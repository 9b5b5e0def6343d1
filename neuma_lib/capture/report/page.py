"""Checks of a capture with their expected values, and pages that list them."""

from collections.abc import Mapping
from typing import Any, NamedTuple

from neuma_lib.capture.calibration.vertical import read_cues
from neuma_lib.capture.masks.agreement import MIN_AGREEMENT
from neuma_lib.capture.masks.continuity import Break
from neuma_lib.config.simulation import GRAVITY

_MAX_ERROR = 1.0  # mean reprojection error of good photographs [px]
MAX_RESIDUAL = 0.5
"""Distance of the board's corners from the print for a flat board with the correct square size [mm]."""
_MAX_UNSURE = 0.3  # standard deviation of a fixed camera's direction [degrees]
_MAX_TILT = 5.0  # angle between upward directions of different cues [degrees]
_MAX_SCALE = 0.03  # relative standard deviation of the scale
_MIN_FLOOR = 0.2  # share of the points on a floor with texture
_MAX_LEFT_OUT = 0.1  # share of the photographs whose masks disagree with the others
_MAX_SHIFT = 0.001  # of the background of a fixed camera, as share of the picture
_MAX_JUMP = 0.1  # relative change of a good mask's area from frame to frame of free flight
_MIN_OVERLAP = 0.9  # IoU of masks from videos with those of the placed object, in free flight
MAX_TURN = 5.0
"""Standard deviation of the object's orientation about its worst axis, for good videos [degrees]."""
MIN_PSNR = 20.0  # PSNR inside the object of Gaussians in held-out photographs, for good photographs [dB]


class Check(NamedTuple):
    """A check: name, measured value, expected value, and whether they agree."""

    what: str
    value: str
    wanted: str
    good: bool


def checks(room: Mapping[str, Any], videos: Mapping[str, Mapping[str, Any]]) -> list[Check]:
    """Checks of a capture, from the report of its room and `Timeline.plain` by name of the video."""
    registered, pictures = room["registered"], room["pictures"]
    lost = f" (not {', '.join(room['lost'])})" if room["lost"] else ""
    result = [
        Check("pictures with a place", f"{registered} of {pictures}{lost}", "all", registered == pictures)
    ]
    if (error := room["reprojection_error_px"]) is not None:
        result.append(
            Check("reprojection error", f"{error:.2f} px", f"< {_MAX_ERROR:g} px", error < _MAX_ERROR)
        )
    for name, (x, y, turn) in room.get("unsure", {}).items():
        text = f"+-{turn:.2f} degrees, the lens's centre +-{x:.1f} and +-{y:.1f} px"
        wanted = f"< {_MAX_UNSURE:g} degrees"
        result.append(Check(f"direction of {name.split('/')[0]}", text, wanted, turn < _MAX_UNSURE))
    if board := room["board"]:
        residual = board["residual_mm"]
        text = f"{residual:.2f} mm ({board['corners']} corners, {board['pictures']} pictures)"
        wanted = f"< {MAX_RESIDUAL:g} mm"
        result.append(Check("board's corners off the print", text, wanted, residual < MAX_RESIDUAL))
    if "scale" in room:
        scale = room["scale"] or {"source": "unknown, the free flight measures it", "deviation": None}
        deviation = scale["deviation"]
        text = scale["source"] + (f" +- {100 * deviation:.1g} %" if deviation is not None else "")
        good = room["scale"] is not None and (deviation or 0.0) < _MAX_SCALE
        result.append(Check("scale, from", text, f"< {100 * _MAX_SCALE:g} %", good))
    if (share := room["share_of_points_on_floor"]) is not None:
        text, wanted = f"{100 * share:.0f} % of the points", f"> {100 * _MIN_FLOOR:.0f} %"
        result.append(Check("floor", text, wanted, share > _MIN_FLOOR))
    if cues := read_cues(room.get("up", ())):
        text = ", ".join(f"{c.name} {cues[0].angle(c):.1f} +- {c.deviation:.1f} degrees" for c in cues[1:])
        good = all(cues[0].angle(cue) < _MAX_TILT + 2 * cue.deviation for cue in cues[1:])
        wanted = f"< {_MAX_TILT:g} degrees, two deviations allowed"
        result.append(
            Check(f"upward direction, from the {cues[0].name}", text or "no other cue", wanted, good)
        )
    for name, video in videos.items():
        slow = f", slowed {video['stretch']:g} times in the file" if video["stretch"] != 1 else ""
        text = f"{video['frames']} at {video['rate']:.2f} a second{slow}"
        missing, repeated = len(video["lost_before"]), len(video["repeated"])
        text += f", {repeated} repeated ones left out" if repeated else ""
        text += (
            f", missing at {missing} places" if missing else "" if video["steady"] else ", at a varying rate"
        )
        result.append(Check(f"frames of {name}", text, "none missing", not missing))
    return result


def motion_checks(
    photographs: Mapping[str, Any],
    videos: Mapping[str, Mapping[str, Any]],
    flights: Mapping[str, Mapping[str, Any]],
) -> list[Check]:
    """Checks of masks and free flight, from reports of photographs, of videos by name, and of flights by take."""
    count, out = photographs["photographs"], photographs["left_out"]
    text = f"{count - len(out)} of {count}" + (f" (not {', '.join(out)})" if out else "")
    what = f"masks of photographs that agree (IoU > {MIN_AGREEMENT})"
    result = [Check(what, text, "nearly all", len(out) <= _MAX_LEFT_OUT * count)]
    for name, report in videos.items():
        if shift := report.get("camera_shift"):
            text, wanted = f"{100 * shift:.2f} % of the picture", f"< {100 * _MAX_SHIFT:g} %"
            result.append(Check(f"motion of the camera in {name}", text, wanted, shift < _MAX_SHIFT))
        if left_out := report.get("left_out"):
            text = "; ".join(str(Break(**each)) for each in left_out)
            result.append(Check(f"frames of {name} left out", text, "none", False))
        jump = report["largest_jump"]
        text = "no free flight" if jump is None else f"{100 * jump:.1f} %"
        good = jump is not None and jump < _MAX_JUMP
        result.append(Check(f"area of {name}, frame to frame", text, f"< {100 * _MAX_JUMP:.0f} %", good))
    for take, flight in flights.items():
        result += [*gravity_checks(f"silhouettes of {take}", flight), *flight_checks(take, flight)]
    return result


def flight_checks(take: str, flight: Mapping[str, Any]) -> list[Check]:
    """Checks of the report of a free flight (`neuma_lib.capture.motion.flight.report`)."""
    rms, ious = flight["rms_px"], flight["agreement"] or {}
    return [Check(f"flight in {take}", f"{rms:.2f} px off the fit", "< 1 px", rms < 1)] + [
        Check(f"mask of {camera} at rest, {take}", f"IoU {iou:.2f}", "> 0.7", iou > 0.7)
        for camera, iou in ious.items()
    ]


def gravity_checks(name: str, report: Mapping[str, Any]) -> list[Check]:
    """Checks of a `Gravity.report`."""
    ratio, spread = report["gravity_ratio"], report["gravity_ratio_deviation"]
    angle, angle_std = report["gravity_angle_deg"], report["gravity_angle_deviation_deg"]
    size = f"{ratio:.3f} +- {spread:.3f} of {GRAVITY} m/s^2"
    direction = f"{angle:.1f} +- {angle_std:.1f} degrees off the floor's normal"
    return [
        Check(f"gravity in {name}", size, "1 +- 0.03", abs(ratio - 1) < 0.03 + 2 * spread),
        Check(f"down in {name}", direction, "< 1.5 degrees", angle < 1.5 + 2 * angle_std),
    ]


def object_checks(fits: Mapping[str, Mapping[str, Any]]) -> list[Check]:
    """Checks of the Gaussians fitted to the photographs, from the report of each fit by name of the body, or ""."""
    result = []
    for body, fit in fits.items():
        psnr = fit["psnr_object"]
        text = (
            f"{psnr:.1f} dB inside the object ({len(fit['held_out'])} photographs, {fit['count']} Gaussians)"
        )
        what = "PSNR of photographs kept from the fit" + (f", {body}" if body else "")
        result.append(Check(what, text, f"> {MIN_PSNR:g} dB", psnr > MIN_PSNR))
    return result


def registration_checks(placed: Mapping[str, Mapping[str, Any]]) -> list[Check]:
    """Checks of the object's pose in the videos, from the registration report of each take."""
    result = []
    for take, report in placed.items():
        turn = max(report["rotation_std_deg_principal"])
        text, wanted = f"+-{turn:.1f} degrees", f"< {MAX_TURN:g} degrees"
        result.append(Check(f"pose of the object in {take}", text, wanted, turn < MAX_TURN))
        result += gravity_checks(take, report)
        for camera, after in report["after"].items():
            text, wanted = f"IoU {after['iou']:.3f}", f"> {_MIN_OVERLAP:g}"
            what = f"placed object in {take}, {camera}"
            result.append(Check(what, text, wanted, after["iou"] > _MIN_OVERLAP))
    return result


def markdown(title: str, checks: list[Check], pictures: Mapping[str, str], missing: str | None = None) -> str:
    """A page with a table of checks, a note on what is missing, and pictures: caption -> path relative to the page."""
    lines = [f"# {title}", "", "| check | measured | expected | |", "|---|---|---|---|"]
    for check in checks:
        lines.append(
            f"| {check.what} | {check.value} | {check.wanted} | {'ok' if check.good else '**failed**'} |"
        )
    lines += ["", missing] if missing else []
    for caption, file in pictures.items():
        lines += ["", f"## {caption}", "", f"![{caption}]({file})"]
    return "\n".join(lines) + "\n"
