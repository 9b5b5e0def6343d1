"""What the figures compare, and where the results that they show are."""

FIGURES = f"{RESULTS}/figures"
DRAWN = SETTINGS.figures
COMPARED = SETTINGS.tables["table1"] if "table1" in SETTINGS.tables else None
METHODS = list(COMPARED.methods if COMPARED else SETTINGS.methods)
TITLES = table_titles("table1") if COMPARED else {method: SETTINGS.method_title(method) for method in METHODS}
PREDICTED = ["nclaw", "neuma"]
ABLATION = SETTINGS.tables["ablation_gradients"] if "ablation_gradients" in SETTINGS.tables else None
UNEVEN = SETTINGS.tables["uneven_mass"] if "uneven_mass" in SETTINGS.tables else None
DATA_FILES = {
    "ch_dist_curve": "json",
    "image_quality": "json",
    "main_res": "h5",
    "particles_app": "h5",
    "lora_alphav": "h5",
    "vis_generalize": "h5",
    "ext_time": "h5",
    "gradient_analysis": "json",
    "uneven_mass": "h5",
    "pipeline": "h5",
    "material_response": "json",
    "ablation_gradients": "json",
}


def of_scenes(pattern, scenes):
    """A file of each scene."""
    return expand(pattern, scene=list(scenes))


def of_methods(scenes, methods, name):
    """A file of every scene under every method, scene by scene."""
    return [f"{RESULTS}/{scene}/{method}/{name}" for scene in scenes for method in methods]


def of_cells(table, name):
    """A file of every cell of a table, method by method."""
    return [f"{RESULTS}/{scene}/{method}/{name}" for method in table.methods for scene in table.scenes]


def of_experiments(names, pattern):
    return [f"{RESULTS}/experiments/{name}/{pattern}" for name in names]


def priors_of(scenes):
    """The priors that NeuMA starts from."""
    return [prior_file(SETTINGS.method_prior(scene, "neuma")) for scene in scenes]


def scene_constants(scenes):
    """What rollouts and material tests of scenes need to know."""
    plain = {scene: SETTINGS.scene(scene).plain() for scene in scenes}
    return {
        scene: {
            "dt": values["dt"],
            "density": values["density"],
            "law": values["law"],
            "simulation": simulator(values["dt"]),
        }
        for scene, values in plain.items()
    }


def video_length(scene):
    """Time of the last frame of a scene's video [s]."""
    return SETTINGS.scene(scene).dt * SETTINGS.frame_steps(scene)[-1]


def wrong_laws(scene):
    """Which laws of a scene's prior differ from the truth, in words."""
    truth = SETTINGS.scene(scene).law.plain()
    prior = SETTINGS.priors.laws.get(SETTINGS.scene(scene).prior)
    believed = prior.plain() if prior else {}
    names = {"elasticity": "elastic", "plasticity": "plastic"}
    return " and ".join(name for part, name in names.items() if believed.get(part) != truth[part]) or "none"
