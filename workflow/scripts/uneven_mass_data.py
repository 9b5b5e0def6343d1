"""An object of two densities: its video, and predictions that know or do not know of them."""

import numpy as np
from matplotlib.colors import to_rgb

from neuma_lib.evaluation.figures.panels import Panels, save_panels
from neuma_lib.evaluation.figures.pictures import (
    cropped,
    evenly,
    magnified,
    milliseconds,
    observed,
    particle_pictures,
    renders,
    sphere_radius,
)
from neuma_lib.evaluation.figures.style import ORANGE, SKY
from neuma_lib.io.files import read_json
from neuma_lib.io.images import load_observation
from neuma_lib.io.particles import load_body, load_motion
from workflow.stage import stage


def main(inputs, data_file: str, params, run) -> None:
    (setting,) = params.scene.values()
    video = load_observation(inputs.transforms[0], [params.view])
    body = load_body(inputs.binding[0], inputs.gaussians[0], setting["density"])
    shown = evenly(params.shown, len(video.frames))
    cameras = magnified(video.cameras, params.magnify)
    motions = [[state[shown] for state in load_motion(file)] for file in inputs.rollouts]
    density = (body.mass / body.vol0).numpy()
    heavy = density > 0.5 * (density.min() + density.max())
    colors = np.where(heavy[:, None], to_rgb(ORANGE), to_rgb(SKY))
    told, _ = motions[list(params.titles).index("neuma")]
    pictures = [particle_pictures(told, colors, sphere_radius(body.vol0), cameras)]
    pictures.append(observed(video, shown, params.magnify))
    pictures += [renders(body, cameras, *motion) for motion in motions]
    rows = [f"NeuMA's particles:\n{density.max():.0f} (orange) and\n{density.min():.0f} kg/m³", "Observation"]
    metrics = [read_json(file) for file in inputs.metrics]
    numbers = {
        "rows": {method: 2 + k for k, method in enumerate(params.titles)},
        "chamfer": {method: m["chamfer"] for method, m in zip(params.titles, metrics, strict=True)},
        "floor": metrics[0]["chamfer_floor"],
    }
    (images,) = cropped([np.stack(pictures)])
    columns = tuple(milliseconds([video.frames[i] for i in shown], setting["dt"]))
    save_panels(data_file, Panels(images, (*rows, *params.titles.values()), columns, numbers))
    run.say(", ".join(f"{method}: Chamfer {value:.2f}" for method, value in numbers["chamfer"].items()))


if __name__ == "__main__":
    with stage("uneven_mass_data", snakemake.log[0]) as run:
        main(snakemake.input, snakemake.output.data, snakemake.params, run)
