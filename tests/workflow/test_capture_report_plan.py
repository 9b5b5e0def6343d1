"""The report of a capture: what it asks for, with takes that are learned from and takes that are held out."""

import re

import pytest

from tests.support.project import copied

SETTINGS = "board: {square: 0.03}\nheld_out: [two]\n"
REPORT = "tiny/results/mug/{method}/report.html"


@pytest.fixture(scope="module")
def project(tmp_path_factory, kernels):
    """A capture with three takes of two cameras, one of them held out; nothing runs, so files are empty."""
    made = copied(tmp_path_factory.mktemp("report") / "project", kernels)
    root = made.root / "captures/mug"
    videos = [
        f"videos/{take}/{camera}.mp4" for take in ("one", "two", "three") for camera in ("left", "right")
    ]
    for name in ("photos/a.jpg", "stills/left.png", "stills/right.png", *videos):
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).touch()
    (root / "capture.yaml").write_text(SETTINGS)
    return made


@pytest.fixture(scope="module")
def plan(project):
    return project.plan(
        *(REPORT.format(method=method) for method in ("neuma_structured", "nclaw", "constants"))
    )


def test_the_report_plans_every_stage_once(plan):
    planned = plan.behind(REPORT.format(method="neuma_structured"))
    once = ("poses", "room", "photograph_masks", "curves", "images", "report")
    takes = ("flight", "registration", "video", "display")
    expected = {f"capture_{name}": 1 for name in once} | {f"capture_{name}": 3 for name in takes}
    expected |= {"capture_frames": 6, "capture_video_masks": 6}
    expected |= {"predict": 9, "capture_view": 18}  # the prior, the constants, and the law
    expected |= dict.fromkeys(
        ("gaussians", "mesh", "sampled_particles", "binding", "prior", "fit_structured"), 1
    )
    assert expected.items() <= planned.items(), planned
    assert not planned.keys() & {"ground_truth", "evaluate", "velocity", "tracers", "image_metrics"}
    # Constants begin where identification found: in each video that the law is learned from, and in none held out.
    assert planned["identify_views"] == 2


def test_a_held_out_take_has_the_law_of_the_others_and_the_start_of_its_flight(plan):
    fit = plan.behind(REPORT.format(method="neuma_structured")).one("fit_structured")
    law = "tiny/results/mug_one/neuma_structured/adaptor.safetensors"
    assert law in fit.outputs
    videos = [file for file in fit.inputs if file.endswith("dynamic/transforms.json")]
    assert videos == [
        "tiny/data/mug_one/dynamic/transforms.json",
        "tiny/data/mug_three/dynamic/transforms.json",
    ]
    for take, start in (("two", "velocity"), ("three", "identified\\+views=0,1")):
        read = plan.makers[f"tiny/results/mug_{take}/neuma_structured+law_from=mug_one/rollout.h5"].inputs
        assert law in read and any(re.search(f"mug_{take}/{start}.json$", file) for file in read)
    assert not any("mug_two/" in file for file in fit.inputs)


def test_reports_of_the_prior_and_the_constants_train_nothing(plan):
    planned = plan.behind(*(REPORT.format(method=method) for method in ("nclaw", "constants")))
    assert not any(rule.startswith("fit_") for rule in planned)
    assert planned["capture_report"] == 2 and planned["predict"] == 6


def test_what_cannot_be_reported_is_refused(project):
    def refusal(target):
        return project.run("--dry-run", target, succeeds=False)

    output = refusal("tiny/results/mug_one/neuma/views/top.mp4")
    assert "filmed by left, right, and by no camera 'top'" in output
    settings = project.root / "captures/mug/capture.yaml"
    settings.write_text(SETTINGS.replace("two", "two, one, three"))
    try:
        assert "capture.yaml: held_out: all takes are held out" in refusal(REPORT.format(method="neuma"))
    finally:
        settings.write_text(SETTINGS)
