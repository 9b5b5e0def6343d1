"""Warnings about a law learned from a capture: failed checks, and what the videos do not determine."""

from collections.abc import Mapping, Sequence
from typing import Any

from neuma_lib.capture.report.page import Check
from neuma_lib.evaluation.stress_curves import share_inside

# Limits of warnings.
_MIN_FRAMES = 10  # of a camera after the first contact
_MAX_RATIO = 1.5  # of the mean squared errors of held-out and training takes
_MIN_IOU = 0.8  # mean, of predicted masks with those of the video
_MAX_OUTSIDE = 0.25  # share of the visited range outside a 95 % band
_BLUR = 1e-3  # exposure assumed for the size of motion blur, if none is set [s]
_MAX_SKEW = 2.0  # of the object by a rolling shutter [mm]
_STRESS_TESTS = {"uniaxial": "stretch", "shear": "shear", "yield": "yielding"}


def check_warnings(groups: Mapping[str, Sequence[Check]]) -> list[str]:
    """Warnings of all failed checks."""
    return [
        f"{group}: {check.what} is {check.value}, good captures have {check.wanted}."
        for group, checks in groups.items()
        for check in checks
        if not check.good
    ]


def filming_warnings(capture: Mapping[str, Any], takes: Mapping[str, Mapping[str, Any]]) -> list[str]:
    """Warnings about the set-up of the capture.

    Args:
        capture: ``densities``, for each body by name, or "" for one, its ``value`` [kg/m^3] and whether it is
            ``stated``, and ``held_out``, names of takes.
        takes: for each take ``cameras``, with the exposure of each [s], ``flights`` and ``registrations``, the contents
            of these files by title of the motion of a body, and that of ``prediction`` (of the learned law).
    """
    warnings = []
    for name, take in takes.items():
        cameras, flights, motion = take["cameras"], take["flights"], take["prediction"]
        if len(cameras) == 1:
            warnings.append(
                f"{name}: there is only one camera. It hardly shows motion towards it, and the object is assumed to "
                "fall above the middle of the box, in a plane that faces the camera."
            )
        for title, flight in flights.items():
            if flight.get("spin_rad_s") is None:
                warnings.append(
                    f"{title}: no spin was measured in free flight, the object's surface has too little texture."
                )
        for title, placed in take.get("registrations", {}).items():
            if reason := placed.get("ambiguous"):
                warnings.append(f"{title}: the flight does not determine the pose of the object: {reason}.")
        unknown = [camera for camera, exposure in cameras.items() if not exposure]
        if unknown and motion.get("fastest_m_s"):
            smear = 1e3 * _BLUR * motion["fastest_m_s"]
            warnings.append(
                f"{name}: no exposure is set for {', '.join(unknown)}, so motion blur is neglected. At the maximum "
                f"speed of {motion['fastest_m_s']:.1f} m/s, an exposure of 1/1000 s blurs the object over {smear:.1f} "
                "mm."
            )
        delays = [flight.get("row_delay_s") or {} for flight in flights.values()]
        longest = {camera: max(each.get(camera, 0.0) for each in delays) for camera in cameras}
        skew = {c: 1e3 * delay * (motion.get("fastest_m_s") or 0.0) for c, delay in longest.items()}
        if skewed := {camera: size for camera, size in skew.items() if size > _MAX_SKEW}:
            listed = ", ".join(f"{size:.1f} mm for {camera}" for camera, size in skewed.items())
            warnings.append(
                f"{name}: no row_time is set, so a rolling shutter is neglected. It displaces opposite edges of "
                f"the object by at most {listed} at the maximum speed of {motion['fastest_m_s']:.1f} m/s."
            )
        for camera, count in (motion.get("frames_after_contact") or {}).items():
            if count < _MIN_FRAMES:
                warnings.append(
                    f"{name}, {camera}: only {count} frames show the object after its first contact. Earlier "
                    "motion contains no information on the material."
                )
        if motion.get("touched"):
            walls = ", ".join(motion["touched"])
            warnings.append(
                f"{name}: the predicted object touches the box ({walls}), where the room has no wall. Set "
                "scale or center in capture.yaml."
            )
    for body, density in capture["densities"].items():
        if density["stated"]:
            continue
        of = f" of {body}" if body else ""
        warnings.append(
            f"The density{of} is the default, {density['value']:g} kg/m³. Motion only determines the ratio of stress "
            "to density: if the object has twice the density, all stresses double. Weigh it, and set density in "
            "capture.yaml."
        )
    if not capture["held_out"]:
        warnings.append(
            "No take is held out: all measures are of videos that the law was learned from. Film another "
            "take, and list it under held_out in capture.yaml."
        )
    return warnings


def prediction_warnings(
    rows: Sequence[Mapping[str, Any]],
    method: str,
    prior: str,
    constants: str,
    predictions: Mapping[str, Mapping[str, Any]],
) -> list[str]:
    """Warnings from image measures of the learned law.

    Args:
        rows: of `neuma_lib.capture.report.images.image_rows`.
        method: the learned one.
        prior, constants: methods that evaluate the unchanged prior and the identified constants.
        predictions: content of prediction.json of the learned law, by take.
    """
    warnings = []
    for take, motion in predictions.items():
        if failure := motion.get("diverged"):
            warnings.append(
                f"{take}: the predicted motion diverged at step {failure['step']} (a particle "
                f"{failure['happened']}). Later frames show the last valid state."
            )
    if any(motion.get("stable") is False for motion in predictions.values()):
        warnings.append("The training diverged, and its best state is shown.")

    def rows_of(name: str) -> dict[tuple, Mapping[str, Any]]:
        return {(row["throw"], row["camera"], row["learned"]): row for row in rows if row["method"] == name}

    own, before = rows_of(method), rows_of(prior)
    for key, row in own.items():
        if row["throw"] == "all":
            continue
        where, first = f"{row['throw']}, {row['camera']}", before.get(key)
        if method != prior and first and row["psnr"] < first["psnr"]:
            warnings.append(
                f"{where}: the prior, without any learning, is closer to the video ({first['psnr']:.1f} dB "
                f"against {row['psnr']:.1f} dB on the object)."
            )
        if row["iou"] < _MIN_IOU:
            warnings.append(
                f"{where}: the mean IoU of predicted masks with those of the video is {row['iou']:.2f}: the "
                "predicted position or shape of the object is wrong."
            )
    for key, row in rows_of(constants).items():
        if constants != method and row["throw"] == "all" and (mine := own[key])["psnr"] < row["psnr"]:
            kind = "training" if row["learned"] else "held-out"
            warnings.append(
                f"In {kind} frames, the identified constants alone fit better ({row['psnr']:.1f} dB against "
                f"{mine['psnr']:.1f} dB on the object). Use them, or the structured law that starts from "
                "them."
            )
    trained, held_out = (own.get(("all", "all", learned)) for learned in (True, False))
    if trained and held_out and 10 ** ((trained["psnr"] - held_out["psnr"]) / 10) > _MAX_RATIO:
        warnings.append(
            f"Held-out takes are predicted worse than training takes, {held_out['psnr']:.1f} dB against "
            f"{trained['psnr']:.1f} dB on the object: the law overfits its training videos."
        )
    return warnings


def constants_warnings(identified: Mapping[str, Any] | None) -> list[str]:
    """Warnings about identified constants, of one body or several, that the videos do not determine."""
    if not identified:
        return []
    warnings = []
    for body, own in identified.get("bodies", {"": identified}).items():
        start = f"{body}: " if body else ""
        if own.get("ties"):
            warnings.append(
                f"{start}The families {', '.join([own['family'], *own['ties']])} explain the video equally "
                "well, so the family of the material is undetermined."
            )
        best = own.get("material", own["best"])
        unknown = [name for name, entry in best["quantities"].items() if not entry["determined"]]
        if unknown:
            known = [name for name, entry in best["quantities"].items() if entry["determined"]]
            rest = f" It determines {', '.join(known)}." if known else ""
            warnings.append(
                f"{start}The video does not determine {', '.join(unknown)} of the identified law, whose values are "
                f"close to those at the start of the search.{rest}"
            )
        if best.get("diverged"):
            warnings.append(
                f"{start}The motion of the identified law diverged during the search of its constants."
            )
    return warnings


def curve_warnings(
    curves: Mapping[str, Any], titles: Mapping[str, str], prior: str, constants: str
) -> list[str]:
    """Warnings about stress curves: undetermined ranges, and contradictions between laws.

    Args:
        curves: of `neuma_lib.evaluation.stress_curves.stress_curves`, or under ``bodies`` by the name of the body.
        titles: of the methods.
        prior, constants: methods that evaluate the prior and the identified constants.
    """
    bodies = curves.get("bodies", {"": curves})
    (method,) = {own["learned"] for own in bodies.values()}
    warnings = [
        "Outside the blue ranges, stress curves are extrapolated by the form of the law, since no part of the "
        "object was deformed that far."
    ]
    if all(test["laws"][method]["band"] is None for own in bodies.values() for test in own["tests"].values()):
        warnings.append(
            f"{titles[method]} has no error bars, since its uncertainty is not estimated. The bands of the identified "
            "constants are the best substitute."
        )
    verdicts = {
        prior: "the video contradicts the prior there",
        method: "either the family is wrong, or the correction fits errors other than those of stress",
    }
    for body, own in bodies.items():
        start = f"{body}: " if body else ""
        for name, test in own["tests"].items():
            for law, verdict in verdicts.items():
                share = (
                    share_inside(test, law, constants) if law in test["laws"] and law != constants else None
                )
                if share is not None and 1 - share > _MAX_OUTSIDE:
                    warnings.append(
                        f"{start}{_STRESS_TESTS[name].capitalize()}: over {100 * (1 - share):.0f} % of the visited "
                        f"range, {titles[law]} is outside the 95 % band of the identified constants: {verdict}."
                    )
    return warnings
