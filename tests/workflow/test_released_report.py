"""A capture in the layout of Spring-Gaus, from its folder to the report and the figure, by real Snakemake runs."""

import json

import pytest

from tests.support.project import copied, overlay
from tests.support.released_layouts import write_spring_gaus

PAGE, FIGURE = "tiny/results/bun/neuma/report.html", "tiny/results/figures/realworld.png"


@pytest.mark.slow
def test_a_released_capture_goes_to_its_report_and_into_the_figure(tmp_path, kernels):
    pytest.importorskip("cv2")
    pytest.importorskip("pymeshlab")
    made = copied(tmp_path / "project", kernels)
    write_spring_gaus(tmp_path / "real_capture")
    released = {"bun": {"folder": str(tmp_path / "real_capture")}}
    settings = overlay(captures={"released": released}, advanced={"photographs.longest": 64})
    made.run(*settings, PAGE, FIGURE)
    page = (made.root / PAGE).read_text()
    assert "10 photographs, 1 take, 3 cameras" in page and "Warnings" in page
    assert (made.root / FIGURE).stat().st_size > 10_000
    results = made.root / "tiny/results"
    placed = json.loads((results / "bun_first/registration.json").read_text())
    # The drawn ellipsoid was photographed in a world of another scale, and falls as bodies do in metres.
    assert min(camera["iou"] for camera in placed["after"].values()) > 0.9
    assert abs(placed["gravity_ratio"] - 1) < 0.03 + 2 * placed["gravity_ratio_deviation"] < 0.2
    for method in ("spring_gaus", "neuma"):
        measures = json.loads((results / f"bun_first/{method}/views/C0733.json").read_text())
        assert measures["mean"]["psnr"] > 20
