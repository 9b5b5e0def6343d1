"""Functions of the rules for bodies at rest in photographs, settings `stills`."""

from neuma_lib.io.datasets.stills import still_files, swing_files

RESTING = SETTINGS.stills
RESTING_TITLES = [name.replace("_", " ") for name in RESTING.bodies]


def resting_body(wildcards):
    return RESTING.bodies[wildcards.body]


def resting_inputs(body):
    """Photographs' masks, the mesh, and the fit of the body that predicts this one."""
    settings = RESTING.bodies[body]
    source = settings.predicted_from
    return {
        "masks": still_files(RESTING.root, settings.record, "mask"),
        "frames": [f"{RESTING.root}/{name}.json" for name in ("frames", "calibration")],
        "mesh": f"{RESTING.root}/{settings.mesh}",
        **({"source": f"{RESULTS}/stills/{source}.json"} if source else {}),
    }


def swing_inputs(name):
    """The still of the held body, label maps, the mesh, and the fit of the hanging body."""
    swing = RESTING.swings[name]
    return {
        "held": still_files(RESTING.root, swing.still, "mask")[0],
        "silhouettes": list(swing_files(RESTING.root, swing.silhouettes).values()),
        "times": f"{RESTING.root}/{swing.silhouettes}/times.json",
        "frames": [f"{RESTING.root}/{name}.json" for name in ("frames", "calibration")],
        "mesh": f"{RESTING.root}/{RESTING.bodies[swing.body].mesh}",
        "source": f"{RESULTS}/stills/{swing.body}.json",
    }


def resting_results():
    """Results of all bodies. Raises InputError if there are none."""
    if not RESTING.bodies:
        raise InputError(
            "stills.bodies", "there are none", "Use for example --configfile config/silicone.yaml"
        )
    return [f"{RESULTS}/stills/{body}.json" for body in RESTING.bodies]


def resting_pictures(key):
    """The first photograph (key "file") or mask ("mask") of each body."""
    return [still_files(RESTING.root, body.record, key)[0] for body in RESTING.bodies.values()]
