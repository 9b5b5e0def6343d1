"""Reads and checks the settings, and says what every rule shares. Nothing is computed here."""

import os
import re
import shutil
import sys
from pathlib import Path
from types import SimpleNamespace

ROOT = Path(workflow.basedir).resolve()
sys.path.insert(0, str(ROOT))

from neuma_lib.config.methods import IDENTIFIED
from neuma_lib.config.settings import load
from neuma_lib.config.variants import folder, parse_chain
from neuma_lib.errors import InputError
from workflow.defaults import complete
from workflow.provenance import code_digest

try:
    SETTINGS = load(config)
except InputError as error:
    raise WorkflowError(str(error)) from None

DATA = SETTINGS.data_root.rstrip("/")
RESULTS = SETTINGS.results_root.rstrip("/")
KERNELS = f"{DATA}/kernels"  # what is known of them; they themselves are in SETTINGS.kernel_cache
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


# Tables of distances; the others have rules of their own.
OTHER_TABLES = ("table4", "learning_rates", "bias", "stress")
CHAMFER_TABLES = [name for name in SETTINGS.tables if name not in OTHER_TABLES]


wildcard_constraints:
    scene=f"({'|'.join(SETTINGS.scenes) or 'none'})([+][^/]*)?",
    prior=f"({'|'.join(SETTINGS.priors.laws) or 'none'})([+]seed=[1-9][0-9]*)?",
    method=f"({'|'.join(SETTINGS.methods) or 'none'})([+][^/]*)?",
    experiment=f"({'|'.join(SETTINGS.experiments) or 'none'})([+][^/]*)?",
    table="|".join(CHAMFER_TABLES) or "none",
    group="geometry|simulation|laws|rendering",
    views="[0-9]+(,[0-9]+)*",


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


# What a chain's seeds change in a file of a scene or an experiment (config/variants.py); runs of methods have
# `Config.run_folder`.
DRAWN_IN = {
    **dict.fromkeys(["gaussians.ply", "gaussians.json", "mesh.ply", "tracers.h5"], ["gaussians"]),
    **dict.fromkeys(["sampled_particles.h5", "particles.h5", "binding.h5"], ["gaussians", "particles"]),
    **dict.fromkeys(
        ["velocity.json", "identified.json", "priors/identified.safetensors", "visited.h5"],
        ["prior", "gaussians", "particles"],
    ),
}


def home(name, file):
    """The one path of a file of a scene or experiment in a chain."""
    base, seeds = SETTINGS.chain(name)
    if base in SETTINGS.scenes:
        drawn = DRAWN_IN[re.sub("[+]views=[0-9,]+", "", file)]
        return f"{RESULTS}/{folder(base, seeds, drawn)}/{file}"
    # Solids are filled with particles; where a scene's own object is among them, all that led to its start counts.
    rebuilt = any(body.shape is None for body in SETTINGS.experiments[base].bodies)
    drawn = DRAWN_IN["velocity.json"] if rebuilt else ["particles"]
    return f"{RESULTS}/experiments/{folder(base, seeds, drawn)}/{file}"


def of_chain(file):
    """A function of wildcards: a file of the scene or experiment in its chain."""
    return checked(lambda wildcards: home(subject(wildcards), file))


def of_scene(file):
    """A function of wildcards: a file of the scene's or experiment's data, which all its chains share."""

    @checked
    def choose(wildcards):
        base, _ = SETTINGS.chain(subject(wildcards))
        return f"{DATA}/{base if base in SETTINGS.scenes else f'experiments/{base}'}/{file}"

    return choose


def seed_of(drawn):
    """A function of wildcards: the seed of what a scene or experiment draws in its chain."""
    return checked(lambda wildcards: SETTINGS.seed + SETTINGS.chain(subject(wildcards))[1][drawn])


def subject(wildcards):
    """The scene or experiment, with the seeds of its chain, that a job is about."""
    return getattr(wildcards, "scene", None) or wildcards.experiment


# The rules that reconstruct a scene and prepare its evaluation, and a file of each.
MAKERS = {
    "gaussians": "gaussians.ply",
    "mesh": "mesh.ply",
    "sampled_particles": "sampled_particles.h5",
    "binding": "binding.h5",
    "velocity": "velocity.json",
    "tracers": "tracers.h5",
}
# Files of a reconstructed body: the particles that are simulated, the Gaussians, and what binds them.
BODY = {"particles": "particles.h5", "binding": "binding.h5", "gaussians": "gaussians.ply"}


def body_files():
    """Functions of wildcards: the files of the body of a scene or experiment, by name."""
    return {name: of_chain(file) for name, file in BODY.items()}


def of_each_video(function):
    """A function of wildcards of a scene, applied to the scenes of all its videos: a list where there are several."""

    @checked
    def choose(wildcards):
        found = [function(SimpleNamespace(scene=scene)) for scene in SETTINGS.video_scenes(wildcards.scene)]
        return found if len(found) > 1 else found[0]

    return choose


def each_of(bodies):
    """Files by name of the bodies of several scenes or experiments."""
    return {name: [home(body, file) for body in bodies] for name, file in BODY.items()}


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
    bytes_a_frame = 96 * truth_settings(wildcards).particles + 24 * SETTINGS.dataset.tracers
    return 2000 + 2 * len(SETTINGS.frame_steps(wildcards.scene)) * bytes_a_frame // 10**6


def frame_steps(wildcards):
    return list(SETTINGS.frame_steps(wildcards.scene))


def simulation_settings(wildcards):
    """Constants of the simulator for a scene."""
    return simulator(SETTINGS.scene(wildcards.scene).dt)


def simulator(dt, grid=None):
    """Constants of the simulator with a time step [s], on the reconstruction's grid unless another is given."""
    section = SETTINGS.simulation.plain() | ({"grid": grid} if grid else {})
    return {"dt": dt, **{name: section[name] for name in ("grid", "gravity", "boundary", "walls")}}


@checked
def truth_settings(wildcards):
    """How finely the ground truth of a scene or experiment is simulated."""
    if hasattr(wildcards, "scene"):
        return SETTINGS.scene_truth(wildcards.scene)
    return SETTINGS.experiment_truth(wildcards.experiment)


def truth_simulation(wildcards):
    """Constants of the simulator for the ground truth of a scene or experiment."""
    truth = truth_settings(wildcards)
    return simulator(truth.dt, truth.grid)


def truth_particles(wildcards):
    return truth_settings(wildcards).particles


def prior_file(scene, method=None):
    """The prior of a scene, or of a method there, in its chain: made here, or the user's own if it is a path."""
    name = SETTINGS.method_prior(scene, method) if method else SETTINGS.scene(scene).prior
    if name == IDENTIFIED:
        return home(scene, "priors/identified.safetensors")
    if name not in SETTINGS.priors.laws:
        return name
    return f"{RESULTS}/priors/{folder(name, SETTINGS.chain(scene)[1], ['prior'])}.safetensors"


def random_scenes():
    """What tables of random scenes say of each."""
    plain = {name: SETTINGS.scene(name) for name in SETTINGS.random_scenes}
    return {
        name: {"shape": scene.shape, "family": SETTINGS.random.family(name), "prior": scene.prior}
        for name, scene in plain.items()
    }


def random_files(methods, name):
    """A file of every random scene under some methods, method by method."""
    return [f"{RESULTS}/{scene}/{method}/{name}" for method in methods for scene in SETTINGS.random_scenes]


def identified_scenes():
    """Every identification that a table judges: the scenes of table1 in all its chains, and the random scenes."""
    table, methods = SETTINGS.tables.get("table1"), SETTINGS.methods
    constants = [name for name in methods if SETTINGS.is_identified(name)][:1]
    runs = [
        run
        for s in (table.scenes if table else ())
        for m in constants
        for run in SETTINGS.runs("table1", m, s)
    ]
    named = dict.fromkeys((Path(run).parent.name for run in runs), "scenes of Table 1")
    named |= dict.fromkeys(SETTINGS.random_scenes, f"random scenes, seed {SETTINGS.random.seed}")
    return [
        {"name": name, "group": group, "truth": SETTINGS.scene(name).law.plain()}
        for name, group in named.items()
    ]


def prior_chain(wildcards):
    """Name of a prior, and the seeds of its chain."""
    return parse_chain(wildcards.prior, SETTINGS.priors.laws, "prior")


def table_runs(table):
    """Every run behind a table, row by row and chain by chain: its method, column, folder of the scene, and folder."""
    chosen = SETTINGS.tables[table]
    return [
        {
            "method": method,
            "column": column,
            "scene": run.partition("/")[0] if column in chosen.scenes else None,
            "folder": f"{RESULTS}/{run}" if column in chosen.scenes else f"{RESULTS}/experiments/{run}",
        }
        for method in chosen.methods
        for column in (*chosen.scenes, *chosen.experiments)
        for run in SETTINGS.runs(table, method, column)
    ]


def table_files(table, name):
    """A file of every run behind a table, in the order of `table_runs`."""
    return [f"{run['folder']}/{name}" for run in table_runs(table)]


def table_records(table):
    """Benchmark file and log of each job behind the scenes of a table, in all chains."""
    pairs = [SimpleNamespace(**run) for run in table_runs(table) if run["scene"]]
    makers = {"made": "render", "supplied": "supplied", "packed": "unpack"}
    jobs = [("kernels", {"group": group}) for group in ("geometry", "simulation", "laws", "rendering")]
    priors, laws, videos = [], [], []
    for pair in pairs:
        scene = SETTINGS.law_scene(pair.scene, pair.method)
        own = Path(home(scene, "identified.json"))
        networks = material_prior(pair) == f"{own.parent}/priors/identified.safetensors"
        identified = identified_law(pair) or identified_base(pair) or (networks and own)
        trained = trained_adaptor(pair)
        laws += [("identified_prior", {"scene": own.parent.name})] if networks else []
        laws += [identification(identified)] if identified else []
        method = SETTINGS.method_training(pair.method)
        laws += [("material", {"scene": scene, "method": method})] if trained else []
        priors += [prior_file(pair.scene), material_prior(pair)]
        videos += SETTINGS.video_scenes(scene) if identified or trained else []
    judged = [pair.scene for pair in pairs]
    priors += [prior_file(video) for video in videos]
    files = [Path(file) for file in priors if file]
    jobs += [("prior", {"prior": file.stem}) for file in files if file.parent == Path(RESULTS, "priors")]
    for run in dict.fromkeys([*judged, *videos]):
        scene, _ = SETTINGS.chain(run)
        origins = {part: origin_of(part, scene) for part in ("static", "dynamic")}
        if run in judged or "made" in origins.values():
            truth = "ground_truth" if origin_of("truth", scene) == "made" else "unpack_truth"
            jobs += [(truth, {"scene": scene})]
        jobs += [(f"{makers[origin]}_{part}", {"scene": scene}) for part, origin in origins.items()]
        makes = {rule: file for rule, file in MAKERS.items() if run in judged or rule != "tracers"}
        jobs += [(rule, {"scene": Path(home(run, file)).parent.name}) for rule, file in makes.items()]
    jobs += laws
    jobs += [("evaluation", vars(pair)) for pair in pairs]
    jobs += [("chamfer_table", {"table": table})]
    made = [(getattr(rules, name), wildcards) for name, wildcards in jobs]
    files = [(rule.benchmark, str(rule.log[0]), wildcards) for rule, wildcards in made]
    return list(dict.fromkeys(tuple(file.format(**w) for file in pair) for *pair, w in files))


def table_cells(table):
    """Method and column of every run behind a table, in the order of `table_runs`."""
    return [[run["method"], run["column"]] for run in table_runs(table)]


def bias_cells(table):
    """Scene, as its chain is called, and method of every run behind a table, in the order of `table_runs`."""
    return [{"scene": run["scene"], "method": run["method"]} for run in table_runs(table)]


def learning_rate_cells(table):
    """Method, learning-rate factor and scene of every run behind a table, in the order of `table_runs`."""
    return [
        {
            "method": run["method"].partition("+")[0],
            "lr_scale": SETTINGS.method_material(run["scene"], run["method"]).lr_scale,
            "scene": run["column"],
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


def stretches_by_total(scene, method):
    """Whether the total deformation stretches the Gaussians in a method on a scene."""
    return SETTINGS.method_material(scene, method).covariance_from == "total"


@checked
def carries_total(wildcards):
    """Whether a prediction carries the total deformation: the method asks for it, for one of the bodies at least."""
    scenes = SETTINGS.body_scenes(subject(wildcards))
    return any(stretches_by_total(scene, wildcards.method) for scene in scenes)


@checked
def training_settings(wildcards):
    """The same of a method that trains a law of its own."""
    scene, method = wildcards.scene, wildcards.method
    trained = SETTINGS.law_scene(scene, method), SETTINGS.method_training(method)
    if trained != (scene, method):
        raise InputError(
            f"{scene}/{method} trains nothing: its law is that of {'/'.join(trained)}, ask for that one"
        )
    return material_settings(wildcards)


@checked
def material_prior(wildcards):
    """The networks that a method starts from; none where its law is analytic, or corrects an analytic one."""
    analytic = SETTINGS.is_identified(wildcards.method) or SETTINGS.is_structured(wildcards.method)
    if analytic or SETTINGS.true_law(wildcards.scene, wildcards.method):
        return []
    return prior_file(SETTINGS.law_scene(wildcards.scene, wildcards.method), wildcards.method)


@checked
def stock_base(wildcards):
    """The analytic law that a structured method corrects, where it is that of a prior."""
    if not SETTINGS.is_structured(wildcards.method):
        return None
    return SETTINGS.method_base(wildcards.scene, wildcards.method)


def identified_name(scene, method):
    """The file of what was identified for a method: in the views of its training, if these are its own."""
    views = SETTINGS.identified_views(scene, method)
    return f"identified+views={','.join(map(str, views))}.json" if views else "identified.json"


def identified_file(wildcards):
    """The same of the scene that a method's law is from, in its chain."""
    scene, method = wildcards.scene, wildcards.method
    return home(SETTINGS.law_scene(scene, method), identified_name(scene, method))


def identification(file):
    """The job that makes such a file: its rule and its wildcards."""
    scene, views = Path(file).parent.name, Path(file).stem.partition("views=")[2]
    return ("identify_views", {"scene": scene, "views": views}) if views else ("identify", {"scene": scene})


def identify_settings(wildcards):
    """Settings of an identification, in the views that its file names, if any."""
    views = getattr(wildcards, "views", None)
    return SETTINGS.identify.plain() | ({"views": [int(view) for view in views.split(",")]} if views else {})


@checked
def identified_base(wildcards):
    """The law that was identified in a scene's video, where this is what a structured method corrects."""
    if not SETTINGS.is_structured(wildcards.method) or stock_base(wildcards):
        return []
    return identified_file(wildcards)


@checked
def structured_settings(wildcards):
    """Settings of a method's structured law; none where it has another."""
    section = SETTINGS.method_structured(wildcards.method)
    return section.plain() if section else None


@checked
def true_law(wildcards):
    """The scene's own law, where this is what a method evaluates."""
    return SETTINGS.true_law(wildcards.scene, wildcards.method) or []


@checked
def identified_law(wildcards):
    """The law that was identified in a scene's video, where this is what a method evaluates."""
    if not SETTINGS.is_identified(wildcards.method):
        return []
    return identified_file(wildcards)


@checked
def stock_law(wildcards):
    """The analytic law that a scene's prior is trained on; none where the prior is a file of the user's."""
    law = SETTINGS.priors.laws.get(SETTINGS.scene(wildcards.scene).prior)
    return law.plain() if law else None


def supervised_by(kind, file):
    """A function of wildcards: a file of each video's data, where the method is supervised by what is in it."""

    @checked
    def choose(wildcards):
        material = SETTINGS.method_material(wildcards.scene, wildcards.method)
        return of_each_video(of_scene(file))(wildcards) if material.supervision == kind else []

    return choose


training_video = supervised_by("pixels", "dynamic/transforms.json")
training_particles = supervised_by("particles", "particles.h5")  # ground truth, in one ablation


@checked
def trained_adaptor(wildcards):
    """The adaptor, where there is one: of the method on the scene itself, or of those whose law it takes."""
    if not SETTINGS.method_material(wildcards.scene, wildcards.method).train:
        return []
    scene = SETTINGS.law_scene(wildcards.scene, wildcards.method)
    run = SETTINGS.run_folder(scene, SETTINGS.method_training(wildcards.method))
    return f"{RESULTS}/{run}/adaptor.safetensors"


@checked
def judged_carrier(wildcards):
    return SETTINGS.judged_carrier(wildcards.scene, wildcards.method)


@checked
def start_name(wildcards):
    """The file that tells a method how bodies are thrown."""
    identified = material_settings(wildcards)["start"] == "identified"
    return identified_name(wildcards.scene, wildcards.method) if identified else "velocity.json"


def start_file(wildcards):
    return of_chain(start_name(wildcards))(wildcards)


def start_files(wildcards):
    """The same of each video."""
    return of_each_video(of_chain(start_name(wildcards)))(wildcards)


@checked
def gaussian_motion(wildcards):
    return material_settings(wildcards)["gaussian_motion"]


@checked
def method_density(wildcards):
    return SETTINGS.method_density(wildcards.scene, wildcards.method)


@checked
def video_densities(wildcards):
    """Densities of the bodies of all videos of a scene."""
    return [SETTINGS.scene(scene).plain()["density"] for scene in SETTINGS.video_scenes(wildcards.scene)]


@checked
def training_densities(wildcards):
    """The same as a method takes them to be."""
    own = video_densities(wildcards)
    assumed = SETTINGS.method_material(wildcards.scene, wildcards.method).assumed_density
    return own if assumed is None else [assumed] * len(own)


@checked
def evaluation_views(wildcards):
    """Views that image metrics are taken in: those that are asked for, or those that training does not see.

    Where training sees all views, these: image metrics and figures then say so.
    """
    seen = SETTINGS.method_material(wildcards.scene, wildcards.method).views
    unseen = [view for view in range(SETTINGS.dataset.dynamic.views) if view not in seen]
    return list(SETTINGS.evaluation.views or unseen or seen)


def scene_bodies(wildcards):
    """What the ground truth of a scene simulates."""
    keys = ("shape", "size", "height", "center", "velocity", "spin", "density", "law")
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
        bodies = SETTINGS.experiment(wildcards.experiment).bodies
        scenes = SETTINGS.body_scenes(wildcards.experiment)
        return [home(scene, name) for body, scene in zip(bodies, scenes) if body.shape is None]

    return choose


def of_each_body(function):
    """A function of wildcards of scene and method, applied to the scene of each body of an experiment."""

    @checked
    def choose(wildcards):
        scenes = SETTINGS.body_scenes(wildcards.experiment)
        found = [function(SimpleNamespace(scene=scene, method=wildcards.method)) for scene in scenes]
        return [value for value in found if value != []]

    return choose
