"""What the paper prints: numbers of its tables, and what it says about them.

Distances are Chamfer distances in 1e-4 m^2 and contain the paper's sampling floor. Rows are named by the method that
stands for them here, columns by scene or experiment. Claims are judged by the tracer RMSE
(`neuma_lib.paper.tables`), which
the paper does not give.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

BROKEN = "broke_off"
"""Runs whose prediction broke off [%]."""
OUTSIDE = "outside_band"
"""Visited points of response curves at which the truth is outside the band of a law [%]."""


@dataclass(frozen=True)
class Claim:
    """A statement that methods are no further from the truth than others, on the average of some columns.

    Attributes:
        text: the statement.
        better, worse: methods; none of the first may be worse than any of the second.
        columns: scenes or experiments; all columns if empty.
        by_paper: False for what is said here and not in the paper.
    """

    text: str
    better: tuple[str, ...]
    worse: tuple[str, ...]
    columns: tuple[str, ...] = ()
    by_paper: bool = True


@dataclass(frozen=True)
class Target:
    """A bound that we set ourselves to the error of a method.

    Attributes:
        statement: what is said, with places for ``most`` and ``count``.
        method: whose error it is.
        most: the bound, in the table's unit, or in multiples of the error of the method ``of`` in the same column.
        of: the method that it is measured by; none if empty.
        count: in how many columns it has to be kept; None: on average over them.
        columns: scenes or experiments; all columns if empty.
        quantity: which of the table's errors it is; that which the table is judged by if empty.
    """

    statement: str
    method: str
    most: float
    of: str = ""
    count: int | None = None
    columns: tuple[str, ...] = ()
    quantity: str = ""

    @property
    def text(self) -> str:
        """The statement with its numbers."""
        return self.statement.format(most=self.most, count=self.count)

    @property
    def methods(self) -> set[str]:
        """Methods that it is about."""
        return {self.method, self.of} - {""}


@dataclass(frozen=True)
class PaperTable:
    """A table of the paper, or one of ours.

    Attributes:
        label: its name there.
        heading: our heading.
        caption: one sentence for the report.
        columns: scenes or experiments.
        rows: method -> one distance a column.
        claims: what can be checked with the numbers of a run.
        targets: what we want of these numbers.
    """

    label: str
    heading: str
    caption: str
    columns: tuple[str, ...] = ()
    rows: Mapping[str, tuple[float, ...]] = field(default_factory=dict)
    claims: tuple[Claim, ...] = ()
    targets: tuple[Target, ...] = ()

    def row(self, method: str, columns: Sequence[str]) -> list[float] | None:
        """The distances of a method in some columns, or None where the paper does not have them all."""
        if method not in self.rows or not set(columns) <= set(self.columns):
            return None
        printed = dict(zip(self.columns, self.rows[method], strict=True))
        return [printed[column] for column in columns]


def prior(law: str) -> str:
    """The method that adapts another prior than the scene's."""
    return f"neuma+prior={law}"


I, II, III, IV, V = (  # noqa: E741 - the paper's numbering
    prior(law)
    for law in (
        "stvk_von_mises",
        "neo_hookean_von_mises",
        "fixed_corotated_von_mises",
        "fixed_corotated_identity",
        "stvk_drucker_prager",
    )
)
_SCENES = ("BouncyBall", "JellyDuck", "RubberPawn", "ClayCat", "SandFish", "HoneyBottle")
_SYSTEMS = {
    "pac_nerf": (516.30, 137.73, 15.47, 15.38, 1.71, 2.21),
    "neuma": (1.19, 3.03, 1.27, 1.00, 0.65, 0.73),
}
FOUND = prior("identified")
_GROUNDING = ("RubberPawn", "ClayCat")
_TOLD_AGAINST_ASSUMED = ("neuma",), ("neuma+assumed_density=1000",)
_CHOICES = ("BouncyBall", "RubberPawn", "ClayCat")
_GENERALISATION = ("letter_N_rubber", "letter_N_clay")
_FINER = ("BouncyBall_finer", "JellyDuck_finer", "RubberPawn_finer", "ClayCat_finer", "SandFish_finer",
          "HoneyBottle_finer")  # fmt: skip
_OUTSIDE = (
    "OutsideStiffening",
    "OutsideRubber",
    "OutsideFoam",
    "OutsidePaste",
    "OutsideDampSand",
    "OutsideFibres",
)
_LETTERS = (
    "letter_N_bouncy",
    "letter_N_jelly",
    "letter_N_rubber",
    "letter_N_clay",
    "letter_N_sand",
    "letter_N_honey",
)

PAPER = {
    "table1": PaperTable(
        "tab:Ch_dist",
        "Table 1: dynamics grounding",
        "Predicted against true motion",
        _SCENES,
        {
            **_SYSTEMS,
            "nclaw": (56.13, 6.32, 3.31, 2.45, 2.61, 2.26),
            "neuma_particle_supervision": (1.45, 3.74, 1.25, 1.00, 0.80, 0.84),
            # Judged on the Gaussians that it was trained with; on the particles that all share: no experiment of it.
            "neuma_without_binding_own": (3.34, 28.42, 4.62, 1.26, 0.97, 1.01),
            "neuma_without_adaptor": (1.87, 3.63, 1.42, 1.36, 1.21, 1.23),
        },
        (
            Claim("NeuMA is closer than its prior", ("neuma",), ("nclaw",)),
            Claim(
                "NeuMA is closer than w/o Bind on its own particles",
                ("neuma",),
                ("neuma_without_binding_own",),
            ),
            Claim(
                "NeuMA is closer than w/o Bind on the particles that all share",
                *(("neuma",), ("neuma_without_binding",), (), False),
            ),
            Claim("NeuMA is closer than w/o ΔM", ("neuma",), ("neuma_without_adaptor",)),
            Claim("NeuMA is closer than w/ P.S.", ("neuma",), ("neuma_particle_supervision",)),
            Claim(
                "constants found in the video are closer than NeuMA", ("constants",), ("neuma",), (), False
            ),
            Claim(
                "the structured correction is no worse than the constants",
                *(("neuma_structured",), ("constants",), (), False),
            ),
        ),
    ),
    "table1_systems": PaperTable(
        "tab:Ch_dist",
        "Other systems on the scenes of Table 1",
        "Predicted against true motion, of PAC-NeRF and Spring-Gaus too",
        _SCENES,
        _SYSTEMS,
    ),
    "table2": PaperTable(
        "tab:quant_gen",
        "Table 2: generalisation",
        "Trained laws on the letter N, and two of them on one grid, against the true laws",
        ("letter_N_bouncy", "letter_N_rubber", "letter_N_sand", "ball_and_cat"),
        {
            "neuma": (0.99, 0.36, 0.33, 0.71),
            "neuma_particle_supervision": (1.16, 0.32, 0.30, 0.73),
            "neuma_without_binding": (4.26, 14.99, 0.48, 1.19),
            "neuma_without_adaptor": (1.78, 0.45, 0.36, 0.91),
        },
        (
            Claim("NeuMA generalises better than w/o Bind", ("neuma",), ("neuma_without_binding",)),
            Claim("NeuMA generalises better than w/o LoRA", ("neuma",), ("neuma_without_adaptor",)),
            Claim(
                "structured laws generalise better than NeuMA", ("neuma_structured",), ("neuma",), (), False
            ),
        ),
    ),
    "table3": PaperTable(
        "tab:inaccurate_base",
        "Table 3: wrong priors",
        "Priors of other laws than the true one, adapted to the video: grounding, and generalisation to the letter N",
        (*_GROUNDING, *_GENERALISATION),
        {
            I: (1.27, 1.00, 0.36, 1.23),
            II: (1.94, 0.91, 0.36, 1.04),
            III: (1.95, 1.60, 0.36, 1.47),
            IV: (3.64, 3.22, 0.70, 1.31),
            V: (30.26, 12.91, 3.91, 3.31),
        },
        (
            Claim(
                "in grounding, the prior of the true law is closer than II to V",
                *(("neuma",), (II, III, IV, V), _GROUNDING, False),
            ),
            Claim("in grounding, I is closer than II to V", (I,), (II, III, IV, V), _GROUNDING),
            Claim("in grounding, IV and V are worst", (I, II, III), (IV, V), _GROUNDING),
            Claim("on the letter, IV and V are worst", (I, II, III), (IV, V), _GENERALISATION),
            Claim(
                "a prior found in the video is no worse than I to V", (FOUND,), (I, II, III, IV, V), (), False
            ),
        ),
    ),
    "table5": PaperTable(
        "tab:lora_rank",
        "Table 5: rank of the adaptor",
        "NeuMA with adaptors of several ranks",
        ("BouncyBall", "RubberPawn", "SandFish"),
        {
            "neuma+rank=4": (1.35, 1.50, 0.68),
            "neuma+rank=8": (1.23, 1.41, 0.67),
            "neuma": (1.19, 1.27, 0.65),
            "neuma+rank=24": (1.20, 1.28, 0.66),
        },
        (
            Claim("rank 16 is no worse than rank 4", ("neuma",), ("neuma+rank=4",)),
            Claim("rank 16 is no worse than rank 8", ("neuma",), ("neuma+rank=8",)),
            Claim("rank 24 is no better than rank 16", ("neuma",), ("neuma+rank=24",)),
        ),
    ),
    "uneven_mass": PaperTable(
        "fig:uneven_mass",
        "Uneven mass",
        "An object of two densities: told to the method, or taken to be of one density",
        ("UnevenCat",),
        {"neuma": (1.33,)},
        (
            Claim(
                "knowing the densities is no worse than assuming one", *_TOLD_AGAINST_ASSUMED, by_paper=False
            ),
        ),
    ),
    "ablation_gradients": PaperTable(
        "",
        "Choices that the paper leaves open",
        "NeuMA with other gradients and covariances",
        _CHOICES,
        claims=(
            Claim(
                "gradients through the covariances help",
                *(("neuma",), ("neuma+covariance_gradient=false",), _CHOICES, False),
            ),
            Claim(
                "zeroing the gradients helps", ("neuma",), ("neuma+zero_gradients=false",), _CHOICES, False
            ),
            Claim(
                "covariances from the total deformation help",
                *(("neuma+covariance_from=total",), ("neuma",), _CHOICES, False),
            ),
        ),
    ),
    "finer_truth": PaperTable(
        "",
        "Finer truths",
        "Truths on a grid twice as fine, with half the step and eight times the particles",
        _FINER,
        claims=(
            Claim("with finer truths, NeuMA is closer than its prior", ("neuma",), ("nclaw",), _FINER, False),
            Claim(
                "with finer truths, NeuMA is closer than w/o ΔM",
                *(("neuma",), ("neuma_without_adaptor",), _FINER, False),
            ),
        ),
        targets=(
            Target(
                "with finer truths, structured laws are at most {most:g} times as far off as the true law on at least "
                "{count} scenes",
                *("neuma_structured", 1.0, "true_law", 6),
            ),
        ),
    ),
    "yardstick": PaperTable(
        "",
        "The true law as yardstick",
        "Learned laws beside the true one on the same reconstructions",
        _SCENES,
        targets=(
            Target("structured laws are at most {most:g} mm off on average", "neuma_structured", 3.0),
            Target(
                "structured laws are within {most:g} times the RMSE of the true law on at least {count} scenes",
                *("neuma_structured", 1.5, "true_law", 5),
            ),
        ),
    ),
    "views": PaperTable(
        "",
        "Views",
        "Laws trained on one, two and three views",
        _SCENES,
        claims=tuple(
            Claim(
                f"trained on {words}, structured laws are closer than NeuMA",
                *((f"neuma_structured{views}",), (f"neuma{views}",), (), False),
            )
            for words, views in (
                ("one view", ""),
                ("two views", "+views=0,1"),
                ("three views", "+views=0,1,2"),
            )
        ),
        targets=(
            Target(
                "trained on three views, structured laws are at most {most:g} mm off on average",
                *("neuma_structured+views=0,1,2", 2.0),
            ),
        ),
    ),
    "outside": PaperTable(
        "",
        "Truths outside every family",
        "Truths that no prior and no candidate of the identification contains",
        _OUTSIDE,
        targets=(
            Target(
                "structured laws have at most {most:g} times the error of the constants on at least {count} scenes",
                *("neuma_structured", 0.5, "constants", 4, _OUTSIDE),
            ),
            Target(
                "structured laws have at most {most:g} times NeuMA's error on all {count} isotropic scenes",
                *("neuma_structured", 1.0, "neuma", 5, _OUTSIDE[:-1]),
            ),
        ),
    ),
    "letters": PaperTable(
        "",
        "Letters",
        "Trained laws on the letter N, thrown at 1 and at 3 m/s, against the true laws",
        (*_LETTERS, *(f"{letter}_fast" for letter in _LETTERS)),
        targets=(
            Target(
                "at 1 m/s, structured laws are at most {most:g} mm off on average",
                *("neuma_structured", 6.0, "", None, _LETTERS),
            ),
            Target(
                "at 1 and at 3 m/s, {most:g} % of the predictions of structured laws break off, on all {count} letters",
                *("neuma_structured", 0.0, "", 12),
                quantity=BROKEN,
            ),
        ),
    ),
    "table2_systems": PaperTable(
        "",
        "Other systems elsewhere",
        "What springs and laws that were learned from a video say of another body, and of the time after the video",
        (*_LETTERS[:3], "longer_bouncy", "longer_jelly"),
    ),
    "stress": PaperTable(
        "",
        "Stresses",
        "Stresses of learned laws on the states that the true law visits",
        _SCENES,
        targets=(
            Target(
                "stresses of structured laws are within {most:g} % of the true ones on at least {count} scenes",
                *("neuma_structured", 20.0, "", 4),
            ),
            Target(
                "true response curves leave the 95 % bands of structured laws at {most:g} % of the visited points on "
                "all {count} scenes",
                *("neuma_structured", 0.0, "", 6),
                quantity=OUTSIDE,
            ),
        ),
    ),
}
"""Tables by the name of our table."""

BALL_PARTICLES, BALL_RADIUS = 25_744, 0.25
"""Of the paper's BouncyBall, by its authors' released data; radius in metres."""
BALL_FLOOR = (
    f"Two samplings of a ball of the released {BALL_PARTICLES:,} particles and {BALL_RADIUS} m radius are 1.1 "
    "(jittered) to 1.3 (independent points) apart, so the paper's 1.19 for NeuMA on its ball is essentially its floor."
)
"""What the paper's smallest distance means; the two numbers are measured in tests/evaluation/test_metrics.py."""

BENCHMARKS_LABEL = "tab:benchmark_details"
BENCHMARKS = {
    "BouncyBall": {"dynamics": "Bouncy", "dt": 1e-3, "velocity": [0, -1.92, 0], "height": 0.28},
    "JellyDuck": {"dynamics": "Jelly", "dt": 1e-3, "velocity": [0, -1.62, 0], "height": 0.42},
    "RubberPawn": {"dynamics": "Rubber", "dt": 5e-4, "velocity": [0, -1.57, 0], "height": 0.39},
    "ClayCat": {"dynamics": "Clay", "dt": 5e-4, "velocity": [0, -2.11, 0], "height": 0.32},
    "HoneyBottle": {"dynamics": "Honey", "dt": 5e-4, "velocity": [0, -1.19, 0], "height": 0.42},
    "SandFish": {"dynamics": "Sand", "dt": 5e-4, "velocity": [0, -0.69, 0], "height": 0.28},
}
"""The paper's table of its benchmarks; time steps in s, velocities in m/s, heights in m."""
