"""Material-point tests of the true law, the prior and the learned law."""

import torch

from neuma_lib.evaluation.response import Visited, largest_shear_stress, sheared, uniaxial, yielding
from neuma_lib.io.files import write_json
from neuma_lib.io.hdf5 import read_arrays
from neuma_lib.io.laws import load_law
from neuma_lib.mechanics.analytic import analytic_law
from workflow.stage import stage

BEYOND = 1.6
"""How far the tests go beyond the visited range."""
POINTS = 121
STATES = 300_000
"""Most states of the motion that are looked at."""


def axis(low: float, high: float, centre: float) -> torch.Tensor:
    """Points from beyond ``low`` to beyond ``high``."""
    ends = [centre + BEYOND * (end - centre) for end in (low, high)]
    return torch.linspace(max(ends[0], 0.05), ends[1], POINTS, dtype=torch.float64)


def main(inputs, data_file: str, params, run) -> None:
    data = {}
    for k, (scene, setting) in enumerate(params.scenes.items()):
        truth, _ = read_arrays(inputs.truth[k], required=("F",), only=("F",))
        F = torch.from_numpy(truth["F"]).reshape(-1, 3, 3)
        F = F[:: max(1, len(F) // STATES)]
        laws = {
            "truth": analytic_law(setting["law"], dt=setting["dt"]),
            "nclaw": load_law(inputs.prior[k]),
            "neuma": load_law(inputs.prior[k], inputs.adaptor[k]),
        }
        seen = Visited.of(F)
        stretch, half = axis(*seen.stretch, 1.0), BEYOND * seen.shear[1]
        shear = torch.linspace(-half, half, POINTS, dtype=torch.float64)
        steps = round(params.total_shear / (params.rate * setting["dt"]))
        runs = {
            name: yielding(law, params.rate, setting["dt"], steps, seen.pressed) for name, law in laws.items()
        }
        data[scene] = {
            "uniaxial": {
                "x": stretch.tolist(),
                "stress": {name: uniaxial(law, stretch).tolist() for name, law in laws.items()},
                "visited": seen.stretch,
            },
            "shear": {
                "x": shear.tolist(),
                "stress": {name: sheared(law, shear, seen.pressed).tolist() for name, law in laws.items()},
                "visited": seen.shear,
            },
            "yield": {
                "x": runs["truth"][0].tolist(),
                "stress": {name: stress.tolist() for name, (_, stress) in runs.items()},
                "visited": (0.0, largest_shear_stress(laws["truth"], F)),
            },
        }
        run.say(
            f"{scene}: stretches {seen.stretch[0]:.2f} to {seen.stretch[1]:.2f}, J = {seen.pressed:.3f} pressed"
        )
    write_json(data_file, data)


if __name__ == "__main__":
    with stage("material_response_data", snakemake.log[0]) as run:
        main(snakemake.input, snakemake.output.data, snakemake.params, run)
