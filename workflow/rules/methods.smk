"""What methods start from, read and are told. Needs scenes.smk."""

from dataclasses import replace

from neuma_lib.config import places
from neuma_lib.config.methods import IDENTIFIED
from neuma_lib.config.variants import parse_chain
from neuma_lib.viewer.find import scene_files


def prior_file(scene, method=None):
    """The prior of a scene, or of a method there, in its chain: made here, or the user's own if it is a path."""
    return places.prior_file(SETTINGS, scene, method)


def prior_chain(wildcards):
    """Name of a prior, and the seeds of its chain."""
    return parse_chain(wildcards.prior, SETTINGS.priors.laws, "prior")


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


def without_law(method):
    """The error of a method with springs where a law is asked for."""
    return InputError(
        f"{method} has no law of a material, only springs in one body: it has no stress, and no experiment with several "
        "bodies"
    )


@checked
def material_prior(wildcards):
    """The networks that a method starts from; none where its law is analytic, or corrects an analytic one."""
    if SETTINGS.is_springs(wildcards.method):
        raise without_law(wildcards.method)
    kinds = (SETTINGS.is_identified, SETTINGS.is_structured, SETTINGS.is_pac_nerf)
    analytic = any(is_kind(wildcards.method) for is_kind in kinds)
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
    return places.identified_name(SETTINGS, scene, method)


def identified_file(wildcards):
    """The same of the scene that a method's law is from, in its chain."""
    scene, method = wildcards.scene, wildcards.method
    return home(SETTINGS.law_scene(scene, method), identified_name(scene, method))


@checked
def identify_settings(wildcards):
    """Settings of an identification, in the views that its file names, if any."""
    finer, own = SETTINGS.identify.particles, SETTINGS.simulation.particles
    if 0 < finer <= own:
        raise InputError(
            f"identify.particles: {finer} are not more than the {own} of the reconstruction (simulation.particles), whose "
            f"coarseness they are to tell; give {4 * own}, or 0 to ignore it"
        )
    views = getattr(wildcards, "views", None)
    return SETTINGS.identify.plain() | ({"views": [int(view) for view in views.split(",")]} if views else {})


def pac_nerf_file(scene, method):
    """The law, and the throw, that PAC-NeRF found in a scene's video."""
    return places.pac_nerf_file(SETTINGS, scene, method)


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
def springs_settings(wildcards):
    """Settings of a method with springs in place of a law."""
    return SETTINGS.method_springs(wildcards.method).plain()


def scene_views(wildcards):
    """Numbers of the cameras of a filmed throw."""
    return list(range(len(SETTINGS.scene(wildcards.scene).captured.cameras)))


@checked
def fitted_springs(wildcards):
    """The springs of a scene, or of the scene of an experiment's one body."""
    scenes = SETTINGS.body_scenes(subject(wildcards))
    if len(scenes) > 1:
        raise without_law(wildcards.method)
    return f"{RESULTS}/{SETTINGS.run_folder(scenes[0], wildcards.method)}/springs.safetensors"


@checked
def pac_nerf_settings(wildcards):
    """Settings of a method with PAC-NeRF's law."""
    return SETTINGS.method_pac_nerf(wildcards.method).plain()


@checked
def pac_nerf_prior(wildcards):
    """The analytic law of the prior that decides the family of a method with PAC-NeRF's law; none if it is a file."""
    law = SETTINGS.priors.laws.get(SETTINGS.method_prior(wildcards.scene, wildcards.method))
    return law.plain() if law else None


@checked
def true_law(wildcards):
    """The scene's own law, where this is what a method evaluates."""
    return SETTINGS.true_law(wildcards.scene, wildcards.method) or []


@checked
def identified_law(wildcards):
    """The law that was identified in a scene's video, by us or by PAC-NeRF, where this is what a method evaluates."""
    if SETTINGS.is_pac_nerf(wildcards.method):
        return pac_nerf_file(SETTINGS.law_scene(wildcards.scene, wildcards.method), wildcards.method)
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
def experiment_carrier(wildcards):
    """The same in an experiment, or of a splat: no radiance field is fitted to their bodies."""
    if SETTINGS.carries_field(wildcards.method):
        kind = "experiments" if hasattr(wildcards, "experiment") else "splats"
        raise InputError(
            f"{wildcards.method}: its own particles are those of a field, and {kind} have none; take "
            f"{SETTINGS.method_training(wildcards.method)}, the same law on the particles that all methods share"
        )
    return SETTINGS.judged_carrier(SETTINGS.body_scenes(subject(wildcards))[0], wildcards.method)


def carrying(method):
    """How PAC-NeRF's field is carried by a method's particles, to `CarriedField.load`."""
    field = {name: SETTINGS.radiance.plain()[name] for name in ("spacing", "least_opacity")}
    return {**field, "settings": SETTINGS.method_pac_nerf(method).plain()}


@checked
def own_carrying(wildcards):
    """The same of a method that is judged on PAC-NeRF's own particles; None of others."""
    return carrying(wildcards.method) if SETTINGS.carries_field(wildcards.method) else None


@checked
def own_field(wildcards):
    """The field that a method's own particles carry; none where it is judged on others."""
    return home(wildcards.scene, FIELD) if SETTINGS.carries_field(wildcards.method) else []


def kernels_and_field(*groups):
    """A function of wildcards: groups of kernels, and those of the radiance field where a method's particles carry it."""
    return lambda wildcards: kernels(*groups, *(["radiance"] if own_field(wildcards) else []))


def start_of(scene, method):
    """The file of a scene's chain that tells a method how bodies are thrown."""
    identified = SETTINGS.method_material(scene, method).start == "identified"
    return identified_name(scene, method) if identified else "velocity.json"


@checked
def start_name(wildcards):
    return start_of(wildcards.scene, wildcards.method)


def start_file(wildcards):
    if SETTINGS.is_pac_nerf(wildcards.method):
        return pac_nerf_file(wildcards.scene, wildcards.method)
    return of_chain(start_name(wildcards))(wildcards)


def start_files(wildcards):
    """The same of each video."""
    return of_each_video(of_chain(start_name(wildcards)))(wildcards)


@checked
def gaussian_motion(wildcards):
    return SETTINGS.gaussian_motion(wildcards.scene, wildcards.method)


@checked
def film_titles(wildcards):
    """Names of the methods of a film."""
    demo = SETTINGS.demo
    return [demo.titles.get(method) or SETTINGS.method_title(method) for method in demo.methods]


@checked
def film_motions(wildcards):
    """The same of each method of a film."""
    of_methods = (SETTINGS.method_material(wildcards.scene, method) for method in SETTINGS.demo.methods)
    return [material.gaussian_motion for material in of_methods]


@checked
def method_density(wildcards):
    return SETTINGS.method_density(wildcards.scene, wildcards.method)


@checked
def training_densities(wildcards):
    """The same as a method takes them to be."""
    own = video_densities(wildcards)
    assumed = SETTINGS.method_material(wildcards.scene, wildcards.method).assumed_density
    return own if assumed is None else [assumed] * len(own)


@checked
def evaluation_views(wildcards):
    """Views that image metrics are taken in: those that are asked for, or those that training does not see.

    Where training sees all views, those that other methods are measured in, or all: image metrics and figures then say
    so.
    """
    seen = SETTINGS.method_material(wildcards.scene, wildcards.method).views
    views = range(SETTINGS.dataset.dynamic.views)
    unseen, others = (
        [view for view in views if view not in used] for used in (seen, SETTINGS.material.views)
    )
    return list(SETTINGS.evaluation.views or unseen or others or seen)


def own_result(file):
    """A function of wildcards: a file of the same run; none where it would be another scene's, or there is no truth."""

    @checked
    def choose(wildcards):
        scene = SETTINGS.law_scene(wildcards.scene, wildcards.method)
        without = scene != wildcards.scene or SETTINGS.scene(scene).captured
        return [] if without else f"{RESULTS}/{wildcards.scene}/{wildcards.method}/{file}"

    return choose


@checked
def viewer_files(wildcards):
    """What the viewer in a file shows of a scene."""
    methods = SETTINGS.moved_methods(wildcards.scene, SETTINGS.viewer.methods)
    return replace(scene_files(SETTINGS, wildcards.scene, methods), velocity=None)
