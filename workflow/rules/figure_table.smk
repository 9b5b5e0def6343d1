"""Files, parameters and resources of each figure. figures.smk has their rules."""

import ast

DRAWN = SETTINGS.figures
COMPARED = SETTINGS.tables["table1"] if "table1" in SETTINGS.tables else None
# A law that is evaluated twice is drawn once, on the particles that all methods share, unless figures.beside names it.
SHARED = [m for m in (COMPARED or SETTINGS).methods if cases.fit_name(SETTINGS, m) == m]
METHODS = SHARED + [m for m in SETTINGS.figures.beside if m not in SHARED]
NAMES = table_titles("table1") if COMPARED else {}
TITLES = {method: NAMES.get(method) or cases.title(SETTINGS, method) for method in METHODS}
PREDICTED = ["nclaw", *DRAWN.methods]
# Laws of tests of material points: those whose stresses are compared, in all replicates.
RESPONDING = SETTINGS.tables.get("stress")
RESPONSES = [
    (scene, method, cases.runs(SETTINGS, "stress", method, scene))
    for scene in (DRAWN.material_response if RESPONDING else ())
    for method in RESPONDING.methods
]
SHOWN_EXPERIMENTS = [*DRAWN.letters, *DRAWN.meetings]


# ---- inputs of figures


def of_methods(scenes, methods, name):
    """A file of every scene under every method, scene by scene."""
    return [f"{RESULTS}/{scene}/{method}/{name}" for scene in scenes for method in methods]


def of_cells(table, name):
    """A file of every cell of a table, method by method; none if there is no such table."""
    methods = METHODS if table == "table1" else titles_of(table)
    return [f"{RESULTS}/{scene}/{method}/{name}" for method in methods for scene in scenes_of(table)]


def scenes_of(table):
    return list(SETTINGS.tables[table].scenes) if table in SETTINGS.tables else []


def titles_of(table):
    return table_titles(table) if table in SETTINGS.tables else {}


def own_bodies(scenes):
    """Sources of the bodies of methods that are rendered on particles of their fit, by method and scene."""
    sources = {}
    for method in METHODS:
        for scene in scenes:
            case = case_on(scene, method)
            if files := case.method.body_inputs(case):
                source = body_parameter(case) | {
                    "files": files,
                    "particle_source": case.method.particle_source(case),
                }
                sources.setdefault(method, {})[scene] = source
    return sources


def filmed(scenes):
    """Inputs of renders of scenes next to their videos."""
    return {
        "kernels": kernels("rendering"),
        "transforms": [f"{DATA}/{scene}/dynamic/transforms.json" for scene in scenes],
        **each_of(scenes),
    }


def learned(scenes, method="neuma"):
    """The laws of scenes: priors, where the method has one, and adaptors."""
    laws = [case.method.model_inputs(case) for case in (case_on(scene, method) for scene in scenes)]
    return {
        "kernels": kernels("laws"),
        "prior": [law["prior"] for law in laws if "prior" in law],
        "adaptor": of_methods(scenes, [method], "adaptor.safetensors"),
    }


def scene_constants(scenes):
    """Constants of scenes for rollouts and material tests."""
    plain = {scene: SETTINGS.scene(scene).plain() for scene in scenes}
    return {
        scene: {name: values[name] for name in ("dt", "density", "law")}
        | {"simulation": simulator(scene, values["dt"])}
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


def caption(figure):
    """Caption of a figure in the report: the docstring of its module."""
    return ast.get_docstring(ast.parse(figure_module(figure).read_text()))


def figure_module(figure):
    return ROOT / "neuma_lib" / "paper" / "figures" / f"{figure}.py"


# ---- the figures: kind of the data file, inputs and parameters of `data`, resources other than the default, the module
# if its name is another, and whether they are left out of the target `figures`

IN_VIEW = {"view": DRAWN.view, "magnify": DRAWN.magnify}


def interpolation(method):
    """Entry of lora_alphav for a method."""
    each = [case_on(scene, method) for scene in DRAWN.lora_alphav]
    return {
        "kind": "h5",
        "input": {
            **filmed(DRAWN.lora_alphav),
            **learned(DRAWN.lora_alphav, method),
            "kernels": kernels("laws", "rendering"),
            "truth": [f"{DATA}/{scene}/truth.h5" for scene in DRAWN.lora_alphav],
            "start": [case.method.start_file(case) for case in each],
        },
        "params": {
            "scenes": scene_constants(DRAWN.lora_alphav),
            "total": {case.scene: carries_total([case]) for case in each},
            "weights": list(DRAWN.weights),
            "shown": DRAWN.shown - 1,
            "device": SETTINGS.device,
            **IN_VIEW,
        },
        "resources": {"gpu": GPU, "mem_mb": 8000},
    }


def elsewhere(method):
    """Entry of vis_generalize for a method."""
    return {
        "kind": "h5",
        "input": {
            "kernels": kernels("rendering"),
            "rollouts": [
                f"{RESULTS}/experiments/{experiment}/{method}/rollout.h5" for experiment in SHOWN_EXPERIMENTS
            ],
            **each_of(SHOWN_EXPERIMENTS),
        },
        "params": {
            "letters": lambda wildcards: [
                {"letter": body["shape"].removeprefix("letter_"), "material": body["scene"]}
                for body in (SETTINGS.experiment_bodies(name)[0] for name in DRAWN.letters)
            ],
            "others": lambda wildcards: {name: SETTINGS.experiment(name).title for name in DRAWN.meetings},
            "shown": DRAWN.shown - 1,
            "size": DRAWN.size,
        },
    }


def splats():
    """The scenes with a splat. Raises InputError where there are none."""
    names = [name for name, scene in SETTINGS.scenes.items() if scene.splat]
    if not names:
        raise InputError("scenes", "no scene has a splat", "Add one, for example Guitar: {splat: guitar.ply}")
    return names


def of_splats(files):
    """A function of wildcards: files of the splats."""
    return checked(lambda wildcards: files(splats()))


def of_moved(name):
    """A function of wildcards: a file of every splat under every law of figures.i23d, splat by splat."""
    laws = [f"{DRAWN.methods[0]}+law_from={scene}" for scene in DRAWN.i23d]
    return of_splats(lambda scenes: of_methods(scenes, laws, name))


def of_captures(files):
    """A function of wildcards: files of the captures of the figure."""
    captures = list(DRAWN.realworld or SETTINGS.captures.released or PLANNED)
    return checked(lambda wildcards: files([training_scene(name) for name in captures]))


def of_cameras(scenes):
    """Measures of every camera of scenes under every method, scene by scene."""
    return [
        f"{RESULTS}/{scene}/{method}/views/{camera}.json"
        for scene in scenes
        for method in DRAWN.realworld_methods
        for camera in SETTINGS.scene(scene).captured.cameras
    ]


def filmed_constants(scenes):
    """Constants of takes for their pictures."""
    return {
        scene: {
            "dt": SETTINGS.scene(scene).dt,
            "cameras": len(SETTINGS.scene(scene).captured.cameras),
            "exposure": exposure(SimpleNamespace(scene=scene)),
            "motion": {
                method: gaussian_motion(SimpleNamespace(scene=scene, method=method))
                for method in DRAWN.realworld_methods
            },
        }
        for scene in scenes
    }


def of_each_method(figure, made_of):
    """A figure for each of figures.methods, with its name from the second on."""
    names = [figure, *(f"{figure}_{method}" for method in DRAWN.methods[1:])]
    return {
        name: {**made_of(method), "module": figure} for name, method in zip(names, DRAWN.methods, strict=True)
    }


FIGURES = {
    "ch_dist_curve": {
        "kind": "json",
        "input": {"metrics": of_cells("table1", "metrics.json")},
        "params": {
            "titles": TITLES,
            "scenes": {scene: SETTINGS.scene(scene).dt for scene in scenes_of("table1")},
        },
    },
    "image_quality": {
        "kind": "json",
        "input": {"metrics": of_cells("table1", "image_metrics.json")},
        "params": {"titles": TITLES, "scenes": scenes_of("table1")},
    },
    "main_res": {
        "kind": "h5",
        "input": {
            **filmed(DRAWN.main_res),
            "kernels": sorted(
                {file for s in DRAWN.main_res for m in METHODS for file in body_kernels(case_on(s, m))}
            ),
            "rollouts": of_methods(DRAWN.main_res, METHODS, "rollout.h5"),
            "own": [
                file
                for bodies in own_bodies(DRAWN.main_res).values()
                for body in bodies.values()
                for file in body["files"].values()
            ],
        },
        "params": {
            "titles": TITLES,
            "scenes": scene_constants(DRAWN.main_res),
            "own": own_bodies(DRAWN.main_res),
            "shown": DRAWN.shown,
            **IN_VIEW,
        },
    },
    "particles_app": {
        "kind": "h5",
        "input": {
            "truth": f"{DATA}/{DRAWN.particles_app}/truth.h5",
            "particles": f"{RESULTS}/{DRAWN.particles_app}/particles.h5",
            "rollouts": of_methods([DRAWN.particles_app], SHARED, "rollout.h5"),
        },
        "params": {
            "titles": {method: TITLES[method] for method in SHARED},
            "dt": SETTINGS.scene(DRAWN.particles_app).dt,
            "shown": DRAWN.shown + 3,
            "size": DRAWN.size,
        },
    },
    **of_each_method("lora_alphav", interpolation),
    **of_each_method("vis_generalize", elsewhere),
    "ext_time": {
        "kind": "h5",
        "input": {
            "kernels": kernels("rendering"),
            "truth": f"{DATA}/experiments/{DRAWN.ext_time}/truth.h5",
            **{name: result_path(DRAWN.ext_time, file) for name, file in BODY.items()},
            "rollouts": [f"{RESULTS}/experiments/{DRAWN.ext_time}/{m}/rollout.h5" for m in PREDICTED],
        },
        "params": {
            "titles": {method: cases.title(SETTINGS, method) for method in PREDICTED},
            "density": lambda wildcards: SETTINGS.experiment_bodies(DRAWN.ext_time)[0]["density"],
            "observed": lambda wildcards: video_length(SETTINGS.experiment(DRAWN.ext_time).bodies[0].scene),
            "shown": DRAWN.shown + 4,
            "size": DRAWN.size,
        },
    },
    "i23d": {
        "kind": "h5",
        "input": {
            "kernels": kernels("rendering"),
            "rollouts": of_moved("rollout.h5"),
            "reports": of_moved("motion.json"),
            **{name: of_splats(lambda scenes, name=name: each_of(scenes)[name]) for name in BODY},
        },
        "params": {
            "splats": of_splats(list),
            "laws": list(DRAWN.i23d),
            "shown": DRAWN.shown + 1,
            "size": DRAWN.size,
        },
        "default_target": False,
    },
    "realworld": {
        "kind": "h5",
        "input": {
            "kernels": kernels("rendering"),
            "shown": of_captures(
                lambda scenes: [f"{DATA}/{scene}/shown/transforms.json" for scene in scenes]
            ),
            "rollouts": of_captures(lambda scenes: of_methods(scenes, DRAWN.realworld_methods, "rollout.h5")),
            "measures": of_captures(of_cameras),
            **{name: of_captures(lambda scenes, name=name: each_of(scenes)[name]) for name in BODY},
        },
        "params": {
            "titles": {method: cases.title(SETTINGS, method) for method in DRAWN.realworld_methods},
            "scenes": of_captures(filmed_constants),
            "view": 0,
            "frames": DRAWN.shown + 2,
        },
        "default_target": False,
    },
    "gradient_analysis": {
        "kind": "json",
        "input": {
            **learned(DRAWN.gradient_analysis),
            "history": of_methods(DRAWN.gradient_analysis, ["neuma"], "history.json"),
        },
        "params": {"scenes": {scene: wrong_laws(scene) for scene in DRAWN.gradient_analysis}},
    },
    "uneven_mass": {
        "kind": "h5",
        "input": {
            **filmed(scenes_of("uneven_mass")),
            "rollouts": of_cells("uneven_mass", "rollout.h5"),
            "metrics": of_cells("uneven_mass", "metrics.json"),
        },
        "params": {
            "titles": titles_of("uneven_mass"),
            "scene": scene_constants(scenes_of("uneven_mass")),
            "shown": DRAWN.shown,
            **IN_VIEW,
        },
    },
    "pipeline": {
        "kind": "h5",
        "input": {
            **filmed([DRAWN.pipeline]),
            **learned([DRAWN.pipeline]),
            "kernels": kernels("laws", "rendering"),
            "static": f"{DATA}/{DRAWN.pipeline}/static/transforms.json",
            "mesh": f"{RESULTS}/{DRAWN.pipeline}/mesh.ply",
            "rollout": f"{RESULTS}/{DRAWN.pipeline}/neuma/rollout.h5",
        },
        "params": {
            "scene": scene_constants([DRAWN.pipeline])[DRAWN.pipeline],
            "views": SETTINGS.dataset.static.views,
            **IN_VIEW,
        },
    },
    "obstacles": {
        "kind": "h5",
        "input": {
            "truth": [f"{DATA}/{scene}/truth.h5" for scene in DRAWN.obstacles],
            "meshes": lambda wildcards: [
                mesh for scene in DRAWN.obstacles for mesh in obstacle_meshes(SimpleNamespace(scene=scene))
            ],
        },
        "params": {
            "scenes": lambda wildcards: {
                scene: scene_setting("shape", "size", "height", "center", "rotation", "appearance")(
                    SimpleNamespace(scene=scene)
                )
                for scene in DRAWN.obstacles
            },
            "shown": DRAWN.shown - 1,
            "size": DRAWN.size,
            "samples": SETTINGS.dataset.static.samples,
            "threads": BLENDER.threads,
        },
        "resources": {"runtime": 60},
    },
    "stills": {
        "kind": "h5",
        "input": {
            "results": checked(lambda wildcards: resting_results()),
            "photographs": checked(lambda wildcards: resting_pictures("file")),
            "masks": checked(lambda wildcards: resting_pictures("mask")),
        },
        "params": {"titles": RESTING_TITLES, "photographs": RESTING.photographs},
        "default_target": False,
    },
    "material_response": {
        "kind": "json",
        "input": {"responses": [f"{RESULTS}/{run}/response.json" for *_, runs in RESPONSES for run in runs]},
        "params": {
            "cells": [[scene, method, len(runs)] for scene, method, runs in RESPONSES],
            "titles": {method: cases.title(SETTINGS, method) for _, method, _ in RESPONSES},
        },
    },
    "ablation_gradients": {
        "kind": "json",
        "input": {
            "histories": of_cells("ablation_gradients", "history.json"),
            "metrics": of_cells("ablation_gradients", "metrics.json"),
            "image_metrics": of_cells("ablation_gradients", "image_metrics.json"),
        },
        "params": {
            "titles": titles_of("ablation_gradients"),
            "scenes": scenes_of("ablation_gradients"),
        },
    },
    "reliability": {
        "kind": "json",
        "input": {"records": expand(f"{RESULTS}/{{scene}}/calibration.json", scene=SETTINGS.random_scenes)},
        "params": {},
        "default_target": False,
    },
    "random_scenes": {
        "kind": "json",
        "input": {"metrics": random_files(SETTINGS.random.methods[:2], "metrics.json")},
        "params": {
            "titles": {method: cases.title(SETTINGS, method) for method in SETTINGS.random.methods[:2]},
            "scenes": random_scenes(),
        },
        "default_target": False,
    },
}

if DRAWN.pile:
    PILE, _ = SETTINGS.touching_bodies(DRAWN.pile)
    TAKEN_OUT = f"experiments/{DRAWN.pile}"
    FIGURES["pile"] = {
        "kind": "h5",
        "input": {
            "kernels": kernels("laws", "rendering"),
            "transforms": f"{DATA}/{PILE}/dynamic/transforms.json",
            **each_of([PILE, DRAWN.pile]),
            "rollouts": [
                f"{RESULTS}/{run}/rollout.h5"
                for run in (f"{PILE}/constants", f"{TAKEN_OUT}/constants", f"{TAKEN_OUT}/true_law")
            ],
        },
        "params": {
            "body_of": [0, 1, 1],
            "titles": ["filmed", "understood", "one taken out", "true laws"],
            "frames": [
                list(SETTINGS.frame_steps(PILE)),
                list(SETTINGS.dataset.frame_steps(SETTINGS.experiment(DRAWN.pile).steps)),
            ],
            "dt": SETTINGS.scene(PILE).dt,
            **IN_VIEW,
            "shown": DRAWN.shown,
        },
        "default_target": False,
    }

# Read by report/figure.rst. They are no parameters, as an edit of a caption need not draw the figure again.
config["captions"] = {figure: caption(made_of.get("module", figure)) for figure, made_of in FIGURES.items()}
