"""Figures are drawn from their data in print quality. Particles, crops and tests of material points are correct."""

import ast
import json
import re
from importlib import import_module
from itertools import combinations
from pathlib import Path
from types import SimpleNamespace

import matplotlib
import numpy as np
import pytest
import torch
import yaml
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.text import Text
from matplotlib.textpath import TextPath
from PIL import Image

from neuma_lib.evaluation.calibration import LEVELS
from neuma_lib.evaluation.material_point import Visited, largest_shear_stress, sheared, uniaxial, yielding
from neuma_lib.evaluation.plotting import style
from neuma_lib.evaluation.plotting.rendering import cropped, evenly, frontal, magnified
from neuma_lib.evaluation.plotting.spheres import draw_spheres
from neuma_lib.mechanics.analytic import analytic_law
from neuma_lib.methods.registry import built_in_presets
from neuma_lib.paper.figures import ablation_gradients, ch_dist_curve, image_quality, material_response
from neuma_lib.paper.figures.lora_alphav import monotone_frames
from neuma_lib.paper.image_grid import TITLE, ImageGrid, broken, load_image_grid, save_image_grid
from neuma_lib.splatting.cameras import Cameras
from tests.support.errors import refused

ROOT = Path(__file__).resolve().parents[2]
SETTINGS = yaml.safe_load((ROOT / "config/config.yaml").read_text())
METHODS = [name for name in style.METHODS if name in SETTINGS["tables"]["table1"]["methods"]]
TITLES = {method: f"NeuMA {method[6:]}" for method in METHODS}
RESPONDING = ["nclaw", "neuma", "constants", "neuma_structured"]
SCENES = ["BouncyBall", "JellyDuck", "RubberPawn", "ClayCat", "SandFish", "HoneyBottle"]


def pictures(rows: int, columns: int, numbers: dict, row_titles=None, column_titles=None) -> ImageGrid:
    """Coloured discs on white."""
    generator = np.random.default_rng(0)
    y, x = np.mgrid[:60, :48]
    images = np.full((rows, columns, 60, 48, 3), 255, dtype=np.uint8)
    for row in images:
        for image in row:
            image[(x - 24) ** 2 + (y - 40) ** 2 < 200] = generator.integers(0, 200, 3)
    return ImageGrid(
        images,
        tuple(row_titles or (f"NeuMA w/o {i}" for i in range(rows))),
        tuple(column_titles or (f"{64 * j} ms" for j in range(columns))),
        numbers,
    )


def curves(count: int = 20) -> list[float]:
    return (0.1 + np.abs(np.random.default_rng(count).standard_normal(count)).cumsum()).tolist()


def cells(low: float, high: float, methods, scenes) -> dict:
    generator = np.random.default_rng(1)
    return {m: {s: float(generator.uniform(low, high)) for s in scenes} for m in methods}


def response() -> dict:
    x = np.linspace(-0.2, 0.2, 9).tolist()
    band = {"x": x[::2], "low": [-1.0] * 5, "high": [1.0] * 5, "inside": 0.5}
    laws = {
        law: {"stress": curves(9), "band": band if law in ("constants", "neuma_structured") else None}
        for law in RESPONDING
    }
    test = {"x": x, "visited": [-0.1, 0.1], "by_stress": False, "true": curves(9), "laws": laws}
    return {
        "uniaxial": test,
        "shear": test,
        "yield": {**test, "x": np.linspace(0, 0.6, 9).tolist(), "by_stress": True},
    }


DATA = {
    "ch_dist_curve": lambda: {
        "titles": TITLES,
        "scenes": {
            scene: {
                "time": np.linspace(0, 0.25, 20).tolist(),
                "floor": [0.1] * 20,
                "rmse": {method: curves() for method in METHODS},
                "chamfer": {method: curves() for method in METHODS},
            }
            for scene in SCENES
        },
    },
    "image_quality": lambda: {
        "titles": TITLES,
        "scenes": SCENES,
        "seen": SCENES[1:3],
        "psnr": cells(20, 35, METHODS, SCENES),
        "ssim": cells(0.8, 1, METHODS, SCENES),
        "lpips_vgg": cells(0, 0.2, METHODS, SCENES),
        "lpips_alex": cells(0, 0.2, METHODS, SCENES),
    },
    "main_res": lambda: pictures(6, 15, {"groups": [(scene, 5) for scene in SCENES[:3]]}),
    "particles_app": lambda: pictures(6, 8, {}),
    "lora_alphav": lambda: pictures(
        6,
        7,
        {
            "weights": [0, 0.25, 0.5, 0.75, 1, 1.25],
            "scenes": {
                s: {"rows": 3, "time": [0, 0.1, 0.2], "heights": [[3, 2, 1]] * 6, "truth": [3, 2, 2]}
                for s in SCENES[:2]
            },
        },
        row_titles=["64 ms", "128 ms", "256 ms"] * 2,
        column_titles=[*(f"$w$ = {w / 4:g}" for w in range(6)), "observed"],
    ),
    "vis_generalize": lambda: pictures(
        6,
        7,
        {"letters": 4, "materials": [*SCENES, SCENES[0]], "times": [f"{i} ms" for i in range(7)]},
        row_titles=["67 % of\nthe sequence"] * 4
        + [SETTINGS["experiments"][name]["title"] for name in SETTINGS["figures"]["meetings"]],
        column_titles="NEURIPS",
    ),  # fmt: skip
    "ext_time": lambda: pictures(
        3,
        9,
        {
            "observed": 0.25,
            "time": np.linspace(0, 0.75, 20).tolist(),
            "titles": {"truth": "Truth", "nclaw": "NCLaw", "neuma": "NeuMA"},
            "heights": {"truth": curves(), "nclaw": curves(), "neuma": curves()},
        },
    ),
    "i23d": lambda: pictures(
        6,
        6,
        {"laws": 3, "diverged": [2]},
        row_titles=[
            f"{splat}, {law}"
            for splat in ("Guitar", "Chair")
            for law in ("JellyDuck", "ClayCat", "HoneyBottle")
        ],
        column_titles=[f"{100 * i} ms" for i in range(6)],
    ),
    "realworld": lambda: pictures(
        6,
        7,
        {
            "scenes": ["demo_cat_first", "demo_duck_first"],
            "measures": [[[21.3, 0.123], [27.9, 0.071]], [[19.0, 0.2], [30.0, 0.05]]],
            "times": [[f"{50 * i} ms" for i in range(7)]] * 2,
        },
        row_titles=["video", "Spring-Gaus", "NeuMA"] * 2,
        column_titles=[str(i) for i in range(7)],
    ),
    "obstacles": lambda: pictures(
        3,
        4,
        {"times": [[f"{150 * i} ms" for i in range(4)]] * 3},
        row_titles=["JellyStair", "ClayPress", "SandGlass"],
        column_titles=[""] * 4,
    ),
    "pile": lambda: pictures(
        4,
        5,
        {},
        row_titles=["filmed", "understood", "one taken out", "true laws"],
        column_titles=[f"{100 * i} ms" for i in range(5)],
    ),
    "stills": lambda: pictures(
        3,
        3,
        {},
        row_titles=["Mold Star beam\nclamp 7 cm\nμ/ρ 93 m²/s²\n1.1 px, IoU 0.970"] * 3,
        column_titles=["Photograph", "Prediction", "Difference"],
    ),
    "gradient_analysis": lambda: {
        scene: {
            "norms": {"elastic": curves(50), "plastic": curves(50)},
            "change": {"elastic": 0.1, "plastic": 0.02},
            "wrong": "elastic and plastic",
        }
        for scene in ("BouncyBall", "RubberPawn")
    },
    "uneven_mass": lambda: pictures(
        4,
        5,
        {
            "rows": {"neuma": 2, "neuma+assumed_density=1000": 3},
            "rmse": {"neuma": 3.0, "neuma+assumed_density=1000": 20.0},
            "chamfer": {"neuma": 0.3, "neuma+assumed_density=1000": 2.0},
            "floor": 0.1,
        },
        row_titles=["Observation", "NCLaw", *SETTINGS["tables"]["uneven_mass"]["titles"].values()],
    ),  # fmt: skip
    "pipeline": lambda: pictures(
        5,
        5,
        {"first": ["views", "Gaussians", "surface", "particles", "binding"], "heads": ["text"] * 5},
        row_titles=["I\ninitial\nstate", "II\nsimulation", "III\nrendering", "\nobservation", "\ndifference"],
    ),  # fmt: skip
    "material_response": lambda: {
        "titles": {law: built_in_presets().get(law, {"title": law})["title"] for law in RESPONDING},
        "scenes": {scene: response() for scene in SCENES},
    },
    "reliability": lambda: {
        quantity: {
            method: {
                f"covered{end}": [min(1, max(0, scale * level + shift)) for level in LEVELS]
                for end, shift in (("", 0), ("_low", -0.1), ("_high", 0.1))
            }
            for method, scale in (("calibrated", 1), ("Laplace", 0.1), ("fixed 10 %", 0.6))
        }
        for quantity in ("constants", "contact_friction", "another launch")
    },
    "random_scenes": lambda: {
        "titles": ["NCLaw", "NeuMA"],
        "families": {
            family: {f"random7_0{k}_ball_{family}": [[10.0 * (k + 1), 5.0], k == 2]}
            for k, family in enumerate(SETTINGS["random"]["families"])
        },
    },
    "ablation_gradients": lambda: {
        "scenes": SCENES[:3],
        "titles": {"a": "NeuMA", "b": "gradients not zeroed"},
        "seen": SCENES[:1],
        **{name: cells(0, 1, "ab", SCENES) for name in ablation_gradients.MEASURES},
    },
}


def drawn(name: str) -> Figure:
    return import_module(f"neuma_lib.paper.figures.{name}").draw(DATA[name]())


@pytest.mark.parametrize("name", DATA)
def test_figure_is_ready_for_print(name):
    figure = drawn(name)
    width, height = figure.get_size_inches()
    assert width in (style.PAGE, style.COLUMN) and height < 9
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    assert len(np.unique(np.asarray(canvas.buffer_rgba())[..., 1])) > 10  # not empty
    texts = [t for t in figure.findobj(Text) if t.get_text().strip() and t.get_visible()]
    assert texts and min(text.get_fontsize() for text in texts) >= 6
    ticks = {
        label
        for axes in figure.axes
        for axis in (axes.xaxis, axes.yaxis)
        for label in [*axis.get_ticklabels(which="both"), axis.offsetText]
    }
    for text in set(texts) - ticks:
        box, page = text.get_window_extent(canvas.get_renderer()), figure.bbox
        inside = box.x0 > -1 and box.y0 > -1 and box.x1 < page.x1 + 1 and box.y1 < page.y1 + 1
        assert inside, f"{name}: '{text.get_text()}' leaves the page"


@pytest.mark.parametrize("name", ["ablation_gradients", "uneven_mass"])
def test_same_data_same_bytes(name, tmp_path):
    """Also under other settings of matplotlib, in the resolution of print; nothing but the figure is written."""
    style.save(drawn(name), tmp_path / "a.png", tmp_path / "a.pdf")
    with matplotlib.rc_context({"font.size": 30, "lines.linewidth": 9}):
        style.save(drawn(name), tmp_path / "b.png", tmp_path / "b.pdf")
    for kind in ("png", "pdf"):
        assert (tmp_path / f"a.{kind}").read_bytes() == (tmp_path / f"b.{kind}").read_bytes()
    assert (tmp_path / "a.pdf").read_bytes().startswith(b"%PDF")
    with Image.open(tmp_path / "a.png") as image:
        assert image.width == round(style.PAGE * style.DPI)
    assert len(list(tmp_path.iterdir())) == 4


def test_every_figure_has_caption_rule_and_test():
    rules = (ROOT / "workflow/rules/figure_table.smk").read_text()
    listed = set(re.findall(r'^    (?:"|\*\*of_each_method\(")(\w+)"(?:: \{|, \w+\),)$', rules, re.MULTILINE))
    listed |= set(re.findall(r'^    FIGURES\["(\w+)"\] = \{$', rules, re.MULTILINE))
    modules = [path for path in (ROOT / "neuma_lib/paper/figures").glob("*.py") if path.stem != "__init__"]
    assert {path.stem for path in modules} == listed == set(DATA)
    for path in modules:
        caption = ast.get_docstring(ast.parse(path.read_text()))
        assert re.search(r"Paper: fig:\w+|Not in the paper", " ".join(caption.split())), path.stem


# ---- numbers from results


def results(folder: Path, name: str, content) -> list[str]:
    """JSON files of two methods on two scenes, method by method; `content` gives that of one from its number."""
    files = [folder / f"{name}{k}.json" for k in range(4)]
    for k, file in enumerate(files):
        file.write_text(json.dumps(content(k)))
    return [str(file) for file in files]


def test_every_number_is_of_its_method_and_scene(tmp_path):
    titles, scenes = {"nclaw": "NCLaw", "neuma": "NeuMA"}, ["A", "B"]
    motion = results(
        tmp_path,
        "motion",
        lambda k: {
            "frames": [0, 2],
            "chamfer_per_frame": [k, 10 * k],
            "chamfer_floor_per_frame": [k / 10, k],
            "tracer_rmse_mm_per_frame": [k, k + 1],
            "chamfer": k + 0.1,
            "tracer_rmse_mm": k + 0.2,
        },
    )
    images = results(
        tmp_path,
        "images",
        lambda k: (
            {m: k + len(m) for m in image_quality.MEASURES} | {"views_seen_in_training": [0] * (k == 3)}
        ),
    )
    histories = results(tmp_path, "history", lambda k: {"loss": [4.0, 1.0], "best_loss": 4.0 * k})

    messages = []
    curves = ch_dist_curve.data(
        SimpleNamespace(metrics=motion),
        SimpleNamespace(titles=titles, scenes={"A": 0.5, "B": 0.25}),
        messages.append,
    )
    assert curves["titles"] == titles
    assert curves["scenes"]["B"] == {
        "time": [0.0, 0.5],
        "floor": [0.1, 1],
        "rmse": {"nclaw": [1, 2], "neuma": [3, 4]},
        "chamfer": {"nclaw": [1, 10], "neuma": [3, 30]},
    }
    params = SimpleNamespace(titles=titles, scenes=scenes)
    quality = image_quality.data(SimpleNamespace(metrics=images), params, messages.append)
    assert quality["seen"] == ["B"], "a method has no other view of it"
    assert quality["ssim"] == {"nclaw": {"A": 4, "B": 5}, "neuma": {"A": 6, "B": 7}}
    assert quality["titles"] == titles
    files = [json.loads(Path(file).read_text()) for file in images]
    for name, file in zip(images, files, strict=True):  # NeuMA now trains on all views
        Path(name).write_text(json.dumps({**file, "views_seen_in_training": [1] if file["ssim"] > 5 else []}))
    quality = image_quality.data(SimpleNamespace(metrics=images), params, messages.append)
    assert quality["titles"] == {**titles, "neuma": "NeuMA (training views)"} and quality["seen"] == []
    choices = ablation_gradients.data(
        SimpleNamespace(histories=histories, metrics=motion, image_metrics=images), params, messages.append
    )
    assert choices["loss"] == {"nclaw": {"A": 0, "B": 1}, "neuma": {"A": 2, "B": 3}}
    assert choices["tracer_rmse_mm"]["neuma"] == {"A": 2.2, "B": 3.2}
    assert choices["psnr"]["nclaw"] == {"A": 4, "B": 5}
    assert len(messages) == 4


def test_responses_are_of_their_law_and_bands_of_all_replicates(tmp_path):
    def content(k):
        test = {"x": [0, 1, 2], "visited": [0, 2], "by_stress": False, "true": [0, 1, 2], "stress": [k, k, k]}
        band = {"x": [0, 2], "low": [-k, -k], "high": [k, k]}
        return dict.fromkeys(material_response.TESTS, test if k < 2 else {**test, "band": band})

    files = results(tmp_path, "response", content)
    params = SimpleNamespace(
        titles={"neuma": "NeuMA", "constants": "Constants"}, cells=[["A", "neuma", 2], ["A", "constants", 2]]
    )
    messages = []
    result = material_response.data(SimpleNamespace(responses=files), params, messages.append)
    laws = result["scenes"]["A"]["shear"]["laws"]
    assert laws["neuma"]["stress"] == [0, 0, 0] and laws["constants"]["stress"] == [2, 2, 2]
    assert (laws["neuma"]["band"]["low"], laws["neuma"]["band"]["high"]) == ([0, 0, 0], [1, 1, 1])
    assert (laws["constants"]["band"]["low"], laws["constants"]["band"]["high"]) == ([-3, -3], [3, 3])
    assert (
        laws["neuma"]["band"]["inside"] == pytest.approx(2 / 3) and laws["constants"]["band"]["inside"] == 1
    )
    assert messages[1] == "Constants: the truth is inside 3 of 3 bands everywhere"
    alone = SimpleNamespace(titles={"neuma": "NeuMA"}, cells=[["A", "neuma", 1]])
    result = material_response.data(SimpleNamespace(responses=files[:1]), alone, messages.append)
    assert result["scenes"]["A"]["yield"]["laws"]["neuma"]["band"] is None


# ---- style


def test_every_method_has_its_look():
    drawn = {name for name, preset in built_in_presets().items() if preset["same_fit_as"] is None}
    assert drawn <= set(style.METHODS)
    for part in ("color", "marker"):
        looks = [getattr(kind, part) for kind in style.METHODS.values()]
        assert len(set(looks)) == len(looks)
    assert style.look("neuma+rank=4") == style.look("neuma")
    assert style.look("somebody_else").color == style.GREY


# Machado, Oliveira and Fernandes (2009), complete dichromacy.
DEUTERANOPIA = [
    [0.367322, 0.860646, -0.227968],
    [0.280085, 0.672501, 0.047413],
    [-0.011820, 0.042940, 0.968881],
]
PROTANOPIA = [
    [0.152286, 1.052583, -0.204868],
    [0.114503, 0.786281, 0.099216],
    [-0.003882, -0.048116, 1.051998],
]


@pytest.mark.parametrize(
    "eyes", [np.eye(3), DEUTERANOPIA, PROTANOPIA], ids=["all", "deuteranopia", "protanopia"]
)
def test_methods_differ_in_colour_for_any_colour_vision(eyes):
    from skimage.color import rgb2lab

    colours = {
        m: rgb2lab(np.clip(np.asarray(eyes) @ to_rgb(kind.color), 0, 1)) for m, kind in style.METHODS.items()
    }
    for a, b in combinations(colours, 2):
        assert np.linalg.norm(colours[a] - colours[b]) > 12, (a, b)


# ---- pictures


CAMERA = Cameras(torch.eye(4)[None], torch.tensor([[[100.0, 0, 32], [0, 100, 24], [0, 0, 1]]]), 64, 48)


def spheres(points, colors, radius=0.1):
    K, viewmat = CAMERA.Ks[0].numpy(), CAMERA.viewmats[0].numpy()
    return draw_spheres(np.array(points, float), np.array(colors, float), radius, viewmat, K, 64, 48)


def test_sphere_has_projected_position_and_size():
    image = spheres([[0.1, -0.05, 1.0]], [0, 0, 0])
    rows, columns = np.nonzero((image < 128).all(-1))
    assert abs(columns.mean() + 0.5 - 42) < 0.3 and abs(rows.mean() + 0.5 - 19) < 0.3
    assert len(rows) == pytest.approx(np.pi * 10**2, rel=0.05)


def test_near_spheres_hide_far_ones_in_any_order():
    red, blue = [1.0, 0, 0], [0, 0, 1.0]
    for order in (1, -1):
        image = spheres([[0, 0, 1.0], [0, 0, 1.5]][::order], [red, blue][::order])
        assert image[24, 32, 0] > 60 and image[24, 32, 2] < 10


def test_picture_without_visible_spheres_is_white():
    assert (spheres(np.zeros((0, 3)), [0, 0, 0]) == 255).all()
    assert (spheres([[0, 0, -1.0]], [0, 0, 0]) == 255).all()


def test_magnified_cameras_scale_projections():
    points = torch.tensor([[0.1, 0.2, 1.0], [-0.2, 0.1, 2.0]])
    large = magnified(CAMERA, 3)
    assert (large.width, large.height) == (192, 144)
    assert torch.allclose(large.project(points)[0], 3 * CAMERA.project(points)[0])


def test_frontal_camera_sees_all_points():
    points = np.random.default_rng(0).uniform(0.2, 0.8, (50, 3))
    pixels, depth = frontal(points, 80, 60).project(torch.from_numpy(points).float())
    assert (
        (pixels >= 0).all()
        and (pixels[..., 0] < 80).all()
        and (pixels[..., 1] < 60).all()
        and (depth > 0).all()
    )


def test_crops_have_one_size_and_lose_nothing():
    small, large = np.full((2, 40, 50, 3), 255, np.uint8), np.full((3, 60, 50, 3), 255, np.uint8)
    small[0, 30:39, 2:12] = 0
    large[:, 5:55, 20:30] = 0
    cut = cropped([small, large])
    assert cut[0].shape[1:] == cut[1].shape[1:]
    for before, after in zip((small, large), cut, strict=True):
        where = [np.argwhere(images < 255) for images in (before, after)]
        assert (where[0] - where[0][0] == where[1] - where[1][0]).all()  # moved as a whole


def test_wide_row_titles_are_wrapped():
    title = "NeuMA, 1000 kg/m³ assumed\neverywhere"
    lines = broken(title, 1.0).split("\n")
    assert len(lines) > 2 and " ".join(lines).split() == title.split()
    assert max(TextPath((0, 0), line, size=TITLE).get_extents().width for line in lines) <= 72
    assert broken(title, 9.0) == title
    assert broken("unbreakable", 0.1) == "unbreakable"


def test_monotone_frames_are_counted_where_motions_differ():
    heights = [[1.0, 3.0, 1.0, 5.0], [1.0, 2.0, 2.0, 4.0], [1.0, 1.0, 1.5, 4.0]]
    assert monotone_frames(heights) == (2, 3)
    assert monotone_frames(heights[::-1]) == (2, 3)


def test_evenly_keeps_the_ends():
    assert evenly(5, 33) == [0, 8, 16, 24, 32]
    assert evenly(5, 3) == [0, 1, 2]


def test_image_grid_is_written_and_read(tmp_path):
    grid = pictures(2, 3, {"weights": [0.5], "name": "ΔM"})
    save_image_grid(tmp_path / "a.h5", grid)
    again = load_image_grid(tmp_path / "a.h5")
    assert (again.images == grid.images).all()
    assert (again.rows, again.columns, again.numbers) == (grid.rows, grid.columns, grid.numbers)
    with refused("images"):
        ImageGrid(grid.images, ("one",), grid.columns)


# ---- tests of material points

E, NU, YIELD = 1e5, 0.3, 2e3
MU = E / (2 * (1 + NU))
HENCKY = {"elasticity": {"name": "hencky", "E": E, "nu": NU}}
MISES = {**HENCKY, "plasticity": {"name": "von_mises", "yield_stress": YIELD}}


@pytest.mark.parametrize("name", ["hencky", "neo_hookean", "fixed_corotated", "stvk"])
def test_small_uniaxial_stretch_follows_youngs_modulus(name):
    law = analytic_law({"elasticity": {"name": name, "E": E, "nu": NU}})
    strain = torch.tensor([-1e-4, 0.0, 1e-4], dtype=torch.float64)
    assert torch.allclose(uniaxial(law, 1 + strain), E * strain, rtol=2e-3, atol=1e-3)


def test_large_uniaxial_stretch_of_hencky_is_closed_form():
    stretch = torch.tensor([0.6, 1.5, 2.0], dtype=torch.float64)
    assert torch.allclose(uniaxial(analytic_law(HENCKY), stretch), E * stretch.log(), rtol=1e-5)


def test_small_shear_follows_the_shear_modulus():
    shear = torch.tensor([-1e-4, 1e-4], dtype=torch.float64)
    assert torch.allclose(sheared(analytic_law(HENCKY), shear), MU * shear, rtol=1e-3)


def test_yielding_ends_on_the_plateau():
    stress = yielding(analytic_law(MISES), rate=20.0, dt=5e-4, steps=60)
    shear = 20.0 * 5e-4 * torch.arange(61, dtype=torch.float64)
    elastic = shear < 0.9 * YIELD / 2**0.5 / MU
    assert torch.allclose(stress[elastic], MU * shear[elastic], rtol=1e-2)
    assert stress[-1] == pytest.approx(YIELD / 2**0.5, rel=2e-2)


def test_visited_range_of_known_states():
    gamma = 0.3
    F = torch.eye(3).repeat(1000, 1, 1)
    F[:, 0, 1] = gamma
    seen = Visited.of(F)
    assert seen.shear == pytest.approx((-gamma, gamma), rel=1e-4)
    assert seen.stretch[0] * seen.stretch[1] == pytest.approx(
        1.0, rel=1e-4
    ) and seen.pressed == pytest.approx(1.0)
    F = torch.eye(3).repeat(10, 1, 1)
    F[:, 0, 1] = 1e-3
    assert largest_shear_stress(analytic_law(HENCKY), F) == pytest.approx(MU * 1e-3, rel=1e-2)
