"""Sensitivity of the Chamfer distance of a filled body to errors of its motion: a ball moved, squashed or rotated.

python -m benchmarks.chamfer_distance

Truth and prediction are two sets of samples of the ball, as in an evaluation. The tracer RMSE is that of the
displacement.
"""

import numpy as np
import torch
import trimesh
from scipy.optimize import brentq
from scipy.spatial.transform import Rotation

from benchmarks.timing import parser_of
from neuma_lib.evaluation.text_tables import as_markdown
from neuma_lib.geometry.chamfer import chamfer_sequence
from neuma_lib.geometry.volume import sample_volume
from neuma_lib.paper.claims import shown


def moved(x: np.ndarray, amount: float) -> np.ndarray:
    """All points by the same distance [m]."""
    return x + np.array([0.0, amount, 0.0])


def squashed(x: np.ndarray, amount: float) -> np.ndarray:
    """Shorter along y by a fraction, wider along x and z, of the same volume."""
    wide = 1 / np.sqrt(1 - amount)
    return x * np.array([wide, 1 - amount, wide])


def turned(x: np.ndarray, amount: float) -> np.ndarray:
    """About the vertical axis by an angle [rad]."""
    return Rotation.from_rotvec([0.0, amount, 0.0]).apply(x)


def rmse(x: np.ndarray, y: np.ndarray) -> float:
    """Root mean square distance of corresponding points [mm]."""
    return 1e3 * float(np.sqrt(np.square(x - y).sum(axis=1).mean()))


def chamfer(a: np.ndarray, b: np.ndarray) -> float:
    """Chamfer distance of two point sets [1e-4 m^2]."""
    return float(chamfer_sequence(torch.from_numpy(a)[None], torch.from_numpy(b)[None]))


def main() -> None:
    parser = parser_of(__doc__)
    parser.add_argument("--radius", type=float, default=0.13, help="of the ball [m]")
    parser.add_argument("--points", type=int, default=100_000)
    parser.add_argument(
        "--errors", type=float, nargs="*", default=[1, 2, 5, 10, 20, 50], help="tracer RMSE [mm]"
    )
    options = parser.parse_args()
    ball = trimesh.creation.icosphere(subdivisions=5, radius=options.radius)
    truth, again = (sample_volume(ball, options.points, seed=seed) for seed in (0, 1))
    floor = chamfer(again, truth)

    def excess(displaced, amount: float) -> str:
        return shown(chamfer(displaced(again, amount), truth) - floor, 3)

    def reaching(displaced, error: float) -> float:
        """The amount that displaces by an RMSE [mm]."""
        return brentq(lambda amount: rmse(again, displaced(again, amount)) - error, 1e-6, 0.9)

    kinds = moved, squashed
    rows = [[f"{e:g}", *(excess(kind, reaching(kind, e)) for kind in kinds)] for e in options.errors]
    print(
        f"{len(truth)} and {len(again)} points in a ball of radius {options.radius} m, floor {floor:.3f}e-4 m^2"
    )
    print(*as_markdown(["tracer RMSE (mm)", "moved", "squashed"], rows, numbers=True), sep="\n")
    quarter = np.pi / 2
    print(
        f"turned by 90 degrees: RMSE {rmse(again, turned(again, quarter)):.0f} mm, excess {excess(turned, quarter)}"
    )


if __name__ == "__main__":
    main()
