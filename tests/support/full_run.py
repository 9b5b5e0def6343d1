"""One run of all that tiny.yaml's scene allows in addition to Table 1: measures, figures, exports, own files."""

import importlib.util
import shutil

import torch

from neuma_lib.evaluation.lpips import expected_shapes
from neuma_lib.io.weights import write_weights
from tests.support.project import ROOT, SCENE, Plan, Project, overlay

RESULTS = SCENE.rpartition("/")[0]
EXPERIMENTS = f"{RESULTS}/experiments"
LONG = f"{SCENE}/neuma+iterations=600+checkpoint_every=1+lr_scale=0.05/adaptor.safetensors"
OWN_PARTICLES = f"{SCENE}/pac_nerf_own+views=0,1"
OWN_TABLE, REPLICATES = f"{RESULTS}/own.csv", f"{RESULTS}/replicates.csv"
CUBIC = "tiny/data/Cubic/truth.h5"
USD = importlib.util.find_spec("pxr") is not None  # comes with `make viewer`
SPRINGS = "spring_gaus+iterations=2"
EXPORTED = {  # folders, with the number of bodies
    f"{SCENE}/{SPRINGS}": 1,
    f"{EXPERIMENTS}/letter/{SPRINGS}": 1,
    f"{EXPERIMENTS}/letter_and_ball/nclaw": 2,
}
EXPORTS = ["gaussians", "compressed", "particles.h5", "surface.glb", "motion.gif", "motion.blend"]
EXPORTS += ["surface.usdc", "surface.usda"] if USD else []

LETTER = {"scene": "BouncyBall", "shape": "letter_I", "height": 0.4, "velocity": [0, -2, 0]}
CUBIC_LAW = {"elasticity": {"name": "cubic_hencky", "E": 1e5, "nu": 0.3, "b": 10.0}}
METHODS = ["nclaw", "brightness", "brightness+scale=100000"]
SETTINGS = overlay(
    extensions=["own_law.py", "own_method.py"],
    scenes={"Cubic": {"like": "BouncyBall", "law": CUBIC_LAW}},
    experiments={"letter": {"title": "I", "bodies": [LETTER], "steps": 60}},
    tables={
        "own": {"scenes": ["BouncyBall"], "methods": METHODS},
        "replicates": {"scenes": ["BouncyBall"], "methods": ["nclaw", "neuma"], "seeds": 2},
    },
    figures={"beside": [OWN_PARTICLES.rpartition("/")[2]]},
    # The fit of PAC-NeRF is too short to identify a law.
    radiance={"iterations": 60},
    advanced={
        "radiance.rays": 256,
        "radiance.particles": 500,
        "pac_nerf.particles": 100,
        "pac_nerf.followed": 8,
        "pac_nerf.velocity_iterations": 3,
        "pac_nerf.iterations_contact": 1,
        "pac_nerf.iterations_all": 2,
        "pac_nerf.max_frames": 3,
        "pac_nerf.pixels": 200,
    },
)
TARGETS = [
    *(
        OWN_TABLE,
        REPLICATES,
        CUBIC,
        LONG,
        f"{RESULTS}/table2.csv",
        f"{RESULTS}/table4.csv",
        f"{RESULTS}/demo.md",
    ),
    *(f"{SCENE}/true_law/metrics.json", f"{SCENE}/neuma/image_metrics.json"),
    *(f"{OWN_PARTICLES}/metrics.json", f"{OWN_PARTICLES}/video.mp4", f"{RESULTS}/figures/main_res.png"),
    *(f"{folder}/export/{file}" for folder in EXPORTED for file in EXPORTS),
    f"{SCENE}/{SPRINGS}/export/motion_slow4.gif",
]


def write_lpips(project: Project) -> None:
    """Stand-in weights of LPIPS."""
    generator = torch.Generator().manual_seed(0)
    weights = {
        name: 0.1 * (torch.rand(shape, generator=generator) - 0.4)
        for net in ("alex", "vgg")
        for name, shape in expected_shapes(net).items()
    }
    write_weights(project.root / "tiny/data/weights/lpips.safetensors", weights, {})


def run_in_full(project: Project) -> Project:
    """Make all targets in a project that has Table 1, with stand-in weights of LPIPS."""
    for name in ("own_law.py", "own_method.py"):
        shutil.copy(ROOT / "tests/support" / name, project.root)
    write_lpips(project)
    project.output = project.run(*SETTINGS, *TARGETS)
    project.ran = Plan.of(project.output, TARGETS)
    return project
