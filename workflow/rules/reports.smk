"""Inputs of the report of a capture: its laws and their runs on all takes. Needs captures.smk."""

from neuma_lib.project.capture_scenes import scene_name, training_takes

# Methods for comparison with the learned one: the unchanged prior, and the constants identified in the video.
PRIOR = next(iter(cases.of_kind(SETTINGS, "prior")), None)
CONSTANTS = next(iter(cases.of_kind(SETTINGS, "constants")), None)


def reported_methods(method):
    """Methods of a report, the learned one last."""
    return list(dict.fromkeys([*filter(None, [PRIOR, CONSTANTS]), method]))


@cache
def training_scene(name):
    """The scene in whose videos, and those that it names, the law of a capture is learned."""
    capture = capture_named(name)
    trained = training_takes(capture)
    if not trained:
        raise InputError(
            f"{capture.folder} has no videos: a report needs at least one take, see docs/capture.md"
        )
    return scene_name(name, trained[0])


def take_run(name, take, method):
    """Folder of a method's run on a take, under the law of its capture."""
    scene, training = scene_name(name, take), training_scene(name)
    return f"{RESULTS}/{scene}/{method}" + ("" if scene == training else f"+{LAW_FROM}={training}")


def of_registrations(file):
    """A function of wildcards: a file of each registration of their capture, in the order of `of_takes`."""
    return of_capture(
        lambda capture: [
            f"{RESULTS}/{scene_name(capture.folder.name, take)}{f'_{part.body}' if part.body else ''}/{file}"
            for part in parts_of(capture)
            for take in part.takes
        ]
    )


def object_reports(capture):
    """Reports of the fits of Gaussians: of all bodies photographed together, and of each one photographed alone."""
    files = {}
    for part in parts_of(capture):
        if part.body and part.source == part.name:
            files[""] = f"{RESULTS}/{capture.folder.name}/whole.json"
        else:
            files[part.body or ""] = f"{RESULTS}/{part.source}/gaussians.json"
    return files


@checked
def capture_start(wildcards):
    """File of the initial motion of a take: of the method, or of the free flight where the take is held out."""
    if SETTINGS.scene(wildcards.scene).bodies:
        return evaluated_start(wildcards)
    captured = SETTINGS.scene(wildcards.scene).captured
    if captured.throw in capture_named(captured.capture).settings.held_out:
        return of_replicate("velocity.json")(wildcards)
    case = case_on(wildcards.scene, wildcards.method)
    return case.method.start_file(case)


@checked
def prior_rollout(wildcards):
    """The prediction of the prior on the same take, for comparison."""
    if PRIOR is None or wildcards.method.partition("+")[0] == PRIOR:
        return []
    captured = SETTINGS.scene(wildcards.scene).captured
    return f"{take_run(captured.capture, captured.throw, PRIOR)}/rollout.h5"


scene_cameras = of_section(lambda scene: list(scene.captured.cameras))


@checked
def scene_view(wildcards):
    """Index of a camera of a take."""
    cameras = scene_cameras(wildcards)
    if wildcards.camera not in cameras:
        raise InputError(
            f"{wildcards.scene} was filmed by {', '.join(cameras)}, and by no camera '{wildcards.camera}'"
        )
    return cameras.index(wildcards.camera)


def report_titles(method):
    """Titles of the methods of a report."""
    named = {PRIOR: "prior", CONSTANTS: "identified constants"}
    return {name: named.get(name, cases.title(SETTINGS, name)) for name in reported_methods(method)}


def report_laws(name, method):
    """Method, files, options and files of the uncertainty of the laws of a report, by body and method."""
    scene = training_scene(name)
    laws = {body: {} for body in SETTINGS.scene(scene).bodies or [""]}
    for each in reported_methods(method):
        for of_body, case in zip(laws.values(), cases.body_cases(SETTINGS, scene, each), strict=True):
            files = {kind: paths[0] for kind, paths in law_files([case]).items()}
            of_body[each] = model_parameter([case]) | {
                "files": files,
                "uncertainty": case.method.uncertainty_inputs(case),
            }
    return laws


def of_report(function):
    """A function of wildcards: something of their capture's name and the learned method."""
    return checked(lambda wildcards: function(wildcards.capture, wildcards.method))


def report_cells(name, method):
    """Method, take and camera of each measured video, method by method."""
    capture, titles = capture_named(name), report_titles(method)
    return [
        {
            "method": each,
            "title": titles[each],
            "throw": take,
            "camera": camera,
            "learned": take not in capture.settings.held_out,
        }
        for each in titles
        for take, camera in videos_of(capture)
    ]


def report_identified(name, method):
    if CONSTANTS is None:
        return []
    if capture_named(name).labels:
        return f"{RESULTS}/{training_scene(name)}/identified.json"
    case = case_on(training_scene(name), CONSTANTS)
    return case.result(case.identified())


def report_facts(name, method):
    """Settings of a capture that its report states."""
    capture = capture_named(name)
    settings = capture.settings
    exposures = {camera: of.exposure for camera, of in settings.cameras.items()}
    return {
        **{key: getattr(settings, key) for key in ("prior", "scale", "dt", "width")},
        "densities": {
            body: {"value": own.density, "stated": "density" in own.model_fields_set}
            for body, own in (settings.bodies or {"": settings}).items()
        },
        "held_out": list(settings.held_out),
        "throws": {
            take: {camera: exposures.get(camera, 0.0) for camera in cameras}
            for take, cameras in capture.takes.items()
        },
    }
