"""What rules read, over the graph of all jobs behind everything that can be asked for.

Jobs are read from two plans: one with the settings of tiny.yaml, and one with more scenes, tables, figures and devices.
"""

import shutil

import pytest

from neuma_lib.errors import InputError
from neuma_lib.project import cases, loading
from tests.support.errors import refused
from tests.support.project import ROOT, SCENE, TABLE, copied, overlay

RESULTS = SCENE.rpartition("/")[0]
EXPERIMENTS = f"{RESULTS}/experiments"
REPLICATE = f"{SCENE}+seed=1"
SUPERVISED = f"{SCENE}/neuma_particle_supervision"  # the one method that trains on the truth
EVERYTHING = ("tables", "figures", "videos", f"{SUPERVISED}/image_metrics.json", f"{SCENE}/viewer.html")
# Blender films the truth, evaluation measures against it; figures and viewer show it.
MAY_READ_THE_TRUTH = {
    *("render_static", "render_dynamic", "initial_state", "tracers", "evaluate", "viewer"),
    *("particles_app", "lora_alphav", "ext_time", "obstacles"),
}
COMPARED = [f"{RESULTS}/figures/{name}.png" for name in ("main_res", "image_quality", "ch_dist_curve")]
LAWS = [
    *("neuma", "nclaw", "constants", "neuma_structured", "neuma+prior=identified", "pac_nerf", "true_law"),
    *("neuma_structured+views=0,1", "neuma+law_from=JellyDuck"),
]
EXPORTED_LAWS = {
    f"{RESULTS}/{scene}/{method}/export/law.safetensors": (scene, method)
    for scene in ("BouncyBall", "BouncyBall+seed=1", "BouncyBall+prior_seed=1")
    for method in LAWS
}
MOVED = [
    f"{SCENE}/spring_gaus",
    *(f"{EXPERIMENTS}/letter_N_bouncy/{law}" for law in ("neuma", "spring_gaus")),
]
EXPORTS = ("gaussians", "compressed", "particles.h5", "surface.glb", "motion.blend", "motion.gif")
VARIED = ("adaptor", "prior", "particles", "gaussians")
REPLICATES = {"scenes": ["BouncyBall"], "methods": ["nclaw", "neuma"], "seeds": 3}
FILMED = f"{RESULTS}/Filmed"
TWO_VIDEOS = {"scenes": {"Filmed": {"like": "BouncyBall", "videos": [{"velocity": [0.5, -1.0, 0.0]}]}}}
TARGETS = {
    "plan": [TABLE, *EXPORTED_LAWS, *(f"{folder}/export/{file}" for folder in MOVED for file in EXPORTS)],
    "wider": [*COMPARED, *(f"{RESULTS}/{name}.csv" for name in ("replicates", *VARIED, "identified_filmed"))],
}
"""Targets of the two plans, to which `behind` adds."""


def behind(*targets, of="plan"):
    """A decorator: the test's ``graph`` is the jobs behind some targets in one of the plans."""
    TARGETS[of] += targets
    return pytest.mark.parametrize("graph", [(of, targets)], indirect=True, ids=[of])


@pytest.fixture
def graph(request):
    name, targets = request.param
    return request.getfixturevalue(name).behind(*targets)


@pytest.fixture(scope="module")
def project(tmp_path_factory, kernels):
    return copied(tmp_path_factory.mktemp("graph"), kernels)


@pytest.fixture(scope="module")
def tiny_settings():
    """A function of changes: the settings of the plans."""

    def load(**changes):
        read = [loading.read_yaml(ROOT / file) for file in ("config/config.yaml", "tests/workflow/tiny.yaml")]
        return loading.load(loading.merged(loading.merged(*read), changes), ROOT)

    return load


@pytest.fixture(scope="module")
def plan(project):
    """A plan with the settings of tiny.yaml, without refined bodies."""
    return project.plan(*overlay(identify={"refined_particles": 0}), *TARGETS["plan"])


@pytest.fixture(scope="module")
def wider(project):
    """A plan with a scene of two videos, replicates of tables, other systems in figures, and Blender on a GPU."""
    learned = ["neuma", "constants", "constants+law_from=Filmed_throw2"]
    changes = overlay(
        device="cpu",
        dataset={"blender": {"device": "cuda", "threads": 2}},
        figures={"methods": ["neuma", "neuma_structured"], "beside": ["spring_gaus", "pac_nerf_own"]},
        identify={"refined_particles": 201},
        **TWO_VIDEOS,
        tables={
            "replicates": REPLICATES,
            **{drawn: REPLICATES | {"vary": [drawn]} for drawn in VARIED},
            "filmed": {"scenes": ["Filmed"], "methods": learned},
        },
    )
    return project.plan("--set-resources", "mesh:runtime=7", *changes, *TARGETS["wider"])


@behind("tables")
def test_every_table_can_be_planned(graph):
    assert {"experiment_start", "benchmark_table"} <= set(graph)
    evaluated = {job.outputs[0].startswith(f"{EXPERIMENTS}/") for job in graph.of_rule("evaluate")}
    assert evaluated == {True, False}
    assert graph["chamfer_table"] >= 4 and graph["prior"] == 8


@behind("figures", "random", f"{RESULTS}/figures/realworld.png", f"{RESULTS}/figures/reliability.png")
def test_every_figure_can_be_planned(graph):
    modules = {module.stem for module in (ROOT / "neuma_lib/paper/figures").glob("[!_]*.py")}
    # i23d needs a splat, stills recordings, pile several bodies: test_splat_scenes.py, test_stills.py and
    # test_several_bodies.py.
    assert modules - {"i23d", "stills", "pile"} <= set(graph)


def is_truth(file):
    return "/data/" in file and file.endswith("/truth.h5")


@behind(*EVERYTHING)
def test_only_evaluation_and_figures_of_it_and_one_ablation_read_the_truth(graph):
    assert len(graph.jobs) > 80
    truths = {file for job in graph.of_rule("ground_truth") for file in job.outputs}
    assert len(truths) > 5
    readers = [job for job in graph.jobs if truths & set(job.inputs)]
    assert {job.rule for job in readers} == MAY_READ_THE_TRUTH | {"fit_neuma"}
    trained = [job.outputs[0] for job in readers if job.rule == "fit_neuma"]
    assert trained and all("/neuma_particle_supervision" in file for file in trained)
    supervised = graph.makers[f"{SUPERVISED}/adaptor.safetensors"].inputs
    assert not any(file.endswith("transforms.json") for file in supervised)


@behind("figures", of="wider")
def test_a_figure_that_shows_one_law_is_there_for_each_method(graph):
    read = {job.rule: " ".join(job.inputs) for job in graph.jobs}
    for figure, file in {"lora_alphav": "adaptor.safetensors", "vis_generalize": "rollout.h5"}.items():
        published, structured = read[figure], read[f"{figure}_neuma_structured"]
        assert f"/neuma/{file}" in published and "structured" not in published
        assert f"/neuma_structured/{file}" in structured and "/neuma/" not in structured
    assert "/priors/" in read["lora_alphav"] and f"{SCENE}/velocity.json" in read["lora_alphav"]
    structured = read["lora_alphav_neuma_structured"]
    assert "/priors/" not in structured and f"{SCENE}/identified.json" in structured
    assert all(
        f"/{method}/rollout.h5" in read["ext_time"] for method in ("nclaw", "neuma", "neuma_structured")
    )


@behind("calibration")
def test_a_calibration_needs_identifications_of_the_random_scenes_alone(graph):
    records = list(graph.of_rule("calibration_record"))
    assert len(records) == graph["identify"] == 12 and not graph["fit_neuma"] and not graph["evaluate"]
    for job in records:
        assert job.outputs[0].replace("calibration", "identified") in job.inputs
        assert not any(map(is_truth, job.inputs))
    (table,) = graph.of_rule("calibration_table")
    assert sorted(table.inputs) == sorted(job.outputs[0] for job in records)


@behind(f"{SCENE}/constants/metrics.json", f"{SCENE}/identified.png")
def test_identified_constants_need_the_video_and_no_training(graph):
    identify = graph.one("identify")
    assert identify.outputs == [f"{SCENE}/identified.json"]
    assert graph["identified_page"] and not graph["fit_neuma"]
    assert any(file.endswith("transforms.json") for file in identify.inputs)
    assert not any(map(is_truth, identify.inputs))
    assert f"{SCENE}/identified.json" in graph.one("evaluate").inputs


@behind(f"{REPLICATE}/constants/metrics.json")
def test_identified_constants_are_those_of_the_replicate(graph):
    assert f"{REPLICATE}/identified.json" in graph.makers


@behind(f"{SCENE}/spring_gaus+anchors=50/metrics.json")
def test_springs_are_fitted_to_the_video_alone(graph):
    fit = graph.one("fit_spring_gaus")
    assert fit.outputs[0] == f"{SCENE}/spring_gaus+anchors=50/springs.safetensors" and not graph["fit_neuma"]
    assert {"tiny/data/BouncyBall/dynamic/transforms.json", f"{SCENE}/velocity.json"} <= set(fit.inputs)
    assert not any("/priors/" in file or is_truth(file) for file in fit.inputs)
    assert fit.outputs[0] in graph.one("evaluate").inputs


@behind(f"{EXPERIMENTS}/letter_N_bouncy/spring_gaus/metrics.json")
def test_springs_move_another_body(graph):
    assert f"{SCENE}/spring_gaus/springs.safetensors" in graph.one("evaluate").inputs


@behind(f"{RESULTS}/table2_systems.csv")
def test_springs_and_laws_of_a_table_are_put_to_use_elsewhere_as_their_scenes_taught_them(graph):
    """Fits are those of the scenes: the table repeats none, and none sees more than the video."""
    fitted = [job.outputs[0] for job in graph.of_rule("fit_spring_gaus") + graph.of_rule("fit_pac_nerf")]
    scenes = ("BouncyBall", "JellyDuck", "RubberPawn")
    files = ("spring_gaus/springs.safetensors", "pac_nerf/constants.json")
    assert sorted(fitted) == sorted(f"{RESULTS}/{scene}/{file}" for scene in scenes for file in files)
    evaluated = {job.outputs[0]: job.inputs for job in graph.of_rule("evaluate")}
    used = {file.split("/")[3]: read for file, read in evaluated.items() if "/spring_gaus/" in file}
    assert len(used) == 5 and graph["evaluate"] == 6 * 5
    for experiment, scene in (
        ("letter_N_jelly", "JellyDuck"),
        ("longer_jelly", "JellyDuck"),
        ("longer_bouncy", "BouncyBall"),
    ):
        assert f"{RESULTS}/{scene}/spring_gaus/springs.safetensors" in used[experiment]
        assert f"tiny/data/experiments/{experiment}/truth.h5" in used[experiment]
    table = graph.one("chamfer_table").inputs
    assert len(table) == 6 * 5
    assert not any(f"{RESULTS}/{scene}/" in file for scene in scenes for file in table)


@behind(f"{REPLICATE}/pac_nerf+guesses=prior/metrics.json")
def test_pac_nerf_needs_images_its_field_and_contact_alone(graph):
    """Its own start and law are evaluated; no networks, and no truth, lead to them."""
    run = f"{REPLICATE}/pac_nerf+guesses=prior"
    fit, evaluation = graph.one("fit_pac_nerf"), graph.one("evaluate")
    assert fit.outputs[0] == f"{run}/constants.json"
    assert not graph.keys() & {"fit_neuma", "fit_structured", "identify"}
    assert graph.one("radiance_field").outputs[0] == f"{REPLICATE}/pac_nerf/field.safetensors"
    assert {
        *("tiny/data/BouncyBall/dynamic/transforms.json", f"{REPLICATE}/velocity.json"),
        f"{REPLICATE}/pac_nerf/field.safetensors",
    } <= set(fit.inputs)
    assert not any("/priors/" in file or is_truth(file) for file in fit.inputs)
    assert f"{run}/constants.json" in evaluation.inputs
    assert not any("velocity.json" in file for file in evaluation.inputs)


@behind(*(f"{REPLICATE}/pac_nerf_own+guesses=prior/{name}" for name in ("image_metrics.json", "video.mp4")))
def test_pac_nerfs_own_particles_are_evaluated_with_its_field_and_fit_nothing_again(graph):
    own, base = (f"{REPLICATE}/{name}+guesses=prior" for name in ("pac_nerf_own", "pac_nerf"))
    assert graph.one("fit_pac_nerf").outputs == [f"{base}/constants.json", f"{base}/history.json"]
    for rule in ("evaluate", "image_metrics", "video"):
        job = graph.one(rule)
        assert (
            job.outputs[0].startswith(f"{own}/") and f"{REPLICATE}/pac_nerf/field.safetensors" in job.inputs
        )
        assert any(file.endswith("radiance.ready") for file in job.inputs)
    assert graph["radiance_field"] and f"{base}/constants.json" in graph.one("evaluate").inputs


@behind("figures", *COMPARED)
def test_other_systems_are_in_figures_that_ask_for_them_alone(graph, wider):
    files = [file for job in graph.jobs for file in job.inputs + job.outputs]
    assert not any("pac_nerf" in file or "spring_gaus" in file for file in files)
    for figure, file in zip(COMPARED, ("rollout.h5", "image_metrics.json", "metrics.json"), strict=True):
        displayed = {f"{SCENE}/{method}/{file}" for method in ("neuma", "spring_gaus", "pac_nerf_own")}
        assert displayed <= set(wider.makers[figure].inputs)
    assert f"{SCENE}/pac_nerf/field.safetensors" in wider.one("main_res").inputs


@behind(f"{REPLICATE}/neuma_structured/metrics.json")
def test_a_structured_law_corrects_what_the_video_shows(graph):
    """Around the constants of its scene, in its replicate, and without networks to start from."""
    fit, evaluation = graph.one("fit_structured").inputs, graph.one("evaluate").inputs
    assert f"{REPLICATE}/identified.json" in fit
    assert not any("/priors/" in file for file in fit + evaluation)
    assert f"{REPLICATE}/neuma_structured/adaptor.safetensors" in evaluation


@behind(f"{SCENE}/neuma_structured+prior=jelly+start=estimated/metrics.json")
def test_a_structured_law_of_a_prior_needs_no_identification(graph):
    assert graph["fit_structured"] and not graph["identify"]


def test_the_command_line_exports_the_law_that_the_rule_exports(plan, tiny_settings):
    """Of every kind of law, in a replicate too: the files that `export-law` finds are those that the rule reads."""
    settings = tiny_settings()
    for target, (scene, method) in EXPORTED_LAWS.items():
        read = set(plan.makers[target].inputs)
        named = set(cases.case(settings, scene, method).source().paths)
        own = {f"{RESULTS}/{scene}/{method}/{file}" for file in ("metrics.json", "rollout.h5")}
        assert read - own == {"tiny/data/kernels/laws.ready", *named}
        assert bool(named) == (method != "true_law") and (own <= read or "law_from" in method)


@behind(*(f"{REPLICATE}/{method}+views=0,1/metrics.json" for method in ("neuma_structured", "constants")))
def test_more_views_have_constants_of_their_own(graph):
    (identify,) = [job for job in graph.jobs if job.rule.startswith("identify")]
    assert identify.outputs == [f"{REPLICATE}/identified+views=0,1.json"]
    readers = [job.rule for job in graph.jobs if identify.outputs[0] in job.inputs]
    assert sorted(readers) == [
        "evaluate",
        "evaluate",
        "fit_structured",
    ]  # of both methods: law and initial motion


@behind(*(f"{REPLICATE}/neuma_structured/{name}.json" for name in ("stress", "response")))
def test_stresses_are_compared_in_the_states_of_their_replicate_and_drawn_over_those_of_the_first(graph):
    stress, response = (
        graph.makers[f"{REPLICATE}/neuma_structured/{name}.json"].inputs for name in ("stress", "response")
    )
    assert f"{REPLICATE}/visited.h5" in stress and f"{SCENE}/visited.h5" in response
    assert f"{REPLICATE}/identified.json" in response
    assert f"{REPLICATE}/neuma_structured/rollout.h5" in response
    assert not any("/data/" in file and "kernels" not in file for file in stress + response)


@behind(f"{REPLICATE}/neuma+prior=identified/metrics.json")
def test_networks_can_start_from_what_the_video_shows(graph):
    prior = graph.one("identified_prior")
    assert f"{REPLICATE}/identified.json" in prior.inputs
    assert prior.outputs[0] == f"{REPLICATE}/priors/identified.safetensors"
    assert all(prior.outputs[0] in graph.one(rule).inputs for rule in ("fit_neuma", "evaluate"))
    assert f"{RESULTS}/priors/jelly+seed=1.safetensors" in graph.one("velocity").inputs


@behind(f"{REPLICATE}/neuma+start=identified/metrics.json")
def test_a_method_can_start_as_identified(graph):
    for rule in ("fit_neuma", "evaluate"):
        read = graph.one(rule).inputs
        assert f"{REPLICATE}/identified.json" in read and not any(
            file.endswith("velocity.json") for file in read
        )


def test_refined_bodies_are_finer_or_none(plan, wider):
    """0 and 201 particles for the 200 of the geometry; 200 are refused, see below."""
    assert plan["identify"] and wider["identify"]


@behind(f"{REPLICATE}/neuma/video.mp4", of="wider")
def test_rules_with_a_script_get_what_they_leave_out(graph):
    """Fails where a Snakemake no longer reads what `workflow.defaults.complete` writes."""
    for rule, expected in {
        "video": (
            f"log: {RESULTS}/logs/BouncyBall+seed=1/neuma/video.log",
            f"benchmark: {RESULTS}/benchmarks/BouncyBall+seed=1/neuma/video.tsv",
            *("mem_mb=4000,", "runtime=60,", "gpu="),
        ),
        "fit_neuma": ("mem_mb=6000,", "runtime=240,"),
        "mesh": ("mem_mb=4000,", "runtime=7,"),
        "kernels": ("log: tiny/data/kernels/logs/",),
    }.items():
        jobs = graph.of_rule(rule)
        assert jobs, rule
        for job in jobs:
            assert all(text in job.text for text in expected), job


def test_images_are_rendered_where_the_settings_request(plan, wider):
    """On one CPU core unless a GPU or more cores are asked for; images alone, not what is computed from them."""
    images = "tiny/data/BouncyBall/static/transforms.json"
    by_default, asked_for = plan.makers[images].text, wider.makers[images].text
    assert "gpu=0" in by_default and "threads: 2" not in by_default
    assert "gpu=1" in asked_for and "threads: 2" in asked_for
    assert {job.rule for job in wider.jobs if "gpu=1" in job.text} == {"render_static", "render_dynamic"}


def test_three_replicates_share_their_data_and_nothing_else(plan, wider):
    one, three = plan.behind(TABLE), wider.behind(f"{RESULTS}/replicates.csv")
    shared = {"kernels", "ground_truth", "render_static", "render_dynamic", "chamfer_table"}
    assert {"prior", "gaussians", "sampled_particles", "velocity", "fit_neuma", "evaluate"} <= set(one)
    assert three == {rule: count if rule in shared else 3 * count for rule, count in one.items()}
    outputs = [file for job in three.jobs for file in job.outputs]
    assert len(outputs) == len(set(outputs))
    for job in three.jobs:
        computed = {file for file in job.inputs if file.startswith("tiny/results/")}
        if "+seed=2" in job.outputs[0]:
            assert all("+seed=2" in file for file in computed), job
        elif job.rule != "chamfer_table":
            assert not any("+seed=2" in file for file in computed), job


@pytest.mark.parametrize(
    ("drawn", "repeated"),
    [
        ("adaptor", ["fit_neuma"]),
        ("prior", ["prior", "velocity", "fit_neuma"]),
        ("particles", ["sampled_particles", "binding", "velocity", "fit_neuma"]),
        (
            "gaussians",
            ["gaussians", "mesh", "tracers", "sampled_particles", "binding", "velocity", "fit_neuma"],
        ),
    ],
)
def test_what_varies_alone_repeats_what_depends_on_it(plan, wider, drawn, repeated):
    one, three = plan.behind(TABLE), wider.behind(f"{RESULTS}/{drawn}.csv")
    more = dict.fromkeys(repeated, 2) | {
        "evaluate": 2 if drawn == "adaptor" else 4
    }  # the prior's motion has no adaptor
    assert three == {rule: count + more.get(rule, 0) for rule, count in one.items()}


@behind(f"{EXPERIMENTS}/letter_and_ball+seed=1/neuma/metrics.json")
def test_an_experiment_follows_the_replicates_of_its_scenes(graph):
    assert {
        f"{REPLICATE}/neuma/adaptor.safetensors",
        f"{RESULTS}/priors/jelly+seed=1.safetensors",
        "tiny/data/experiments/letter_and_ball/truth.h5",
    } <= set(graph.one("evaluate").inputs)
    assert f"{REPLICATE}/velocity.json" in graph.one("experiment_start").inputs


@behind(
    f"{FILMED}+seed=1/neuma/metrics.json",
    f"{FILMED}_throw2+seed=1/neuma+law_from=Filmed/metrics.json",
    f"{FILMED}+seed=1/identified.json",
    of="wider",
)
def test_several_videos_train_one_law_which_is_evaluated_on_all(graph):
    fit = graph.one("fit_neuma")
    bodies = {
        f"{folder}+seed=1/{file}"
        for folder in (FILMED, f"{FILMED}_throw2")
        for file in ("particles.h5", "binding.h5", "gaussians.ply", "velocity.json")
    }
    for job in (fit, graph.one("identify")):
        assert bodies <= set(job.inputs)
        assert {file for file in job.inputs if file.endswith("transforms.json")} == {
            "tiny/data/Filmed/dynamic/transforms.json",
            "tiny/data/Filmed_throw2/dynamic/transforms.json",
        }
    evaluated = graph.of_rule("evaluate")
    assert len(evaluated) == 2 and all(fit.outputs[0] in job.inputs for job in evaluated)


def test_identifications_behind_a_table_are_those_of_the_laws_that_its_constants_have(wider):
    read = wider.one("identified_behind_table").inputs
    assert sorted(read) == [f"{FILMED}/identified.json", f"{FILMED}_throw2/identified.json"]


def test_motions_of_springs_and_of_experiments_are_exported_too(plan):
    for folder in MOVED:
        planned = plan.behind(*(f"{folder}/export/{file}" for file in EXPORTS))
        exports = {rule: count for rule, count in planned.items() if rule.startswith("export_")}
        kinds = ("gaussians", "particles", "surface", "blend", "film")
        assert exports == {f"export_{kind}": 2 if kind == "gaussians" else 1 for kind in kinds}


# ---- what cannot be had


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (
            [*overlay(training={"iteratons": 3}), TABLE],
            "training.iteratons: unknown key; did you mean iterations",
        ),
        (
            [*overlay(extensions=["no_such_file.py"]), TABLE],
            "/no_such_file.py does not exist. Paths are relative to the working directory",
        ),
        ([*overlay(training={"views": [7]}), TABLE], "training.views: no view 7"),
        (
            [*overlay(scenes={"BouncyBall": {"law": {"elasticity": {"E": 5e9}}, "height": 0.0}}), TABLE],
            "scenes.BouncyBall.law: the Courant number",
        ),
        ([*overlay(results_root="/"), TABLE], "results_root: / holds more than this project's files"),
        ([f"{SCENE}/neuma+rnk=3/metrics.json"], "no option 'rnk'; did you mean rank"),
        ([f"{SCENE}+sed=3/gaussians.ply"], "no option 'sed'; did you mean seed"),
        (
            [*overlay(identify={"refined_particles": 200}), f"{SCENE}/identified.json"],
            "identify.refined_particles: 200 must exceed geometry.particles = 200",
        ),
        ([f"{SCENE}/spring_gaus/stress.json"], "its motion follows from no material law"),
        (
            [f"{REPLICATE}/pac_nerf_own+guesses=prior/constants.json"],
            "it has no fit, its model is that of BouncyBall+seed=1/pac_nerf+guesses=prior",
        ),
        (
            [f"{EXPERIMENTS}/letter_N_bouncy/pac_nerf_own/metrics.json"],
            "Choose pac_nerf, which has the same fit",
        ),
        (
            [f"{SCENE}/pac_nerf_own/export/gaussians"],
            "it is evaluated on the particles of its fit, which only scenes with rendered videos have. Choose pac_nerf",
        ),
        ([f"{RESULTS}/figures/i23d.png"], "no scene has a splat"),
    ],
)
def test_what_cannot_be_had_ends_with_one_line_before_anything_runs(project, words, message):
    output = project.run(*words, succeeds=False)
    assert message in output and "Traceback (most recent call last)" not in output
    assert not (project.root / "tiny").exists()


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("seed: 1\nseed: 2\n", "line 2, column 1: the key 'seed' is in line 1 already"),
        (
            "a0: &a0 [x, x]\n" + "".join(f"a{k}: &a{k} [{f'*a{k - 1}, ' * 9}]\n" for k in range(1, 12)),
            "with its aliases (*name) it expands to more than",
        ),
    ],
)
def test_files_of_settings_that_snakemake_accepts_are_refused(project, tmp_path, text, message):
    """Snakemake keeps the last value of a key, and bounds no aliases."""
    file = tmp_path / "mine.yaml"
    file.write_text(text)
    assert f"{file}: " in (output := project.run("--configfile", str(file), "--", TABLE, succeeds=False))
    assert message in output


def test_a_broken_capture_stops_its_own_targets_only(project):
    capture = project.root / "captures/mug/capture.yaml"
    capture.parent.mkdir(parents=True)
    capture.write_text("a: &a [x, x]\nboard: [*a\n")
    try:
        output = project.run("--dry-run", f"{SCENE}/gaussians.ply")
        assert "captures/mug/capture.yaml: line 3, column 1: invalid YAML" in output
        refused_target = project.run("--dry-run", f"{RESULTS}/mug/capture.md", succeeds=False)
        assert refused_target.count("captures/mug/capture.yaml: line 3") > output.count(
            "capture.yaml: line 3"
        )
        assert "Traceback (most recent call last)" not in refused_target
        changed = overlay(scenes={"mug": {"density": 900}})
        assert "capture.yaml: line 3" in project.run("--dry-run", *changed, TABLE, succeeds=False)
    finally:
        shutil.rmtree(capture.parent)


def test_settings_are_refused_where_they_are_read(tiny_settings):
    """Of one refused setting, the list above shows that the workflow passes the message on."""
    with pytest.raises(InputError, match="figures.beside: .*pac_nerf"):
        tiny_settings(figures={"beside": ["pac_nerv"]})
    with pytest.raises(InputError, match="extensions: 3 is not"):
        tiny_settings(extensions=3)


def test_cases_of_other_models_are_known_to_have_no_own_fit(tiny_settings):
    """These are what the workflow refuses: a model of several bodies without a law, and the fit of another folder."""
    with refused("letter_and_ball/spring_gaus") as caught:
        cases.body_cases(tiny_settings(), "letter_and_ball", "spring_gaus")
    assert "it has no material law, so that it cannot move several bodies together" in str(caught.value)
    case = cases.case(tiny_settings(**TWO_VIDEOS), "Filmed_throw2", "neuma+law_from=Filmed")
    assert case.folder != case.name and f"{case.scene}/{case.name}" == "Filmed/neuma"


def test_one_identification_uses_all_cores_and_shares_them_with_others_and_with_fits(project):
    """The plans have two cores. The correction of identified constants cannot run at the same time."""
    scenes = [f"{RESULTS}/{name}/identified.json" for name in ("BouncyBall", "JellyDuck")]
    changes = overlay(device="cpu", identify={"refined_particles": 0})
    fits = [f"{SCENE}/{method}/metrics.json" for method in ("neuma", "neuma_structured")]
    for targets, threads in ((scenes[:1], 2), (scenes, 1), (fits, 1), (fits[1:], 2)):
        jobs = project.plan(*changes, *targets).of_rule("identify")
        assert len(jobs) == (2 if targets == scenes else 1)
        assert all(("threads: 2" in job.text) == (threads == 2) for job in jobs)
