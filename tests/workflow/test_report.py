"""`snakemake --report`: one HTML file that shows figures, tables and captions in a real browser."""

import ast
import re
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from tests.support.project import ROOT, copied

pytestmark = pytest.mark.slow

BROWSER = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
FIGURES = ("main_res", "gradient_analysis", "material_response")
TARGETS = ["tiny/results/table1.csv", *(f"tiny/results/figures/{name}.png" for name in FIGURES)]

# Clicks on elements in turn: a menu entry by its text, or the first (show) or second (about) button of a row.
CLICKS = """<script>addEventListener("load", () => {
const steps = STEPS;
const next = () => {
  const step = steps.shift();
  if (!step) return;
  const [text, button] = step;
  let place = [...document.querySelectorAll("*")].find(e => !e.children.length && e.textContent.trim() == text);
  while (place && button != null && place.querySelectorAll("a").length < 2) place = place.parentElement;
  (button == null ? place.closest("a") : place.querySelectorAll("a")[button]).click();
  setTimeout(next, 700);
};
setTimeout(next, 700);
});</script>"""


@pytest.fixture(scope="module")
def project(tmp_path_factory, kernels):
    """A small run."""
    project = copied(tmp_path_factory.mktemp("project"), kernels)
    project.run(*TARGETS)
    return project


def test_an_edit_of_a_figure_repeats_this_figure_and_that_of_a_caption_none(project):
    figures = project.root / "neuma_lib/paper/figures"
    texts = {figures / f"{name}.py": (figures / f"{name}.py").read_text() for name in FIGURES[:2]}
    caption, code = texts
    caption.write_text(texts[caption].replace('"""', '"""Another caption. ', 1))
    code.write_text(texts[code] + "\nEDITED = True\n")
    assert project.plan(*TARGETS) == {FIGURES[1]: 1}
    for file, text in texts.items():
        file.write_text(text)


@pytest.fixture(scope="module")
def report(project):
    """Its report."""
    if BROWSER is None:
        pytest.skip("no browser: apt-get install chromium")
    project.run("--report", "report.html", "--", *TARGETS)
    return project.root / "report.html"


def browse(report: Path, steps: str, *options: str) -> str:
    """Open the report, click, and run the browser with further options; its output."""
    before, after = report.read_text().rsplit("</body>", 1)
    page = report.with_name("clicked.html")
    page.write_text(f"{before}{CLICKS.replace('STEPS', steps)}</body>{after}")
    command = [BROWSER, "--headless=new", "--no-sandbox", "--disable-gpu", "--hide-scrollbars"]
    command += ["--window-size=1500,1000", "--virtual-time-budget=8000", *options, page.as_uri()]
    return subprocess.run(command, capture_output=True, text=True, timeout=120, check=True).stdout


def test_report_lists_figures_and_tables(report):
    page = browse(report, '[["Figures", null]]', "--dump-dom")
    text = re.sub(r"<script.*?</script>", "", page, flags=re.DOTALL)
    assert all(name in text for name in FIGURES)
    text = re.sub(
        r"<script.*?</script>", "", browse(report, '[["Tables", null]]', "--dump-dom"), flags=re.DOTALL
    )
    assert "table1" in text


def test_report_shows_a_figure_with_its_caption(report):
    picture = report.with_name("screen.png")
    steps = '[["Figures", null], ["main_res", 1], ["Figures", null], ["main_res", 0]]'
    browse(report, steps, f"--screenshot={picture}")
    screen = np.asarray(Image.open(picture).convert("RGB"))
    content = screen[:, 420:]
    assert (content < 200).any(-1).mean() > 0.005  # the figure is there, not an empty page
    page = browse(report, '[["Figures", null], ["main_res", 1]]', "--dump-dom")
    text = re.sub(r"<script.*?</script>", "", page, flags=re.DOTALL)
    module = ast.parse((ROOT / "neuma_lib/paper/figures/main_res.py").read_text())
    caption = ast.get_docstring(module).split(":")[0]
    assert caption in " ".join(text.split())
