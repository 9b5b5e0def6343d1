"""Reads and checks the settings, and says what every rule shares. Nothing is computed here."""

import os
import shutil
import sys
from pathlib import Path

ROOT = Path(workflow.basedir).resolve()
sys.path.insert(0, str(ROOT))

from neuma_lib.config import load
from neuma_lib.errors import InputError
from neuma_lib.owner import claim
from neuma_lib.provenance import code_digest

try:
    SETTINGS = load(config)
except InputError as error:
    raise WorkflowError(str(error)) from None

DATA = SETTINGS.data_root.rstrip("/")
RESULTS = SETTINGS.results_root.rstrip("/")
LOGS = f"{RESULTS}/logs"
BENCHMARKS = f"{RESULTS}/benchmarks"
KERNELS = SETTINGS.kernel_cache.rstrip("/")
ENVIRONMENT = "../../envs/conda.yaml"
WANTS_CUDA = {"cpu": False, "cuda": True, "auto": shutil.which("nvidia-smi") is not None}
GPU = int(WANTS_CUDA[SETTINGS.device])

# Scripts are processes of their own: they find the library, share one kernel cache, and keep to one thread each
# (two OpenMP threads on a busy machine are far slower than one).
THREAD_LIMITS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMEXPR_NUM_THREADS")
os.environ.update(
    {
        "PYTHONPATH": os.pathsep.join([str(ROOT), *filter(None, [os.environ.get("PYTHONPATH")])]),
        "NEUMA_KERNEL_CACHE": str(Path(SETTINGS.kernel_cache).resolve()),
        **{name: os.environ.get(name, "1") for name in THREAD_LIMITS},
    }
)
claim()  # a killed Snakemake takes its scripts with it


wildcard_constraints:
    scene="|".join(SETTINGS.scenes),
    prior="|".join(SETTINGS.priors.laws) or "none",
    method=f"({'|'.join(SETTINGS.methods) or 'none'})([+][^/]*)?",
    group="simulation|laws|rendering",


def kernels(*groups):
    """Files that say that groups of Warp kernels are compiled; `laws` brings `simulation` with it."""
    return [f"{KERNELS}/{group}.ready" for group in groups]


def code(script):
    """Digest of a script and of the library code that it reaches; as a parameter it makes edits rerun the rule."""
    return code_digest(ROOT / "workflow" / "scripts" / f"{script}.py", ROOT)


def checked(function):
    """An input or parameter function whose InputError ends Snakemake with its message alone."""

    def call(wildcards):
        try:
            return function(wildcards)
        except InputError as error:
            raise WorkflowError(str(error)) from None

    return call


def scene_setting(*names):
    """A function of wildcards: the named settings of the scene, as plain values."""

    @checked
    def choose(wildcards):
        scene = SETTINGS.scene(wildcards.scene).plain()
        return scene[names[0]] if len(names) == 1 else {name: scene[name] for name in names}

    return choose


def frame_steps(wildcards):
    return list(SETTINGS.scene(wildcards.scene).frame_steps(SETTINGS.dataset.frames))


def simulation_settings(wildcards):
    """Constants of the simulator for a scene."""
    section = SETTINGS.simulation.plain()
    return {
        "dt": SETTINGS.scene(wildcards.scene).dt,
        **{name: section[name] for name in ("grid", "gravity", "boundary", "wall_cells")},
    }


def prior_file(name):
    """The file of a prior: made here if it is a name in the settings, the user's own if it is a path."""
    return f"{RESULTS}/priors/{name}.safetensors" if name in SETTINGS.priors.laws else name


def table_files(table, name):
    """A file of every cell of a table, row by row."""
    rows = SETTINGS.tables[table]
    return [f"{RESULTS}/{scene}/{method}/{name}" for method in rows.methods for scene in rows.scenes]


def table_cells(table):
    """Method, learning-rate factor and scene of every cell of a table, in the order of `table_files`."""
    rows = SETTINGS.tables[table]
    return [
        {
            "method": method.partition("+")[0],
            "lr_scale": SETTINGS.method_material(scene, method).lr_scale,
            "scene": scene,
        }
        for method in rows.methods
        for scene in rows.scenes
    ]


def table_titles(table):
    """Row names of a table by method."""
    return {method: SETTINGS.method_title(method) for method in SETTINGS.tables[table].methods}


@checked
def material_settings(wildcards):
    return SETTINGS.method_material(wildcards.scene, wildcards.method).plain()


@checked
def material_prior(wildcards):
    return prior_file(SETTINGS.method_prior(wildcards.scene, wildcards.method))


@checked
def true_particles(wildcards):
    """Ground truth, for the particle-supervised ablation alone."""
    material = SETTINGS.method_material(wildcards.scene, wildcards.method)
    return f"{DATA}/{wildcards.scene}/particles.h5" if material.supervision == "particles" else []


@checked
def trained_adaptor(wildcards):
    """The adaptor, where the method trains one."""
    material = SETTINGS.method_material(wildcards.scene, wildcards.method)
    return f"{RESULTS}/{wildcards.scene}/{wildcards.method}/adaptor.safetensors" if material.train else []


def overview_files(pattern):
    return expand(pattern, scene=SETTINGS.evaluation.overview)
