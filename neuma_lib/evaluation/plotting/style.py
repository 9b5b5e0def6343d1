"""Style of figures: sizes, fonts, colours of methods, and saving.

Widths are those of a two-column page. Fonts have 7 points in print, at least 6. Colours are those of Okabe and Ito
(2008), which people with any colour vision can distinguish. Lines also differ in dash and points in marker, for print
in black and white.
"""

import functools
from collections.abc import Callable, Collection, Iterable
from dataclasses import dataclass
from pathlib import Path

import matplotlib
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from neuma_lib.io.files import atomic

COLUMN, PAGE = 3.3, 6.9  # widths of a column and of a page [in]
DPI = 300  # resolution of the PNG files and of pictures inside PDF files

BLACK, GREY, LIGHT = "#000000", "#7f7f7f", "#e6e6e6"
ORANGE, SKY, GREEN, YELLOW, BLUE, VERMILION, PURPLE = (
    "#E69F00", "#56B4E9", "#009E73", "#F0E442", "#0072B2", "#D55E00", "#CC79A7",
)  # fmt: skip
SEQUENCE = (BLUE, ORANGE, GREEN, PURPLE, VERMILION, SKY)  # colours of lines that are not methods, in order
RAMP = "cividis"  # colour map of ordered quantities, uniform in lightness and suited to colour-blind readers


@dataclass(frozen=True)
class Look:
    """Colour, marker and dash of one method."""

    color: str
    marker: str = "o"
    dash: str | tuple = "-"

    @property
    def line(self) -> dict:
        """Keywords for `Axes.plot`."""
        return {"color": self.color, "linestyle": self.dash}


METHODS = {
    "truth": Look(BLACK, "*", "-"),
    "neuma": Look(BLUE, "o", "-"),
    "nclaw": Look(ORANGE, "s", (0, (4, 1.5))),
    "neuma_particle_supervision": Look(GREEN, "^", (0, (1, 1))),
    "neuma_without_binding": Look(VERMILION, "v", (0, (5, 1, 1, 1))),
    "neuma_without_adaptor": Look(PURPLE, "D", (0, (2, 1))),
    "neuma_same_inputs": Look("#0f0f87", ">", (0, (3, 1, 1, 1))),
    "true_law": Look("#5b3a1e", "d", (0, (1, 2))),
    "constants": Look("#330dcc", "p", (0, (6, 2, 2, 2))),
    "neuma_structured": Look("#a5005a", "h", (0, (8, 1.5))),
    "pac_nerf": Look(SKY, "P", (0, (5, 1, 1, 1, 1, 1))),
    "pac_nerf_own": Look("#2d78ff", "<", (0, (1, 2, 4, 2))),
    "spring_gaus": Look(YELLOW, "X", (0, (3, 2))),
}
"""Look of each method in all figures."""
TRUE_PARTICLES = "#8c8c8c"
"""Colour of true particles as spheres. Black would hide their shading."""

SETTINGS = {
    "font.family": "sans-serif",
    "font.sans-serif": ["DejaVu Sans"],
    "mathtext.fontset": "dejavusans",
    "font.size": 7,
    "axes.titlesize": 7,
    "axes.labelsize": 7,
    "xtick.labelsize": 6.5,
    "ytick.labelsize": 6.5,
    "legend.fontsize": 6.5,
    "figure.titlesize": 8,
    "legend.frameon": False,
    "legend.handlelength": 2.2,
    "axes.linewidth": 0.6,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.titlepad": 4,
    "axes.labelpad": 2,
    "axes.axisbelow": True,
    "xtick.major.width": 0.6,
    "ytick.major.width": 0.6,
    "xtick.major.size": 2.5,
    "ytick.major.size": 2.5,
    "xtick.minor.size": 1.5,
    "ytick.minor.size": 1.5,
    "lines.linewidth": 1.1,
    "lines.markersize": 3.5,
    "grid.color": LIGHT,
    "grid.linewidth": 0.5,
    "savefig.dpi": DPI,
    "pdf.fonttype": 42,  # text stays text
}


def look(method: str) -> Look:
    """Look of a method. A variant such as ``neuma+rank=4`` has that of its base, unknown methods are grey."""
    return METHODS.get(method.partition("+")[0], Look(GREY))


def styled(draw: Callable[..., Figure]) -> Callable[..., Figure]:
    """Decorate a drawing function to use this style instead of the user's settings of matplotlib."""

    @functools.wraps(draw)
    def inside(*args, **kwargs) -> Figure:
        with matplotlib.rc_context():
            matplotlib.rcdefaults()
            matplotlib.rcParams.update(SETTINGS)
            return draw(*args, **kwargs)

    return inside


def new_figure(width: float, height: float) -> Figure:
    """An empty figure of a size in print [in] with automatic placement of its panels."""
    return Figure(figsize=(width, height), layout="constrained")


def new_canvas(width: float, height: float) -> Figure:
    """An empty figure of a size in print [in] with manual placement of its parts (`image_grid`)."""
    return Figure(figsize=(width, height))


def scene_labels(scenes: Iterable[str], seen: Collection[str]) -> list[str]:
    """Names of scenes, with a remark for images measured in a training view."""
    return [f"{scene}\n(training view)" if scene in seen else scene for scene in scenes]


def separate(axes: Axes, count: int) -> None:
    """Draw vertical lines between ``count`` categories at 0, 1, ..."""
    for edge in range(count - 1):
        axes.axvline(edge + 0.5, color=LIGHT, linewidth=0.5)


def legend_above(figure: Figure, axes: Axes, columns: int) -> None:
    """One legend for all panels, above them."""
    figure.legend(*axes.get_legend_handles_labels(), loc="outside upper center", ncols=columns)


def save(figure: Figure, *paths: str | Path) -> None:
    """Write a figure. The suffix of each path gives the format. The same figure gives the same bytes."""
    with matplotlib.rc_context():
        matplotlib.rcdefaults()
        matplotlib.rcParams.update(SETTINGS)
        for path in paths:
            kind = Path(path).suffix[1:]
            # Without dates and versions, so that files are reproducible.
            nothing = {"pdf": {"CreationDate": None, "Producer": None}, "png": {"Software": None}}
            with atomic(path) as partial:
                figure.savefig(partial, format=kind, dpi=DPI, metadata=nothing.get(kind))
