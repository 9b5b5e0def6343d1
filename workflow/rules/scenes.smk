"""Files and settings of scenes and experiments, each in its replicate. Needs settings.smk."""

from types import SimpleNamespace

from neuma_lib.config.obstacles import is_mesh_file
from neuma_lib.config.variants import replicate_folder
from neuma_lib.io.files import listed
from neuma_lib.project import paths
from neuma_lib.project.settings import NO_TRUTH
from workflow.inputs import image_list


def result_path(name, file):
    """Path of a file of a scene or experiment in a replicate."""
    return paths.result_path(SETTINGS, name, file)


def of_replicate(file):
    """A function of wildcards: a file of the scene or experiment in its replicate."""
    return checked(lambda wildcards: result_path(subject(wildcards), file))


def of_data(file):
    """A function of wildcards: a file of the data of the scene or experiment, which all its replicates share."""

    @checked
    def choose(wildcards):
        base, _ = SETTINGS.replicate(subject(wildcards))
        return f"{DATA}/{base if base in SETTINGS.scenes else f'experiments/{base}'}/{file}"

    return choose


def seed_of(drawn):
    """A function of wildcards: the seed of a random choice of a scene or experiment in its replicate."""
    return checked(lambda wildcards: SETTINGS.seed + SETTINGS.replicate(subject(wildcards))[1][drawn])


def subject(wildcards):
    """Name of the scene or experiment of a job, with the seeds of its replicate."""
    return wildcards.scene.removeprefix("experiments/")


def of_experiment(wildcards):
    return wildcards.scene.startswith("experiments/")


def by_subject(scene, experiment):
    """A function of wildcards: one function of a scene or another of an experiment, applied to its name."""

    @checked
    def choose(wildcards):
        return (experiment if of_experiment(wildcards) else scene)(subject(wildcards))

    return choose


# Files of a reconstructed body: the particles that are simulated, the Gaussians, and what binds them.
BODY = {"particles": "particles.h5", "binding": "binding.h5", "gaussians": "gaussians.ply"}


def body_files():
    """Functions of wildcards: the files of the body of a scene or experiment, by name."""
    return {name: of_replicate(file) for name, file in BODY.items()}


def of_each_video(function):
    """A function of wildcards of a scene, applied to the scenes of all its videos: a list where there are several."""

    @checked
    def choose(wildcards):
        values = [function(SimpleNamespace(scene=scene)) for scene in SETTINGS.video_scenes(wildcards.scene)]
        return values if len(values) > 1 else values[0]

    return choose


def of_each_body(function):
    """A function of wildcards of a scene of several bodies, applied to the scene of each: a list."""

    @checked
    def choose(wildcards):
        return [function(SimpleNamespace(scene=scene)) for scene in SETTINGS.body_scenes(wildcards.scene)]

    return choose


def each_of(bodies):
    """Files by name of the bodies of several scenes or experiments."""
    return {name: [result_path(body, file) for body in bodies] for name, file in BODY.items()}


def of_pile(function):
    """A function of wildcards of the scene of one body, applied to the scene of all bodies, in its replicate."""

    @checked
    def choose(wildcards):
        base, seeds = SETTINGS.replicate(wildcards.scene)
        pile, _ = SETTINGS.scenes[base].part_of
        return function(SimpleNamespace(scene=replicate_folder(pile, seeds)))

    return choose


def of_section(choose):
    """A function of wildcards: something of the settings of their scene."""
    return checked(lambda wildcards: choose(SETTINGS.scene(wildcards.scene)))


def scene_setting(*names):
    """A function of wildcards: the named settings of the scene, as plain values."""

    @checked
    def choose(wildcards):
        section = SETTINGS.scene(wildcards.scene)
        scene = section.plain()
        if not section.has_truth and any(scene[name] is None for name in names):
            raise InputError(f"scenes.{wildcards.scene}", NO_TRUTH)
        return scene[names[0]] if len(names) == 1 else {name: scene[name] for name in names}

    return choose


def origin_of(part, scene):
    """Whether a part ('static', 'dynamic', 'truth') of a scene is 'made' or 'supplied' by the user.

    A truth is always simulated, also where the user supplies the video. All of a capture is 'captured'. A splat has
    neither images nor a truth.
    """
    if SETTINGS.scenes[scene].part_of:
        return "part"
    if SETTINGS.scenes[scene].bodies and not SETTINGS.scenes[scene].captured:
        return "made"
    if not SETTINGS.scenes[scene].has_truth:
        return "captured" if SETTINGS.scenes[scene].captured else "none"
    if getattr(SETTINGS.scenes[scene].images, "dynamic" if part == "truth" else part):
        return "made" if part == "truth" else "supplied"
    return "made"


def scenes_with(part, origin):
    """Pattern of the scenes whose part is of an origin, so that one rule makes each file."""
    return "|".join(scene for scene in SETTINGS.scenes if origin_of(part, scene) == origin) or "none"


def supplied_list(part):
    """A function of wildcards: the file that lists the images that the user supplies for a part of a scene."""

    @checked
    def choose(wildcards):
        images = SETTINGS.scene(wildcards.scene).images
        origin = f"scenes.{wildcards.scene}.images"
        return image_list(getattr(images, part), images.stride, f"{origin}.{part}", f"{origin}.stride")

    return choose


def supplied_world(wildcards):
    """Conversion of the world and the frames of supplied images to those of a scene."""
    images = SETTINGS.scene(wildcards.scene).images.plain()
    return {name: images[name] for name in ("stride", "scale", "offset")}


def truth_memory(wildcards):
    """Memory that a ground truth takes [MB]: twice the particles (x, v, F, C) and tracers of all frames.

    The particles of a converged truth are those of a body that fills a twentieth of the cube.
    """
    truth = truth_settings(wildcards)
    bytes_a_frame = 96 * (truth.particles or 8 * truth.grid**3 // 20) + 24 * SETTINGS.dataset.tracers
    return 2000 + 2 * len(frame_steps(wildcards)) * bytes_a_frame // 10**6


def render_minutes(part):
    """A function of wildcards: minutes that the renders of all frames of a part ('static', 'dynamic') may take.

    An hour, and a minute a megapixel at 16 samples. At the paper's scale a core took 0.2 minutes a megapixel, and 0.8
    for a liquid (docs/scale.md).
    """
    images = getattr(SETTINGS.dataset, part)
    samples = images.views * images.width * images.height * images.samples
    return lambda wildcards: 60 + round(
        (len(frame_steps(wildcards)) if part == "dynamic" else 1) * samples / 16e6
    )


frame_steps = by_subject(
    lambda scene: list(SETTINGS.frame_steps(scene)),
    lambda experiment: list(SETTINGS.dataset.frame_steps(SETTINGS.experiment(experiment).steps)),
)
time_step = by_subject(lambda scene: SETTINGS.scene(scene).dt, SETTINGS.experiment_dt)
truth_settings = by_subject(SETTINGS.scene_truth, SETTINGS.experiment_truth)


def simulation_settings(wildcards):
    """Constants of the simulator for a scene or experiment."""
    world = by_subject(SETTINGS.scene_world, lambda experiment: {})(wildcards)
    return simulator(subject(wildcards), time_step(wildcards)) | world


def obstacle_meshes(wildcards):
    """Meshes of the colliders of a scene or experiment."""
    colliders = SETTINGS.obstacles(subject(wildcards)).get("colliders", [])
    return [each["shape"] for each in colliders if is_mesh_file(each["shape"])]


def meshes_of_videos(wildcards):
    """The same of all videos of a scene."""
    meshes = of_each_video(obstacle_meshes)(wildcards)
    return list(dict.fromkeys(mesh for each in meshes for mesh in listed(each)))


def exposure(wildcards):
    """Settings that renders of a video with exposures need."""
    return {"dt": SETTINGS.scene(wildcards.scene).dt, "exposure_samples": SETTINGS.dataset.exposure_samples}


def simulator(name, dt, grid=None):
    """Constants of the simulator for a scene or experiment, on the reconstruction's grid unless another is given."""
    section = SETTINGS.simulation.plain() | ({"grid": grid} if grid else {})
    constants = {key: section[key] for key in ("grid", "gravity", "boundary", "contact")}
    return {"dt": dt, **constants, **SETTINGS.obstacles(name)}


def densities_of(scenes):
    """A function of wildcards: densities of the bodies of all scenes that belong to a scene or an experiment."""

    @checked
    def choose(wildcards):
        return [SETTINGS.scene(scene).plain()["density"] for scene in scenes(subject(wildcards))]

    return choose


def body_settings(*keys):
    """A function of wildcards: the named settings of the bodies of a scene or experiment.

    Those of a scene of several bodies have a ``name`` as well.
    """
    return by_subject(
        lambda scene: (
            [{key: body[key] for key in ("name", *keys)} for body in SETTINGS.scene_bodies(scene)]
            if SETTINGS.scene(scene).bodies
            else [scene_setting(*keys)(SimpleNamespace(scene=scene))]
        ),
        lambda experiment: [
            {key: body[key] for key in keys} for body in SETTINGS.experiment_bodies(experiment)
        ],
    )


def has_separate_bodies(wildcards):
    """Whether the bodies of a scene or an experiment touch each other with friction. Others stick."""
    return len(SETTINGS.touching_bodies(subject(wildcards))[1]) > 1


def solid_meshes(every=True):
    """A function of wildcards: the repaired meshes of the bodies of a scene or experiment whose shapes are files.

    Without those that an experiment takes from reconstructions, if not ``every``.
    """
    bodies = by_subject(SETTINGS.scene_bodies, SETTINGS.experiment_bodies)

    @checked
    def choose(wildcards):
        return [
            of_data(f"solid_{k}.ply")(wildcards)
            for k, body in enumerate(bodies(wildcards))
            if is_mesh_file(body["shape"]) and (every or not body["reconstructed"])
        ]

    return choose


def reconstructed_files(name):
    """A function of wildcards: a file of the scene of each body that is the scene's own object."""

    @checked
    def choose(wildcards):
        scenes = SETTINGS.body_scenes(subject(wildcards))
        bodies = by_subject(SETTINGS.scene_bodies, SETTINGS.experiment_bodies)(wildcards)
        return [
            result_path(scene, name) for body, scene in zip(bodies, scenes) if body.get("reconstructed", True)
        ]

    return choose
