"""Methods of jobs: their cases on scenes, files and parameters; the rules that fit them. Needs scenes.smk."""

from dataclasses import replace
from functools import cache

from neuma_lib.project.cases import LAW_FROM
from neuma_lib.project.paths import IDENTIFIED
from neuma_lib.config.variants import parse_replicate, replicate_folder
from neuma_lib.project.find import scene_files


@cache
def case_on(scene, method, **how):
    return cases.case(SETTINGS, scene, method, **how)


def of_case(choose):
    """A function of wildcards: something of their case, a method on a scene."""
    return checked(lambda wildcards: choose(case_on(wildcards.scene, wildcards.method)))


def of_fit(choose):
    """The same for a fit, which may be that of several bodies."""
    return checked(lambda wildcards: choose(case_on(wildcards.scene, wildcards.method, fit=True)))


def of_bodies(choose):
    """A function of wildcards: something of the method's cases for the bodies of a scene or experiment."""
    return checked(lambda wildcards: choose(cases.body_cases(SETTINGS, subject(wildcards), wildcards.method)))


def presets_of(method):
    """Pattern of the presets of a method, and of their variants. Those without a fit are refused by `fit_files`."""
    return names_of(name for name in SETTINGS.methods if cases.kind_of(SETTINGS, name).name == method.name)


# ---- fits


def fit_files(case):
    """Everything that a fit may read."""
    if case.folder != case.name:
        raise InputError(
            f"{case.moved}/{case.folder}",
            f"it has no fit, its model is that of {case.scene}/{case.name}",
            "Request the file of that folder",
        )
    return case.method.fit_inputs(case)


def fit_parameter(case):
    return {
        "module": type(case.method).__module__,
        "files": sorted(case.method.fit_inputs(case)),
        "options": case.method.fit_options(case),
    }


for fitted in (method for method in KINDS.values() if method.product):

    rule:
        name:
            f"fit_{fitted.name}"
        input:
            unpack(of_fit(fit_files)),
            kernels=kernels(*fitted.fit_kernels),
            obstacles=obstacle_meshes,
        output:
            product=f"{RESULTS}/{{scene}}/{{method}}/{fitted.product}",
            history=f"{RESULTS}/{{scene}}/{{method}}/history.json",
        wildcard_constraints:
            method=presets_of(fitted),
        resources:
            gpu=GPU,
            mem_mb=6000,
            runtime=240,
        params:
            method=of_fit(fit_parameter),
            simulation=simulation_settings,
            densities=of_fit(lambda case: case.densities),
            exposure=exposure,
            seed=SETTINGS.seed,
            checkpoint=f"{RESULTS}/{{scene}}/{{method}}/checkpoint.pt",
            device=SETTINGS.device,
            code=code_of("fit.py"),
        script:
            "../scripts/fit.py"


# ---- predictions


def model_files(bodies):
    """Files of the models of all bodies, by name: a list with one path a body."""
    each = [{**case.method.model_inputs(case), **case.method.body_inputs(case)} for case in bodies]
    return {name: [files[name] for files in each] for name in each[0]}


def model_parameter(bodies):
    """Method, files and options of the models, as `workflow.motion.Prediction` takes them."""
    return {
        "module": type(bodies[0].method).__module__,
        "files": sorted(model_files(bodies)),
        "options": [case.method.model_options(case) for case in bodies],
    }


def body_parameter(case):
    """The same of a job that renders a motion, and loads no model."""
    return model_parameter([case]) | {"files": sorted(case.method.body_inputs(case))}


def law_files(bodies):
    """Files of the law of one body."""
    (case,) = bodies
    if not case.method.has_law:
        raise InputError(
            f"{case.moved}/{case.name}", "its motion follows from no material law", "Choose another method"
        )
    return model_files(bodies)


def uncertainty_files(bodies):
    """Files of the law of one body, and of its uncertainty."""
    return law_files(bodies) | bodies[0].method.uncertainty_inputs(bodies[0])


def model_kernels(bodies):
    """Kernels of a prediction."""
    return kernels(*bodies[0].method.kernels, *own_kernels(bodies[0]))


def body_kernels(case):
    """Kernels of a rendering."""
    return kernels("rendering", *own_kernels(case))


def own_kernels(case):
    return case.method.body_kernels if case.method.body_inputs(case) else ()


def carries_total(bodies):
    """Whether the options of at least one body ask for the total deformation."""
    return any(case.options.covariance_from == "total" for case in bodies)


def particle_source(bodies):
    return bodies[0].method.particle_source(bodies[0])


def shared_particle_source(bodies):
    """The same where there are no particles of a fit: experiments, splats and captures."""
    case = bodies[0]
    if case.method.body_inputs(case):
        raise InputError(
            f"{case.moved}/{case.name}",
            "it is evaluated on the particles of its fit, which only scenes with rendered videos have",
            f"Choose {case.name}, which has the same fit and is evaluated on the particles that all methods share",
        )
    return particle_source(bodies)


def evaluated_particle_source(wildcards):
    return of_bodies(shared_particle_source if of_experiment(wildcards) else particle_source)(wildcards)


@checked
def evaluated_start(wildcards):
    """File of the initial motion: of the method on a scene, or of an experiment."""
    if of_experiment(wildcards):
        return result_path(subject(wildcards), "velocity.json")
    if SETTINGS.scene(wildcards.scene).bodies:
        body, *_ = cases.body_cases(SETTINGS, wildcards.scene, wildcards.method)
        fitted = body.options.start == "identified"
        return result_path(wildcards.scene, "identified.json" if fitted else "velocity.json")
    case = case_on(wildcards.scene, wildcards.method)
    return case.method.start_file(case)


@checked
def splat_start(wildcards):
    """File of the initial motion of a splat. Its law is that of another scene, as it has no video."""
    scene, method = wildcards.scene, wildcards.method
    case = case_on(scene, method)
    case.method.model_options(case)  # refuses a true law, which a splat does not have
    if case.learned_from_moved_scene:
        raise InputError(
            f"{scene}/{method}",
            "a splat has no video to learn a law from",
            f"Use the law of another scene, {method}+{LAW_FROM}=<scene>, or the prior alone, nclaw",
        )
    return of_replicate("velocity.json")(wildcards)


def splat_clock(choose):
    """A function of wildcards: something of the time step [s] and the frames of a splat's motion."""
    return checked(lambda wildcards: choose(*cases.motion_clock(SETTINGS, wildcards.scene, wildcards.method)))


@checked
def gaussian_motion(wildcards):
    """How Gaussians follow their particles in a scene, or as in the first one of an experiment."""
    return cases.gaussian_motion(SETTINGS, SETTINGS.body_scenes(subject(wildcards))[0], wildcards.method)


def prior_replicate(wildcards):
    """Name of a prior, and the seeds of its replicate."""
    return parse_replicate(wildcards.prior, SETTINGS.priors.laws, "prior")


@checked
def published_law(wildcards):
    """The analytic law that a scene's prior is trained on. None if the prior is a file of the user."""
    return cases.published_law(SETTINGS, SETTINGS.scene(wildcards.scene).prior)


@checked
def identify_settings(wildcards):
    """Settings of an identification, in the views that its file names, if any."""
    views = getattr(wildcards, "views", None)
    return SETTINGS.identify_of(wildcards.scene).plain() | (
        {"views": [int(view) for view in views.split(",")]} if views else {}
    )


@checked
def film_titles(wildcards):
    """Names of the methods of a film."""
    demo = SETTINGS.demo
    return [demo.titles.get(method) or cases.title(SETTINGS, method) for method in demo.methods]


SLOW = "|_slow([2-9]|1[0-6])"
"""Suffix of films in slow motion, for example `film_slow4.mp4` at a quarter of the speed."""


def film_rate(wildcards):
    """Frames per second of a film."""
    rate, slower = SETTINGS.evaluation.frame_rate, wildcards.slow.removeprefix("_slow")
    return rate / int(slower) if slower else rate


@checked
def film_motions(wildcards):
    """How Gaussians follow their particles in each method of a film."""
    return [cases.gaussian_motion(SETTINGS, wildcards.scene, method) for method in SETTINGS.demo.methods]


def evaluation_views(case):
    """Views of image metrics: those of the settings, or those that training does not see.

    If training sees all views, those in which other methods are measured, or all. Image metrics and figures then state
    this.
    """
    seen = case.options.views
    views = range(SETTINGS.dataset.dynamic.views)
    unseen, others = (
        [view for view in views if view not in used] for used in (seen, SETTINGS.training.views)
    )
    return list(SETTINGS.evaluation.views or unseen or others or seen)


def own_result(file):
    """A function of wildcards: a file of the same run. None if it is of another scene, or there is no truth."""

    def choose(wildcards):
        case = case_on(wildcards.scene, wildcards.method)
        without = case.scene != case.moved or SETTINGS.scene(case.scene).captured
        return [] if without else f"{RESULTS}/{wildcards.scene}/{wildcards.method}/{file}"

    return checked(choose)


@checked
def viewer_files(wildcards):
    """Files and settings of a scene for the viewer in a file."""
    methods = cases.moving_methods(SETTINGS, wildcards.scene, SETTINGS.viewer.methods)
    files = scene_files(SETTINGS, wildcards.scene, methods)
    return files if SETTINGS.scene(wildcards.scene).bodies else replace(files, velocity=None)


def identify_threads(wildcards):
    """All cores for one identification, an equal share of them for several, at least one. Fits that can run at the same
    time have one core each.

    Jobs side by side use cores better than threads, which wait for each other after each batch of rollouts. A GPU and
    the jobs of a cluster need one core.
    """
    if GPU or not (workflow.is_main_process and workflow.local_exec):
        return 1
    rules = ("identify", "identify_views", "identify_bodies", "next")
    jobs = list(workflow.dag.needrun_jobs())
    fits = [job for job in jobs if job.rule.name.startswith("fit_")]
    others = sum(not any(Path(file).name.startswith("identified") for file in job.input) for job in fits)
    return max(1, (workflow.cores - others) // max(1, sum(job.rule.name in rules for job in jobs)))


@checked
def predicted_experiment(wildcards):
    """The experiment whose motion shall be predicted, in the replicate of the scene; None if there is none."""
    name = SETTINGS.next.predict
    if name is None:
        return None
    base, seeds = SETTINGS.replicate(subject(wildcards))
    if name not in SETTINGS.experiments or len(SETTINGS.experiments[name].bodies) != 1:
        problem = f"{name!r} is not an experiment with one body"
        raise InputError("next.predict", problem, "Give the name of one in `experiments`, or null")
    return f"experiments/{replicate_folder(name, seeds)}"


def of_predicted(function):
    """A function of wildcards, applied to the experiment to predict: nothing if there is none."""

    @checked
    def choose(wildcards):
        name = predicted_experiment(wildcards)
        return [] if name is None else function(SimpleNamespace(scene=name))

    return choose
