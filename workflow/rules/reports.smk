"""What the report of a capture is made of: its laws, their runs on all throws, and files of these. Needs captures.smk."""

from neuma_lib.project.capture_scenes import scene_name, training_takes

# Methods that the learned one is compared with: the prior as it is, and the constants identified in the video.
PRIOR = next(iter(cases.of_kind(SETTINGS, "prior")), None)
CONSTANTS = next(iter(cases.of_kind(SETTINGS, "constants")), None)


def reported_methods(method):
    """Methods of a report, the learned one last."""
    return list(dict.fromkeys([*filter(None, [PRIOR, CONSTANTS]), method]))


@cache
def training_scene(name):
    """The scene that the law of a capture is learned in, with its further videos."""
    capture = capture_named(name)
    trained = training_takes(capture)
    if not trained:
        raise InputError(
            f"{capture.folder} has no videos: a report needs at least one throw, see docs/capture.md"
        )
    return scene_name(name, trained[0])


def thrown_method(name, throw, method):
    """Folder, below the results, of a method's run on a throw, under the law of its capture."""
    scene, training = scene_name(name, throw), training_scene(name)
    return f"{scene}/{method}" if scene == training else f"{scene}/{method}+{LAW_FROM}={training}"


@checked
def capture_start(wildcards):
    """How a filmed throw begins: as the method has it, or as its free flight tells where the throw is held out."""
    captured = SETTINGS.scene(wildcards.scene).captured
    if captured.throw in capture_named(captured.capture).settings.held_out:
        return of_chain("velocity.json")(wildcards)
    case = case_on(wildcards.scene, wildcards.method)
    return case.method.start_file(case)


@checked
def prior_rollout(wildcards):
    """The prediction of the prior on the same throw, to stand beside that of a method."""
    if PRIOR is None or wildcards.method.partition("+")[0] == PRIOR:
        return []
    captured = SETTINGS.scene(wildcards.scene).captured
    return f"{RESULTS}/{thrown_method(captured.capture, captured.throw, PRIOR)}/rollout.h5"


def scene_scale(wildcards):
    return SETTINGS.scene(wildcards.scene).captured.scale


def scene_cameras(wildcards):
    return list(SETTINGS.scene(wildcards.scene).captured.cameras)


@checked
def scene_view(wildcards):
    """Number of a camera of a throw."""
    cameras = scene_cameras(wildcards)
    if wildcards.camera not in cameras:
        raise InputError(
            f"{wildcards.scene} was filmed by {', '.join(cameras)}, and by no camera '{wildcards.camera}'"
        )
    return cameras.index(wildcards.camera)


def method_names(wildcards):
    """Titles of the laws of a report."""
    named = {PRIOR: "prior", CONSTANTS: "identified constants"}
    titles = {
        name: named.get(name, cases.title(SETTINGS, name)) for name in reported_methods(wildcards.method)
    }
    return titles


def report_law(name, method):
    """Method, files and options of the law of a capture, with the files of its uncertainty."""
    case = case_on(training_scene(name), method)
    files = {kind: paths[0] for kind, paths in law_files([case]).items()}
    return model_parameter([case]) | {"files": files | case.method.uncertainty_inputs(case)}


def of_report(function):
    """A function of wildcards: something of their capture's name and the learned method."""
    return checked(lambda wildcards: function(wildcards.capture, wildcards.method))


def report_cells(name, method):
    """What each measured camera of each throw is, method by method."""
    capture, cells = capture_named(name), []
    titles = method_names(SimpleNamespace(method=method))
    for each in reported_methods(method):
        for throw, camera in filmed_by(capture):
            learned = throw not in capture.settings.held_out
            named = {"method": each, "title": titles[each], "throw": throw, "camera": camera}
            cells.append({**named, "learned": learned})
    return cells


def measured_files(ending):
    """A function of wildcards: a file of each of `report_cells`."""

    def choose(name, method):
        return [
            f"{RESULTS}/{thrown_method(name, cell['throw'], cell['method'])}/views/{cell['camera']}.{ending}"
            for cell in report_cells(name, method)
        ]

    return of_report(choose)


def own_files(file, cameras=False):
    """A function of wildcards: a file of the learned method for each throw, or for each of its cameras."""

    def choose(name, method):
        capture = capture_named(name)
        places = filmed_by(capture) if cameras else [(throw, "") for throw in capture.takes]
        return [
            f"{RESULTS}/{thrown_method(name, throw, method)}/{file.format(camera=camera)}"
            for throw, camera in places
        ]

    return of_report(choose)


def thrown_files(file):
    """A function of wildcards: a file of the scene of each throw."""
    return of_report(
        lambda name, method: [
            f"{RESULTS}/{scene_name(name, throw)}/{file}" for throw in capture_named(name).takes
        ]
    )


def report_identified(name, method):
    if CONSTANTS is None:
        return []
    case = case_on(training_scene(name), CONSTANTS)
    return case.result(case.identified())


def report_facts(name, method):
    """What the report tells of a capture's settings."""
    capture = capture_named(name)
    settings = capture.settings
    exposures = {camera: of.exposure for camera, of in settings.cameras.items()}
    return {
        "prior": settings.prior,
        "density": settings.density,
        "density_stated": "density" in settings.model_fields_set,
        "scale": settings.scale,
        "dt": settings.dt,
        "width": settings.width,
        "held_out": list(settings.held_out),
        "throws": {
            throw: {camera: exposures.get(camera, 0.0) for camera in cameras}
            for throw, cameras in capture.takes.items()
        },
    }
