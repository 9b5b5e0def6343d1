"""Reads and checks the settings, and says what every rule shares. Nothing is computed here."""

import os
import shutil
import sys
from pathlib import Path
from types import SimpleNamespace

ROOT = Path(workflow.basedir).resolve()
sys.path.insert(0, str(ROOT))

from neuma_lib.config.settings import load
from neuma_lib.errors import InputError
from workflow.defaults import complete
from workflow.provenance import code_digest

try:
    SETTINGS = load(config)
except InputError as error:
    raise WorkflowError(str(error)) from None

DATA = SETTINGS.data_root.rstrip("/")
RESULTS = SETTINGS.results_root.rstrip("/")
KERNELS = SETTINGS.kernel_cache.rstrip("/")
HAS_CUDA = shutil.which("nvidia-smi") is not None
GPU = int({"cpu": False, "cuda": True, "auto": HAS_CUDA}[SETTINGS.device])
# Kernels and ground truths are made with or without a GPU, so that its images can be rendered where none is.
EITHER_DEVICE = "cpu" if SETTINGS.device == "cpu" else "auto"
EITHER_GPU = int(GPU and HAS_CUDA)

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


# Runs when all jobs are known and none has started, and not in a dry run. A cluster's nodes are not this machine.
onstart:
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


# Tables of distances; the other two have rules of their own.
CHAMFER_TABLES = [name for name in SETTINGS.tables if name not in ("table4", "learning_rates")]


wildcard_constraints:
    scene="|".join(SETTINGS.scenes),
    prior="|".join(SETTINGS.priors.laws) or "none",
    method=f"({'|'.join(SETTINGS.methods) or 'none'})([+][^/]*)?",
    experiment="|".join(SETTINGS.experiments) or "none",
    table="|".join(CHAMFER_TABLES) or "none",
    group="geometry|simulation|laws|rendering",


def body_files(folder):
    """Files of a reconstructed body: the particles that are simulated, the Gaussians, and what binds them."""
    names = {"particles": "particles.h5", "binding": "binding.h5", "gaussians": "gaussians.ply"}
    return {name: f"{RESULTS}/{folder}/{file}" for name, file in names.items()}


def each_of(bodies):
    """Files by name of several bodies."""
    bodies = [body_files(folder) for folder in bodies]
    return {name: [body[name] for body in bodies] for name in body_files("")}


def kernels(*groups):
    """Files that say that groups of Warp kernels are compiled; `laws` brings `simulation` with it."""
    return [f"{KERNELS}/{group}.ready" for group in groups]


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


def origin_of(part, scene):
    """Whether a part ('static', 'dynamic', 'truth') of a scene is 'made', 'supplied' by the user or 'packed'.

    A truth is not supplied: that of a scene with a video of the user's is simulated.
    """
    if getattr(SETTINGS.scenes[scene].images, "dynamic" if part == "truth" else part):
        return "made" if part == "truth" else "supplied"
    return "packed" if SETTINGS.dataset.packed else "made"


def scenes_with(part, origin):
    """Pattern of the scenes whose part is of an origin: each file has one maker."""
    return "|".join(scene for scene in SETTINGS.scenes if origin_of(part, scene) == origin) or "none"


def truth_memory(wildcards):
    """Memory that a ground truth takes [MB]: twice the particles (x, v, F, C) and tracers of all frames."""
    bytes_a_frame = 96 * SETTINGS.dataset.particles + 24 * SETTINGS.dataset.tracers
    return 2000 + 2 * len(SETTINGS.frame_steps(wildcards.scene)) * bytes_a_frame // 10**6


def frame_steps(wildcards):
    return list(SETTINGS.frame_steps(wildcards.scene))


def simulation_settings(wildcards):
    """Constants of the simulator for a scene."""
    return simulator(SETTINGS.scene(wildcards.scene).dt)


def simulator(dt):
    """Constants of the simulator with a time step [s]."""
    section = SETTINGS.simulation.plain()
    return {"dt": dt, **{name: section[name] for name in ("grid", "gravity", "boundary", "wall_cells")}}


def prior_file(name):
    """The file of a prior: made here if it is a name in the settings, the user's own if it is a path."""
    return f"{RESULTS}/priors/{name}.safetensors" if name in SETTINGS.priors.laws else name


def table_runs(table):
    """Every run behind a table, row by row: its method (without the seed), column, and folder."""
    chosen = SETTINGS.tables[table]
    columns = [(scene, scene, scene) for scene in chosen.scenes]
    columns += [(n, SETTINGS.experiments[n].bodies[0].scene, f"experiments/{n}") for n in chosen.experiments]
    return [
        {"method": method, "column": column, "scene": scene, "folder": f"{RESULTS}/{folder}/{run}"}
        for method in chosen.methods
        for column, scene, folder in columns
        for run in SETTINGS.seeded(table, method, scene)
    ]


def table_files(table, name):
    """A file of every run behind a table, in the order of `table_runs`."""
    return [f"{run['folder']}/{name}" for run in table_runs(table)]


def table_benchmarks(table):
    """Benchmark files of all work behind the scenes of a table, stage by stage."""
    runs = [run for run in table_runs(table) if run["column"] == run["scene"]]
    scenes = list(dict.fromkeys(run["scene"] for run in runs))
    names = [Path(run["folder"]).name for run in runs]  # of methods, with their seeds
    pairs = [SimpleNamespace(scene=run["scene"], method=name) for run, name in zip(runs, names)]
    priors = {SETTINGS.scenes[scene].prior for scene in scenes}
    priors |= {SETTINGS.method_prior(pair.scene, pair.method) for pair in pairs}
    makers = {"made": "render", "supplied": "supplied", "packed": "unpack"}
    jobs = [("kernels", {"group": group}) for group in ("geometry", "simulation", "laws", "rendering")]
    jobs += [("prior", {"prior": prior}) for prior in sorted(priors & set(SETTINGS.priors.laws))]
    for scene in scenes:
        truth = "ground_truth" if origin_of("truth", scene) == "made" else "unpack_truth"
        images = [f"{makers[origin_of(part, scene)]}_{part}" for part in ("static", "dynamic")]
        stages = [truth, *images, "gaussians", "mesh", "sampled_particles", "binding", "velocity"]
        jobs += [(name, {"scene": scene}) for name in stages]
    trained = [(pair.scene, SETTINGS.method_training(pair.method)) for pair in pairs if trained_adaptor(pair)]
    jobs += [("material", {"scene": scene, "method": method}) for scene, method in dict.fromkeys(trained)]
    jobs += [("evaluation", vars(pair)) for pair in pairs] + [("chamfer_table", {"table": table})]
    return [getattr(rules, name).benchmark.format(**wildcards) for name, wildcards in jobs]


def table_cells(table):
    """Method and column of every run behind a table, in the order of `table_runs`."""
    return [[run["method"], run["column"]] for run in table_runs(table)]


def learning_rate_cells(table):
    """Method, learning-rate factor and scene of every run behind a table, in the order of `table_runs`."""
    return [
        {
            "method": run["method"].partition("+")[0],
            "lr_scale": SETTINGS.method_material(run["scene"], run["method"]).lr_scale,
            "scene": run["scene"],
        }
        for run in table_runs(table)
    ]


def table_titles(table):
    """Row names of a table by method."""
    chosen = SETTINGS.tables[table]
    return {method: chosen.titles.get(method) or SETTINGS.method_title(method) for method in chosen.methods}


def table_notes(table):
    """What readers must know of the rows of a table, by method."""
    notes = {method: SETTINGS.method_note(method) for method in SETTINGS.tables[table].methods}
    return {method: note for method, note in notes.items() if note}


def table_columns(table):
    """Headings of a table by scene and experiment."""
    chosen = SETTINGS.tables[table]
    return {s: s for s in chosen.scenes} | {n: SETTINGS.experiments[n].title for n in chosen.experiments}


@checked
def material_settings(wildcards):
    return SETTINGS.method_material(wildcards.scene, wildcards.method).plain()


@checked
def material_prior(wildcards):
    return prior_file(SETTINGS.method_prior(wildcards.scene, wildcards.method))


def supervised_by(kind, file):
    """A function of wildcards: a file of the scene's data, where the method is supervised by what is in it."""

    @checked
    def choose(wildcards):
        material = SETTINGS.method_material(wildcards.scene, wildcards.method)
        return f"{DATA}/{wildcards.scene}/{file}" if material.supervision == kind else []

    return choose


training_video = supervised_by("pixels", "dynamic/transforms.json")
training_particles = supervised_by("particles", "particles.h5")  # ground truth, in one ablation


@checked
def trained_adaptor(wildcards):
    """The adaptor, where there is one: of the method itself, or of the one whose law it takes."""
    if not SETTINGS.method_material(wildcards.scene, wildcards.method).train:
        return []
    method = SETTINGS.method_training(wildcards.method)
    return f"{RESULTS}/{wildcards.scene}/{method}/adaptor.safetensors"


@checked
def judged_carrier(wildcards):
    return SETTINGS.judged_carrier(wildcards.scene, wildcards.method)


@checked
def method_density(wildcards):
    return SETTINGS.method_density(wildcards.scene, wildcards.method)


@checked
def evaluation_views(wildcards):
    """Views that image metrics are taken in: those that are asked for, or those that training does not see."""
    seen = SETTINGS.method_material(wildcards.scene, wildcards.method).views
    unseen = [view for view in range(SETTINGS.dataset.dynamic.views) if view not in seen]
    return list(SETTINGS.evaluation.views or unseen or seen)


def scene_bodies(wildcards):
    """What the ground truth of a scene simulates."""
    keys = ("shape", "size", "height", "center", "velocity", "density", "law")
    return [scene_setting(*keys)(wildcards)]


def experiment_bodies(*keys):
    """A function of wildcards: the named settings of an experiment's bodies."""

    @checked
    def choose(wildcards):
        return [{key: body[key] for key in keys} for body in SETTINGS.experiment_bodies(wildcards.experiment)]

    return choose


def experiment_frames(wildcards):
    return list(SETTINGS.dataset.frame_steps(SETTINGS.experiment(wildcards.experiment).steps))


def experiment_simulation(wildcards):
    """Constants of the simulator for an experiment."""
    return simulator(SETTINGS.experiment_dt(wildcards.experiment))


def reconstructed_files(name):
    """A function of wildcards: a file of the scene of each body that is the scene's own object."""

    @checked
    def choose(wildcards):
        bodies = SETTINGS.experiment_bodies(wildcards.experiment)
        return [f"{RESULTS}/{body['scene']}/{name}" for body in bodies if body["reconstructed"]]

    return choose


def of_each_body(function):
    """A function of wildcards of scene and method, applied to the scene of each body of an experiment."""

    @checked
    def choose(wildcards):
        bodies = SETTINGS.experiment(wildcards.experiment).bodies
        found = [function(SimpleNamespace(scene=body.scene, method=wildcards.method)) for body in bodies]
        return [value for value in found if value != []]

    return choose
