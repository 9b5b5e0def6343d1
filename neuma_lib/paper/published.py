"""Numbers that the paper prints, and the claims that a run is checked with (`published.yaml`)."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from neuma_lib.io.yaml_files import load_yaml
from neuma_lib.paper.claims import Bound, Claim, Closer

OUTSIDE = "outside_band"
"""Visited points of response curves at which the truth is outside the band of a law [%]."""
BAND = "band_half_width"
"""Half width of the band of a law over visited points, relative to the true curve [%]."""


@dataclass(frozen=True)
class PaperTable:
    """A table of the paper, or one of ours."""

    label: str = ""  # its name in the paper
    heading: str = ""  # our heading
    caption: str = ""  # one sentence for the report
    columns: Sequence[str] = ()  # scenes or experiments
    # method -> one Chamfer distance a column [1e-4 m^2]
    rows: Mapping[str, Sequence[float]] = field(default_factory=dict)
    claims: Sequence[Claim] = ()  # what is checked with the numbers of a run


def _claim(entry: Mapping[str, Any]) -> Claim:
    values = {key: tuple(value) if isinstance(value, list) else value for key, value in entry.items()}
    return (Bound if "limit" in values else Closer)(**values)


_CONTENT = load_yaml(Path(__file__).with_suffix(".yaml"))

PAPER = {
    name: PaperTable(**{**entry, "claims": tuple(map(_claim, entry.get("claims", ())))})
    for name, entry in _CONTENT["tables"].items()
}
"""Tables by the name of our table."""

BALL_PARTICLES, BALL_RADIUS = _CONTENT["ball"]["particles"], _CONTENT["ball"]["radius"]
BALL_FLOOR = (
    f"Two random sets of the released {BALL_PARTICLES:,} particles in a ball of {BALL_RADIUS} m radius have a distance "
    "of 1.1 (jittered) to 1.3 (independent points), so the paper's 1.19 for NeuMA on its ball is essentially its floor."
)
"""Sampling floor of the paper's smallest distance. Both numbers are measured in tests/evaluation/test_metrics.py."""

BENCHMARKS_LABEL = _CONTENT["benchmarks"]["label"]
BENCHMARKS = _CONTENT["benchmarks"]["scenes"]
"""The paper's table of its benchmarks; time steps in s, velocities in m/s, heights in m."""
