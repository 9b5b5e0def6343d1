"""Reads and checks the settings; folders, machine, names and functions that every rule shares."""

import gc
import os
import sys
from pathlib import Path

ROOT = Path(workflow.current_basedir.get_path_or_uri(secret_free=True)).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from snakemake.logging import logger

from neuma_lib.project.capture_scenes import captured_scenes
from neuma_lib.project.checks import local_problems, problems
from neuma_lib.project import cases
from neuma_lib.project.loading import load, load_captures, read_yaml
from neuma_lib.project.project import remember_settings, remembered_settings
from neuma_lib.errors import InputError
from neuma_lib.mechanics.catalogue import DEFINED_IN
from neuma_lib.methods.registry import methods
from workflow.defaults import complete, digest_of, has_gpu, torch_has_gpu
from workflow.provenance import code_digest
from workflow.progress import show_one_line_a_job
from workflow.records import (
    keep_records_of_failed_jobs,
    remake_deleted_folders,
    start_local_jobs_at_once,
)
from workflow.unlock import others
from workflow.targets import refuse_unknown, requested_targets

gc.set_threshold(100_000)  # by default, searches for garbage take a tenth of Snakemake's start
show_one_line_a_job(workflow)
BROKEN = []  # captures that have no scenes, which stop only the targets that need them
try:
    # Snakemake has read them, but keeps the last of repeated keys and bounds no aliases.
    for file in filter(os.path.isfile, workflow.configfiles if workflow.is_main_process else ()):
        read_yaml(file)
    captures = load_captures(config)
    # A workflow that includes this one may plan captures before their files exist.
    PLANNED = plan_captures(config, captures.root) if "plan_captures" in globals() else {}
    SETTINGS = load(
        config, captured=captured_scenes(captures.root, captures.released, PLANNED, BROKEN.append)
    )
except InputError as error:
    # Settings of a broken capture's scene are incomplete without it.
    raise WorkflowError("\n".join(map(str, [*BROKEN, error]))) from None
if workflow.is_main_process:
    if wrong := problems(SETTINGS):
        raise WorkflowError("\n".join(wrong))
    busy = [f"Another Snakemake is at work in this folder ({process})" for process in others()]
    for problem in [*busy, *map(str, BROKEN), *local_problems(SETTINGS)]:
        logger.warning(problem)

KINDS = methods(SETTINGS.extensions)
DATA = SETTINGS.data_root.rstrip("/")
RESULTS = SETTINGS.results_root.rstrip("/")
if workflow.is_main_process:
    remake_deleted_folders(RESULTS)
KERNELS = f"{DATA}/kernels"  # what is known of them; they themselves are in SETTINGS.kernel_cache
HAS_CUDA = torch_has_gpu()
GPU = int({"cpu": False, "cuda": True, "auto": HAS_CUDA}[SETTINGS.device])
# Kernels and ground truths are made with or without a GPU, so that its images can be rendered where none is.
EITHER_DEVICE = "cpu" if SETTINGS.device == "cpu" else "auto"
EITHER_GPU = int(GPU and HAS_CUDA)

# Scripts run in separate processes. They find the library and share one kernel cache. NEUMA_GPUS is the number of GPUs
# to spread them over.
FOLDERS = [str(ROOT / "workflow" / "interpreter"), str(ROOT)]
os.environ.update(
    {
        "PYTHONPATH": os.pathsep.join([*FOLDERS, *filter(None, [os.environ.get("PYTHONPATH")])]),
        "NEUMA_KERNEL_CACHE": str(Path(SETTINGS.kernel_cache).resolve()),
    }
)


# Runs when all jobs are known and none has started, and not in a dry run. A cluster's nodes are not this machine.
onstart:
    keep_records_of_failed_jobs(workflow.persistence)
    start_local_jobs_at_once(workflow)
    rules = sorted({job.rule.name for job in workflow.dag.needrun_jobs() if job.resources.get("gpu")})
    if SETTINGS.device == "cuda" and rules and workflow.local_exec:
        from neuma_lib.device import choose_device

        try:
            choose_device("cuda")
        except InputError as error:
            raise WorkflowError(
                f"{error}. Rules that wait for one: {', '.join(rules)}. Ground truth and images (target 'dataset')"
                " need none."
            ) from None
    for scene in {job.wildcards_dict.get("scene") for job in workflow.dag.needrun_jobs()} - {None}:
        checked(remember_settings)(RESULTS, scene, workflow.configfiles, ROOT)


def names_of(scenes, replicates=True):
    """Pattern of the names of scenes, and of the folders of their replicates."""
    return f"({'|'.join(scenes) or 'none'})" + ("([+][^/]*)?" if replicates else "")


def scenes_that(holds, replicates=True):
    """Pattern of the names of the scenes that something holds for."""
    return names_of((name for name, scene in SETTINGS.scenes.items() if holds(scene)), replicates)


# Scenes of captures and of splats have no truth. Takes have the body and the motion from registration.
TRUE_SCENE = scenes_that(lambda scene: scene.has_truth)
# A scene of several bodies has a scene for each of them, which sees nothing of the others.
PILE_SCENE = scenes_that(lambda scene: scene.bodies)
DRAWN_PILE = scenes_that(lambda scene: scene.bodies and not scene.captured)
PART_SCENE = scenes_that(lambda scene: scene.part_of and not (scene.captured and scene.captured.throw))
DRAWN_PART = scenes_that(lambda scene: scene.part_of and not scene.captured)
CAPTURED_PART = scenes_that(lambda scene: scene.part_of and scene.captured, replicates=False)
SINGLE_SCENE = scenes_that(lambda scene: not scene.bodies)
LONE_SCENE = scenes_that(lambda scene: scene.has_truth and not scene.part_of)
SPLAT_SCENE = scenes_that(lambda scene: scene.splat)
OBJECT_SCENE = scenes_that(lambda scene: not (scene.bodies or scene.captured and scene.captured.throw))
PICTURED_SCENE = scenes_that(
    lambda scene: not (
        scene.splat or scene.bodies or scene.part_of or scene.captured and scene.captured.throw
    )
)
TAKE_SCENE = scenes_that(lambda scene: scene.captured and scene.captured.throw, replicates=False)
REGISTERED_SCENE = scenes_that(
    lambda scene: scene.captured and scene.captured.throw and not scene.bodies, replicates=False
)
FILMED_SCENE = scenes_that(
    lambda scene: scene.captured and scene.captured.throw and not scene.part_of, replicates=False
)
# Experiments have their own folder. Rules that also accept scenes have the wildcard `scene` for both.
EXPERIMENT = f"experiments/{names_of(SETTINGS.experiments)}"


wildcard_constraints:
    scene=f"({'|'.join(SETTINGS.scenes) or 'none'})([+][^/]*)?",
    prior=f"({'|'.join(SETTINGS.priors.laws) or 'none'})([+]seed=[1-9][0-9]*)?",
    method=f"({'|'.join(SETTINGS.methods) or 'none'})([+][^/]*)?",
    group="binding|geometry|simulation|laws|rendering|radiance|springs",
    views="[0-9]+(,[0-9]+)*",


def kernels(*groups):
    """Markers of compiled groups of Warp kernels. The group `laws` requires `simulation`."""
    return [f"{KERNELS}/{group}.ready" for group in groups]


def checked(function):
    """A function whose InputError ends Snakemake with its message alone."""

    def call(*arguments):
        try:
            return function(*arguments)
        except InputError as error:
            raise WorkflowError(str(error)) from None

    return call


def missing_settings(target):
    """Settings files that the latest run of a target's folder had and this one has not."""
    given = {Path(file).resolve() for file in workflow.configfiles}
    files = [file.resolve() for file in remembered_settings(target, ROOT)]
    return [os.path.relpath(file) for file in files if file not in given]


def code_of(script, draws=False):
    """A function of wildcards: digest of a script, of the method that it loads, and of what draws laws.

    A method in a file may name any of the own laws.
    """

    def digest(wildcards):
        kind = cases.kind_of(SETTINGS, wildcards.method)
        loaded = type(kind).__module__
        laws = {*DEFINED_IN.values()} - {loaded} if loaded in SETTINGS.extensions else ()
        drawing = [kind.draws_module] if draws and kind.draws_module else []
        return code_digest(ROOT / "workflow" / "scripts" / script, loaded, *drawing, *sorted(laws))

    return digest


def code_of_methods(script):
    """A function of wildcards: digest of a script that may load every method."""
    modules = {type(method).__module__ for method in KINDS.values()}
    modules = sorted(modules | {kind.draws_module for kind in KINDS.values() if kind.draws_module})
    return lambda wildcards: code_digest(ROOT / "workflow" / "scripts" / script, *modules)
