"""What to distrust in what was learned from a capture: what its checks mark, and what its videos do not determine."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from neuma_lib.capture.page import Check
from neuma_lib.evaluation.stress_curves import share_inside

FEW_FRAMES = 10
"""Fewer frames of a camera after the first contact tell little of a law."""
WORSE = 1.5
"""Factor on the mean squared error, held-out throws over learned ones, from which the law fits the latter alone."""
LEAST_IOU = 0.8
"""Mean overlap of predicted and filmed masks of a prediction that is at the right place."""
MOST_OUTSIDE = 0.25
"""Part of the visited range at which curves may leave a 95 % band before it is said."""
BLUR = 1e-3
"""Exposure that smears are told for, where none is stated [s]."""
STRESS_TESTS = {"uniaxial": "stretch", "shear": "shear", "yield": "yielding"}


def of_checks(groups: Mapping[str, Sequence[Check]]) -> list[str]:
    """Every check that is off."""
    return [
        f"{group}: {check.what} is {check.value}, good captures have {check.wanted}."
        for group, found in groups.items()
        for check in found
        if not check.good
    ]


def of_filming(capture: Mapping[str, Any], throws: Mapping[str, Mapping[str, Any]]) -> list[str]:
    """What the set-up leaves open.

    Args:
        capture: ``density`` [kg/m^3], ``density_stated``, ``scale``, ``held_out``, names of throws.
        throws: of each ``cameras``; of each camera ``exposure`` [s]; ``flight``, content of its file; ``prediction``,
            content of the learned law's prediction.json; ``registration``, of its file.
    """
    found = []
    for name, throw in throws.items():
        cameras, flight, moved = throw["cameras"], throw["flight"], throw["prediction"]
        if len(cameras) == 1:
            found.append(
                f"{name}: one camera alone. It hardly sees motion towards it, and its object is taken to fall "
                "above the middle of the box, across its view."
            )
        if flight.get("spin_rad_s") is None:
            found.append(
                f"{name}: no spin was found in the flight; the object's surface has too little texture."
            )
        if said := (throw.get("registration") or {}).get("ambiguous"):
            found.append(f"{name}: the pose of the object is not told by its flight: {said}.")
        blurred = [camera for camera, exposure in cameras.items() if not exposure]
        if blurred and moved.get("fastest_m_s"):
            smear = 1e3 * BLUR * moved["fastest_m_s"]
            found.append(
                f"{name}: no exposure is stated for {', '.join(blurred)}, so that motion blur is left out. At "
                f"{moved['fastest_m_s']:.1f} m/s, the object's fastest, 1/1000 s smears it over {smear:.1f} "
                "mm."
            )
        for camera, count in (moved.get("frames_after_contact") or {}).items():
            if count < FEW_FRAMES:
                found.append(
                    f"{name}, {camera}: only {count} frames show the object after its first contact; before "
                    "it, no motion tells of the material."
                )
        if moved.get("touched"):
            walls = ", ".join(moved["touched"])
            found.append(
                f"{name}: the predicted object touches the box ({walls}), where the room has no wall: set "
                "scale or center in capture.yaml."
            )
    if not capture["density_stated"]:
        found.append(
            f"The density is the default, {capture['density']:g} kg/m³. Motion tells stress over density "
            "alone: if the object has twice the density, all stresses double. Weigh it, and state density in "
            "capture.yaml."
        )
    if not capture["held_out"]:
        found.append(
            "No throw is held out: all measures are of videos that the law was learned from. Film another "
            "throw, and name it under held_out in capture.yaml."
        )
    return found


def of_predictions(
    rows: Sequence[Mapping[str, Any]],
    method: str,
    prior: str,
    constants: str,
    predictions: Mapping[str, Mapping[str, Any]],
) -> list[str]:
    """What the measures of pictures say against the learned law.

    Args:
        rows: of `neuma_lib.evaluation.captured_images.image_rows`.
        method: the learned one.
        prior, constants: those that evaluate the prior as it is, and the identified constants.
        predictions: content of prediction.json of the learned law, by throw.
    """
    found = []
    for throw, moved in predictions.items():
        if failure := moved.get("diverged"):
            found.append(
                f"{throw}: the predicted motion broke off at step {failure['step']} (a particle "
                f"{failure['happened']}); what is shown from there on is its last sound state."
            )
    if any(moved.get("stable") is False for moved in predictions.values()):
        found.append("The training diverged, and its best state is shown.")
    own = {(row["throw"], row["camera"], row["learned"]): row for row in rows if row["method"] == method}
    before = {(row["throw"], row["camera"], row["learned"]): row for row in rows if row["method"] == prior}
    for (throw, camera, learned), row in own.items():
        if throw == "all":
            continue
        where, first = f"{throw}, {camera}", before.get((throw, camera, learned))
        if method != prior and first and row["psnr"] < first["psnr"]:
            found.append(
                f"{where}: the prior, without any learning, is closer to the video ({first['psnr']:.1f} dB "
                f"against {row['psnr']:.1f} dB on the object)."
            )
        if row["iou"] < LEAST_IOU:
            found.append(
                f"{where}: predicted and filmed masks overlap by {row['iou']:.2f} on average: the prediction "
                "is at another place than the object, or has another shape."
            )
    for row in rows:
        mine = own.get((row["throw"], row["camera"], row["learned"]))
        if row["method"] == constants != method and row["throw"] == "all" and mine["psnr"] < row["psnr"]:
            kind = "learned from" if row["learned"] else "held out"
            found.append(
                f"In frames {kind}, the identified constants alone fit better ({row['psnr']:.1f} dB against "
                f"{mine['psnr']:.1f} dB on the object): take them, or the structured law that starts from "
                "them."
            )
    seen, unseen = (own.get(("all", "all", learned)) for learned in (True, False))
    if seen and unseen and 10 ** ((seen["psnr"] - unseen["psnr"]) / 10) > WORSE:
        found.append(
            f"Held-out throws are predicted worse than learned ones, {unseen['psnr']:.1f} dB against "
            f"{seen['psnr']:.1f} dB on the object: part of what was learned holds for these videos alone."
        )
    return found


def of_constants(identified: Mapping[str, Any] | None) -> list[str]:
    """What the videos do not determine of the identified constants."""
    if not identified:
        return []
    found = []
    if identified.get("ties"):
        found.append(
            f"The families {', '.join([identified['family'], *identified['ties']])} explain the video equally "
            "well: which of them the material belongs to is not known."
        )
    best = identified["best"]
    open_ = [name for name, entry in best["quantities"].items() if not entry["determined"]]
    if open_:
        known = [name for name, entry in best["quantities"].items() if entry["determined"]]
        rest = f"; it determines {', '.join(known)}" if known else ""
        found.append(
            f"The video does not determine {', '.join(open_)} of the identified law{rest}. What is not "
            "determined is near where the search began."
        )
    if best.get("diverged"):
        found.append("The identified law broke off while its constants were sought.")
    return found


def of_curves(
    curves: Mapping[str, Any] | None, titles: Mapping[str, str], prior: str, constants: str
) -> list[str]:
    """What stress curves leave open, and where laws contradict each other.

    Args:
        curves: of `neuma_lib.evaluation.stress_curves.stress_curves`.
        titles: of the methods.
        prior, constants: the methods that evaluate the prior and the identified constants.
    """
    if not curves:
        return []
    method, tests = curves["learned"], curves["tests"]
    found = [
        "Outside the blue ranges of the stress curves no part of the object has been: there a curve is what "
        "its form makes of the rest, not a measurement."
    ]
    if all(test["laws"][method]["band"] is None for test in tests.values()):
        found.append(
            f"{titles[method]} has no error bars of its own: its networks say nothing of what else the video "
            "allows. The bands of the identified constants are the nearest to it."
        )
    verdicts = {
        prior: "the video speaks against the prior there",
        method: "either the family is wrong, or the correction fits what is no stress",
    }
    for name, test in tests.items():
        for law, verdict in verdicts.items():
            share = share_inside(test, law, constants) if law in test["laws"] and law != constants else None
            if share is not None and 1 - share > MOST_OUTSIDE:
                found.append(
                    f"{STRESS_TESTS[name].capitalize()}: over {100 * (1 - share):.0f} % of the visited range, "
                    f"{titles[law]} is outside the 95 % band of the identified constants: {verdict}."
                )
    return found
