"""What rules read, over the graph of all jobs behind everything that can be asked for."""

import re

import pytest

from neuma_lib.project import cases
from neuma_lib.project.project import settings_around
from tests.support.job_graph import jobs
from tests.support.project import SCENE, TABLE, copied

EXPERIMENT = f"{SCENE.rpartition('/')[0]}/experiments/letter_N_bouncy"
SUPERVISED = "neuma_particle_supervision"  # the one method that trains on the truth
# Blender films the truth, evaluation measures against it; figures and viewer show it.
MAY_READ_THE_TRUTH = {
    *("render_static", "render_dynamic", "initial_state", "evaluate", "viewer", "evaluate_experiment"),
    *("tracers", "experiment_tracers"),
    *("particles_app", "lora_alphav", "ext_time"),
}


@pytest.fixture(scope="module")
def project(tmp_path_factory, kernels):
    return copied(tmp_path_factory.mktemp("graph"), kernels)


def test_only_evaluation_and_figures_of_it_and_one_ablation_read_the_truth(project):
    on_request = [
        f"{SCENE}/{SUPERVISED}/image_metrics.json",
        f"{SCENE}/viewer.html",
    ]
    everything = ("tables", "figures", "videos", *on_request)
    graph = jobs(project.run("--dry-run", *everything))
    assert len(graph) > 80
    truths = {
        file for rule, _, made in graph if rule in ("ground_truth", "experiment_truth") for file in made
    }
    assert len(truths) > 5
    readers = {(rule, made[0]) for rule, read, made in graph if truths & set(read)}
    assert {rule for rule, _ in readers} == MAY_READ_THE_TRUTH | {"fit_neuma"}
    trained = {made for rule, made in readers if rule == "fit_neuma"}
    assert trained and all(f"/{SUPERVISED}" in made for made in trained)
    (supervised,) = [
        read for rule, read, made in graph if made[0] == f"{SCENE}/{SUPERVISED}/adaptor.safetensors"
    ]
    assert not any(file.endswith("transforms.json") for file in supervised)


def test_a_figure_that_shows_one_law_is_there_for_each_method(project):
    named = 'figures={"methods": ["neuma", "neuma_structured"]}'
    graph = jobs(project.run("--dry-run", "figures", "--config", named))
    read = {rule: " ".join(files) for rule, files, _ in graph}
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


def test_identified_constants_need_the_video_and_no_training(project):
    target = f"{SCENE}/constants/metrics.json"
    graph = jobs(project.run("--dry-run", target, f"{SCENE}/identified.png"))
    made = {rule: (read, outputs) for rule, read, outputs in graph}
    read, outputs = made["identify"]
    assert outputs == [f"{SCENE}/identified.json"] and "identified_page" in made and "fit_neuma" not in made
    assert any(file.endswith("transforms.json") for file in read)
    assert not any("truth.h5" in file for file in read), "the truth"
    assert f"{SCENE}/identified.json" in made["evaluate"][0]
    chained = project.run("--dry-run", target.replace("/constants", "+seed=1/constants"))
    assert f"{SCENE}+seed=1/identified.json" in chained


def test_springs_are_fitted_to_the_video_alone(project):
    graph = jobs(project.run("--dry-run", f"{SCENE}/spring_gaus+anchors=50/metrics.json"))
    made = {rule: (read, outputs) for rule, read, outputs in graph}
    read, outputs = made["fit_spring_gaus"]
    assert outputs[0] == f"{SCENE}/spring_gaus+anchors=50/springs.safetensors" and "fit_neuma" not in made
    assert "tiny/data/BouncyBall/dynamic/transforms.json" in read and f"{SCENE}/velocity.json" in read
    assert not any("/priors/" in file or "/data/BouncyBall/truth.h5" in file for file in read)
    assert outputs[0] in made["evaluate"][0]
    target = "tiny/results/experiments/{}/spring_gaus/metrics.json"
    graph = jobs(project.run("--dry-run", target.format("letter_N_bouncy")))
    made = {rule: (read, outputs) for rule, read, outputs in graph}
    assert f"{SCENE}/spring_gaus/springs.safetensors" in made["evaluate_experiment"][0]
    for impossible, message in {
        target.format(
            "letter_and_ball"
        ): "it has no material law, so that it cannot move several bodies together",
        f"{SCENE}/spring_gaus/stress.json": "its motion follows from no material law",
    }.items():
        assert message in project.run("--dry-run", impossible, succeeds=False)


def test_springs_and_laws_of_a_table_are_put_to_use_elsewhere_as_their_scenes_taught_them(project):
    """Fits are those of the scenes: the table repeats none, and none sees more than the video."""
    graph = jobs(project.run("--dry-run", "tiny/results/table2_systems.csv"))
    fitted = [outputs[0] for rule, _, outputs in graph if rule in ("fit_spring_gaus", "fit_pac_nerf")]
    scenes, files = (
        ("BouncyBall", "JellyDuck", "RubberPawn"),
        {"spring_gaus/springs.safetensors", "pac_nerf/constants.json"},
    )
    assert sorted(fitted) == sorted(f"tiny/results/{scene}/{file}" for scene in scenes for file in files)
    used = {
        outputs[0].split("/")[3]: read
        for rule, read, outputs in graph
        if rule == "evaluate_experiment" and "/spring_gaus/" in outputs[0]
    }
    assert len(used) == 5 and sum(rule == "evaluate_experiment" for rule, *_ in graph) == 6 * 5
    for experiment, scene in (
        ("letter_N_jelly", "JellyDuck"),
        ("longer_jelly", "JellyDuck"),
        ("longer_bouncy", "BouncyBall"),
    ):
        assert f"tiny/results/{scene}/spring_gaus/springs.safetensors" in used[experiment]
        assert f"tiny/data/experiments/{experiment}/truth.h5" in used[experiment]
    table = next(read for rule, read, _ in graph if rule == "chamfer_table")
    assert len(table) == 6 * 5 and not any(
        f"tiny/results/{scene}/" in file for scene in scenes for file in table
    )


def test_pac_nerf_needs_images_its_field_and_contact_alone(project):
    """Its own start and law are judged; no networks, and no truth, lead to them."""
    run = f"{SCENE}+seed=1/pac_nerf+guesses=prior"
    graph = jobs(project.run("--dry-run", f"{run}/metrics.json"))
    made = {rule: (read, outputs) for rule, read, outputs in graph}
    read, outputs = made["fit_pac_nerf"]
    assert outputs[0] == f"{run}/constants.json" and not {"fit_neuma", "fit_structured", "identify"} & set(
        made
    )
    assert made["radiance_field"][1][0] == f"{SCENE}+seed=1/pac_nerf/field.safetensors" in read
    assert "tiny/data/BouncyBall/dynamic/transforms.json" in read and f"{SCENE}+seed=1/velocity.json" in read
    assert not any("/priors/" in file or "/data/BouncyBall/truth.h5" in file for file in read)
    judged = made["evaluate"][0]
    assert f"{run}/constants.json" in judged and not any("velocity.json" in file for file in judged)


def test_pac_nerfs_own_particles_are_judged_with_its_field_and_fit_nothing_again(project):
    own, base = (f"{SCENE}+seed=1/{name}+guesses=prior" for name in ("pac_nerf_own", "pac_nerf"))
    graph = jobs(project.run("--dry-run", *(f"{own}/{name}" for name in ("image_metrics.json", "video.mp4"))))
    made = {rule: (read, outputs) for rule, read, outputs in graph}
    assert made["fit_pac_nerf"][1][0] == f"{base}/constants.json" and "radiance_field" in made
    for rule in ("evaluate", "image_metrics", "video"):
        read, (first, *_) = made[rule]
        assert first.startswith(f"{own}/") and f"{SCENE}+seed=1/pac_nerf/field.safetensors" in read
        assert any(file.endswith("radiance.ready") for file in read)
    assert f"{base}/constants.json" in made["evaluate"][0]
    for name in ("constants.json", "history.json"):
        refused = project.run("--dry-run", f"{own}/{name}", succeeds=False)
        assert f"it has no fit, its model is that of {base.removeprefix('tiny/results/')}" in refused
    elsewhere = "tiny/results/experiments/letter_N_bouncy/pac_nerf_own/metrics.json"
    assert "Choose pac_nerf, which has the same fit" in project.run("--dry-run", elsewhere, succeeds=False)


def test_other_systems_are_in_figures_that_ask_for_them_alone(project):
    figures = ("main_res", "image_quality", "ch_dist_curve")
    targets = [f"tiny/results/figures/{name}.png" for name in figures]
    plain = jobs(project.run("--dry-run", "figures", *targets))
    assert not any(
        "pac_nerf" in file or "spring_gaus" in file for _, read, made in plain for file in read + made
    )
    beside = ("--config", "figures={beside: [spring_gaus, pac_nerf_own]}", "--")
    read = {rule: files for rule, files, _ in jobs(project.run("--dry-run", *beside, *targets))}
    for name, file in zip(figures, ("rollout.h5", "image_metrics.json", "metrics.json"), strict=True):
        assert {f"{SCENE}/{method}/{file}" for method in ("neuma", "spring_gaus", "pac_nerf_own")} <= set(
            read[name]
        )
    assert f"{SCENE}/pac_nerf/field.safetensors" in read["main_res"]
    unknown = ("--config", "figures={beside: [pac_nerv]}", "--")
    assert "pac_nerf" in project.run("--dry-run", *unknown, *targets, succeeds=False)


def test_a_structured_law_corrects_what_the_video_shows(project):
    """Around the constants of its scene, in its chain, and without networks to start from."""
    graph = jobs(project.run("--dry-run", f"{SCENE}+seed=1/neuma_structured/metrics.json"))
    made = {rule: (read, outputs) for rule, read, outputs in graph}
    assert f"{SCENE}+seed=1/identified.json" in made["fit_structured"][0]
    assert not any("/priors/" in file for rule in ("fit_structured", "evaluate") for file in made[rule][0])
    assert f"{SCENE}+seed=1/neuma_structured/adaptor.safetensors" in made["evaluate"][0]
    graph = jobs(
        project.run("--dry-run", f"{SCENE}/neuma_structured+prior=jelly+start=estimated/metrics.json")
    )
    assert "identify" not in {rule for rule, *_ in graph}


def test_the_command_line_exports_the_law_that_the_rule_exports(project):
    """Of every kind of law, in a chain too: the files that `export-law` finds are those that the rule reads."""
    settings, _ = settings_around(project.root, [project.root / "tests/workflow/tiny.yaml"])
    methods = (
        "neuma",
        "nclaw",
        "constants",
        "neuma_structured",
        "neuma+prior=identified",
        "pac_nerf",
        "true_law",
    )
    methods += ("neuma_structured+views=0,1", "neuma+law_from=JellyDuck")
    scenes = ("BouncyBall", "BouncyBall+seed=1", "BouncyBall+prior_seed=1")
    wanted = [(scene, method) for scene in scenes for method in methods]
    targets = {
        f"tiny/results/{scene}/{method}/export/law.safetensors": (scene, method) for scene, method in wanted
    }
    read = {
        made[0]: set(inputs)
        for rule, inputs, made in jobs(project.run("--dry-run", *targets))
        if rule == "export_law"
    }
    for target, (scene, method) in targets.items():
        named = set(cases.case(settings, scene, method).source().paths)
        own = {f"tiny/results/{scene}/{method}/{file}" for file in ("metrics.json", "rollout.h5")}
        assert read[target] - own == {"tiny/data/kernels/laws.ready", *named} and bool(named) == (
            method != "true_law"
        )
        assert own <= read[target] or "law_from" in method


def test_more_views_have_constants_of_their_own(project):
    methods = [
        f"{SCENE}+seed=1/{method}+views=0,1/metrics.json" for method in ("neuma_structured", "constants")
    ]
    graph = jobs(project.run("--dry-run", *methods))
    (found,) = [outputs for rule, _, outputs in graph if rule.startswith("identify")]
    assert found == [f"{SCENE}+seed=1/identified+views=0,1.json"]
    readers = [rule for rule, read, _ in graph if found[0] in read]
    assert sorted(readers) == ["evaluate", "evaluate", "fit_structured"]  # of both methods: law and throw


def test_stresses_are_compared_in_the_states_of_their_chain_and_drawn_over_those_of_the_first(project):
    target = [f"{SCENE}+seed=1/neuma_structured/{name}.json" for name in ("stress", "response")]
    made = {outputs[0]: read for _, read, outputs in jobs(project.run("--dry-run", *target))}
    stress, response = (made[file] for file in target)
    assert f"{SCENE}+seed=1/visited.h5" in stress and f"{SCENE}/visited.h5" in response
    assert f"{SCENE}+seed=1/identified.json" in response
    assert f"{SCENE}+seed=1/neuma_structured/rollout.h5" in response
    assert not any("/data/" in file and "kernels" not in file for read in (stress, response) for file in read)


def test_networks_can_start_from_what_the_video_shows(project):
    graph = jobs(project.run("--dry-run", f"{SCENE}+seed=1/neuma+prior=identified/metrics.json"))
    made = {rule: (read, outputs) for rule, read, outputs in graph}
    read, outputs = made["identified_prior"]
    assert f"{SCENE}+seed=1/identified.json" in read
    assert outputs[0] == f"{SCENE}+seed=1/priors/identified.safetensors"
    assert all(outputs[0] in made[rule][0] for rule in ("fit_neuma", "evaluate"))
    assert "tiny/results/priors/jelly+seed=1.safetensors" in made["velocity"][0]


def test_a_method_can_start_as_identification_found(project):
    graph = jobs(project.run("--dry-run", f"{SCENE}+seed=1/neuma+start=identified/metrics.json"))
    made = {rule: (read, outputs) for rule, read, outputs in graph}
    for rule in ("fit_neuma", "evaluate"):
        assert f"{SCENE}+seed=1/identified.json" in made[rule][0]
        assert not any(file.endswith("velocity.json") for file in made[rule][0])


def test_finer_bodies_must_be_finer(project):
    for particles, accepted in {200: False, 201: True, 0: True}.items():
        settings = f"identify={{refined_particles: {particles}}}"
        output = project.run(
            "--dry-run", "--config", settings, "--", f"{SCENE}/identified.json", succeeds=accepted
        )
        refused = "identify.refined_particles: 200 must exceed geometry.particles = 200" in output
        assert refused != accepted


def test_rules_with_a_script_get_what_they_leave_out(project):
    """Fails where a Snakemake no longer reads what `workflow.defaults.complete` writes."""
    target = f"{SCENE}+seed=1/neuma/video.mp4"
    plan = project.run("--dry-run", "--set-resources", "mesh:runtime=7", "--", target)
    blocks = dict(re.findall(r"^rule (\w+):\n((?:    .*\n)*)", plan, re.MULTILINE))
    for rule, expected in {
        "video": (
            "log: tiny/results/logs/BouncyBall+seed=1/neuma/video.log",
            "benchmark: tiny/results/benchmarks/BouncyBall+seed=1/neuma/video.tsv",
            *("mem_mb=4000,", "runtime=60,", "gpu="),
        ),
        "fit_neuma": ("mem_mb=6000,", "runtime=240,"),
        "mesh": ("mem_mb=4000,", "runtime=7,"),
        "kernels": ("log: tiny/data/kernels/logs/",),
    }.items():
        assert all(text in blocks[rule] for text in expected), blocks[rule]


def test_images_are_rendered_where_the_settings_say(project):
    """On one CPU core unless a GPU or more cores are asked for; images alone, not what is computed from them."""
    images = "tiny/data/BouncyBall/static/transforms.json"
    for blender, resources in {
        "{}": "gpu=0",
        "{device: auto}": "gpu=0",
        "{device: cuda, threads: 2}": "gpu=1",
    }.items():
        told = ("device=cpu", f"dataset={{blender: {blender}}}")
        output = project.run("--dry-run", "--config", *told, "--", images)
        block = re.search(r"^rule render_static:\n(?:    .*\n)+", output, re.MULTILINE)[0]
        assert resources in block
        assert ("threads: 2" in block) == ("threads: 2" in blender)


CHAINS = ("--config", "tables={table1: {seeds: 3}}", "--")
DATA_RULES = ("kernels", "ground_truth", "render_static", "render_dynamic")


def test_three_chains_share_their_data_and_nothing_else(project):
    one, three = project.plan(TABLE), project.plan(*CHAINS, TABLE)
    shared = {*DATA_RULES, "chamfer_table", "total"}
    assert {"prior", "gaussians", "sampled_particles", "velocity", "fit_neuma", "evaluate"} <= set(one)
    assert three == {rule: count if rule in shared else 3 * count for rule, count in one.items()}
    graph = jobs(project.run("--dry-run", *CHAINS, TABLE))
    made = [file for *_, outputs in graph for file in outputs]
    assert len(made) == len(set(made))
    for rule, read, outputs in graph:
        computed = {file for file in read if file.startswith("tiny/results/")}
        if "+seed=2" in outputs[0]:
            assert all("+seed=2" in file for file in computed), (rule, computed)
        elif rule != "chamfer_table":
            assert not any("+seed=2" in file for file in computed), (rule, computed)


@pytest.mark.parametrize(
    ("drawn", "anew"),
    [
        ("adaptor", {"fit_neuma": 2}),
        ("prior", {"prior": 2, "velocity": 2, "fit_neuma": 2}),
        ("particles", {"sampled_particles": 2, "binding": 2, "velocity": 2, "fit_neuma": 2}),
        (
            "gaussians",
            dict.fromkeys(
                ["gaussians", "mesh", "tracers", "sampled_particles", "binding", "velocity", "fit_neuma"], 2
            ),
        ),
    ],
)
def test_what_varies_alone_repeats_what_depends_on_it(project, drawn, anew):
    one = project.plan(TABLE)
    three = project.plan("--config", f"tables={{table1: {{seeds: 3, vary: [{drawn}]}}}}", "--", TABLE)
    evaluations = 2 if drawn == "adaptor" else 4  # the prior's motion has no adaptor
    total = {"total": sum(anew.values()) + evaluations}
    more = {**anew, **total, "evaluate": evaluations}
    assert three == {rule: count + more.get(rule, 0) for rule, count in one.items()}


def test_an_experiment_follows_the_chains_of_its_scenes(project):
    graph = jobs(
        project.run("--dry-run", "tiny/results/experiments/letter_and_ball+seed=1/neuma/metrics.json")
    )
    read = {rule: files for rule, files, _ in graph}
    assert f"{SCENE}+seed=1/neuma/adaptor.safetensors" in read["evaluate_experiment"]
    assert "tiny/results/priors/jelly+seed=1.safetensors" in read["evaluate_experiment"]
    assert "tiny/data/experiments/letter_and_ball/truth.h5" in read["evaluate_experiment"]
    assert f"{SCENE}+seed=1/velocity.json" in read["experiment_start"]


TWO_VIDEOS = ("--config", "scenes={BouncyBall: {videos: [{velocity: [0.5, -1.0, 0.0]}]}}", "--")
THROW = f"{SCENE}_throw2"


def test_several_videos_train_one_law_which_is_judged_on_all(project):
    held_out = "neuma+law_from=BouncyBall"
    targets = (f"{SCENE}+seed=1/neuma/metrics.json", f"{THROW}+seed=1/{held_out}/metrics.json")
    graph = jobs(project.run("--dry-run", *TWO_VIDEOS, *targets, f"{SCENE}+seed=1/identified.json"))
    ((_, (adaptor, _)),) = [(read, made) for rule, read, made in graph if rule == "fit_neuma"]
    for read in (read for rule, read, _ in graph if rule in ("fit_neuma", "identify")):
        for folder in (f"{SCENE}+seed=1", f"{THROW}+seed=1"):
            for file in ("particles.h5", "binding.h5", "gaussians.ply", "velocity.json"):
                assert f"{folder}/{file}" in read
        assert {file for file in read if file.endswith("transforms.json")} == {
            "tiny/data/BouncyBall/dynamic/transforms.json",
            "tiny/data/BouncyBall_throw2/dynamic/transforms.json",
        }
    judged = {made[0]: read for rule, read, made in graph if rule == "evaluate"}
    assert len(judged) == 2 and all(adaptor in read for read in judged.values())
    refused = f"{THROW}/{held_out}/adaptor.safetensors"
    said = project.run("--dry-run", *TWO_VIDEOS, refused, succeeds=False)
    assert "it has no fit, its model is that of BouncyBall/neuma" in said


def test_identifications_behind_a_table_are_those_of_the_laws_that_its_constants_have(project):
    methods = "tables={table1: {methods: [neuma, constants, constants+law_from=BouncyBall_throw2]}}"
    plan = project.run("--dry-run", *TWO_VIDEOS[:2], methods, "--", "tiny/results/identified_table1.csv")
    (read,) = [read for rule, read, _ in jobs(plan) if rule == "identified_behind_table"]
    assert sorted(read) == [f"{SCENE}/identified.json", f"{THROW}/identified.json"]


def test_motions_of_springs_and_of_experiments_are_exported_too(project):
    files = ("gaussians", "compressed", "particles.h5", "surface.glb", "motion.blend", "motion.gif")
    moved = (f"{SCENE}/spring_gaus", f"{EXPERIMENT}/neuma", f"{EXPERIMENT}/spring_gaus")
    for folder, of_experiment in zip(moved, (False, True, True), strict=True):
        planned = project.plan(*(f"{folder}/export/{file}" for file in files))
        exports = {rule: count for rule, count in planned.items() if rule.startswith("export_")}
        kinds = ("gaussians", "particles", "surface", "blend", "film")
        prefix = "export_experiment_" if of_experiment else "export_"
        assert exports == {f"{prefix}{kind}": 2 if kind == "gaussians" else 1 for kind in kinds}
    said = project.run("-n", f"{SCENE}/pac_nerf_own/export/gaussians", succeeds=False)
    assert "it is evaluated on particles of its own fit" in said and "Choose pac_nerf" in said
