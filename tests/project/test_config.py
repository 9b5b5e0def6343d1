"""Settings: errors name keys, variants and replicates name folders, the documentation follows the types."""

import json
import subprocess
import sys
from contextlib import contextmanager
from pathlib import Path

import pytest

from neuma_lib.config.base import Section
from neuma_lib.config.variants import SEEDS, parse_replicate, replicate_folder
from neuma_lib.errors import InputError
from neuma_lib.project import cases, loading
from neuma_lib.project.page import PAGE, SCHEMA, settings_markdown, settings_schema
from neuma_lib.project.settings import Config
from tests.support.errors import refused

pytestmark = pytest.mark.core

ROOT = Path(__file__).resolve().parents[2]


def test_default_settings_are_valid(loaded):
    assert loaded.tables["table1"].scenes[0] == "BouncyBall"
    assert loaded.dataset.particles >= 4 * loaded.geometry.particles
    assert loaded.dataset.seed != loaded.seed


@pytest.mark.parametrize(
    "files", [(), ("studies/three_chains.yaml",), ("paper.yaml",), ("paper.yaml", "studies/paper_light.yaml")]
)
def test_images_are_measured_in_at_least_two_views_that_training_does_not_see(raw, files):
    for file in files:
        raw = loading.merged(raw, loading.read_yaml(ROOT / "config" / file))
    chosen = loading.load(raw, ROOT)
    assert chosen.dataset.dynamic.views - len(chosen.training.views) >= 2


@contextmanager
def first_refused(place):
    """The first of the problems, of which scenes that are `like` another one repeat some, is at a place."""
    with pytest.raises(InputError) as caught:
        yield
    assert caught.value.where == place, caught.value


MISTAKES = [
    ({"trianing": {}}, "trianing"),
    ({"training": {"lr_elastc": 1}}, "training.lr_elastc"),
    ({"training": {"iterations": "many"}}, "training.iterations"),
    ({"training": {"rank": 0}}, "training.rank"),
    ({"binding": {"confidence": 95}}, "binding.confidence"),
    ({"dataset": {"static": {"veiws": 3}}}, "dataset.static.veiws"),
    ({"scenes": {"BouncyBall": {"hieght": 1}}}, "scenes.BouncyBall.hieght"),
    ({"scenes": {"BouncyBall": {"prior": "jely"}}}, "scenes.BouncyBall.prior"),
    ({"scenes": {"BouncyBall": {"training": {"lr": 1}}}}, "scenes.BouncyBall.training.lr"),
    ({"methods": {"neuma": {"options": {"rnk": 4}}}}, "methods.neuma.options.rnk"),
    ({"tables": {"table1": {"scenes": ["BouncyBal"]}}}, "tables.table1.scenes"),
    ({"tables": {"table1": {"methods": ["neuma+rnk=4"]}}}, "tables.table1"),
    ({"tables": {"table1": {"vary": ["particle"]}}}, "tables.table1.vary.0"),
    ({"tables": {"table1": {"scenes": ["BouncyBall+seed=1"]}}}, "tables.table1.scenes"),
    ({"methods": {"neuma+x": {"title": "x", "kind": "neuma"}}}, "methods.neuma+x"),
    (
        {"experiments": {"ClayCat": {"title": "x", "bodies": [{"scene": "ClayCat"}], "steps": 9}}},
        "experiments.ClayCat",
    ),
    ({"scenes": {"New": {"shape": "ball"}}}, "scenes.New.height"),
    ({"dataset": {"stride": 4}}, "dataset"),
    ({"dataset": {"frames": None}}, "dataset"),
    ({"evaluation": {"tracers": 5}}, "evaluation.tracers"),
    ({"seed": 1000}, "dataset.seed"),
    ({"dataset": {"seed": -1}}, "dataset.seed"),
    ({"dataset": {"seed": 1}, "tables": {"table2": {"seeds": 4}}}, "dataset.seed"),
    ({"scenes": {"BouncyBall": {"images": {"video": "x"}}}}, "scenes.BouncyBall.images.video"),
    ({"gaussians": {"densification": {"evry": 3}}}, "gaussians.densification.evry"),
    ({"priors": {"regression": {"iteration": 3}}}, "priors.regression.iteration"),
    ({"priors": {"laws": {"jelly": {"elasticity": {"E": "stiff"}}}}}, "priors.laws.jelly.elasticity.E"),
    ({"priors": {"laws": {"mud": {}}}}, "priors.laws.mud.elasticity"),
    ({"priors": {"laws": {"mud": {"elasticity": {"E": 1e5}}}}}, "priors.laws.mud.elasticity.name"),
    ({"scenes": {"BouncyBall": {"appearance": {"kind": "foam"}}}}, "scenes.BouncyBall.appearance.kind"),
    ({"scenes": 3}, "scenes"),
    (
        {"experiments": {"longer_bouncy": {"bodies": [{"scene": "BouncyBall", "shap": "ball"}]}}},
        "experiments.longer_bouncy.bodies.0.shap",
    ),
    ({"figures": {"main_res": ["BouncyBal"]}}, "figures.main_res"),
    ({"figures": {"ext_time": "longer"}}, "figures.ext_time"),
    ({"material": {"iterations": 3}}, "material"),
    ({"simulation": {"particles": 3}}, "simulation.particles"),
    ({"scenes": {"BouncyBall": {"material": {"rank": 4}}}}, "scenes.BouncyBall.material"),
    ({"tables": {"table1": {"on_request": True}}}, "tables.table1.on_request"),
    ({"advanced": {"identify.give_up": 3}}, "advanced.identify.give_up"),
    ({"advanced": {"identify.spraed": 2}}, "advanced.identify.spraed"),
    ({"advanced": {"identify.views": [0]}}, "advanced.identify.views"),
    ({"advanced": {"identify.spread": -2}}, "identify.spread"),
    ({"identify": {"spread": 2}}, "identify.spread"),
    ({"gaussians": {"densification": {"every": 3}}}, "gaussians.densification.every"),
]


@pytest.mark.parametrize(("change", "place"), MISTAKES)
def test_mistakes_are_named(raw, change, place):
    with first_refused(place):
        loading.load(loading.merged(raw, change), ROOT)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"trianing": {}}, r"did you mean training"),
        ({"dataset": {"static": {"veiws": 3}}}, r"did you mean views\?"),
        ({"training": {"iterations": "many"}}, r"integer.*\(given: 'many'\)"),
        ({"tables": {"table1": {"methods": ["neuma+rnk=4"]}}}, r"no option 'rnk'; did you mean rank"),
        ({"figures": {"ext_time": "longer"}}, r"no experiment 'longer'; did you mean longer_"),
        ({"material": {}}, "material: was renamed to training"),
        ({"identify": {"spread": 2}}, r"internal.*`advanced: \{identify\.spread: \.\.\.\}`"),
    ],
)
def test_messages_name_what_is_meant(raw, change, message):
    with pytest.raises(InputError, match=message):
        loading.load(loading.merged(raw, change), ROOT)


def test_a_scenes_file_must_exist(raw, tmp_path):
    with refused(tmp_path / "nowhere.yaml"):
        loading.load({**raw, "scenes_file": "nowhere.yaml"}, tmp_path)


def test_internal_keys_are_set_under_advanced(raw):
    advanced = {"identify.spread": 2.0, "gaussians.densification.every": 50}
    loaded = loading.load({**raw, "advanced": advanced}, ROOT)
    assert (loaded.identify.spread, loaded.gaussians.densification.every) == (2.0, 50)
    assert loaded.identify.families and loaded.gaussians.densification.max_count == 2000


def test_variants_may_set_internal_options(loaded):
    assert cases.case(loaded, "BouncyBall", "neuma+betas=0.5,0.9").options.betas == (0.5, 0.9)


def test_every_mistake_is_reported_at_once(raw):
    with pytest.raises(InputError) as error:
        loading.load(loading.merged(raw, {"training": {"a": 1, "b": 2}}), ROOT)
    assert "training.a" in str(error.value) and "training.b" in str(error.value)


def test_invalid_yaml_names_the_file(tmp_path):
    (tmp_path / "broken.yaml").write_text("a: [1,\n")
    with refused(tmp_path / "broken.yaml"):
        loading.read_yaml(tmp_path / "broken.yaml")


def test_numbers_without_a_point_are_numbers(raw):
    """YAML 1.1 reads 1e5 as text."""
    elasticity = {"name": "fixed_corotated", "E": "1e5", "nu": 0.2}
    change = {"priors": {"laws": {"jelly": {"elasticity": elasticity}}}}
    jelly = loading.load(loading.merged(raw, change), ROOT).priors.laws["jelly"]
    assert jelly.plain()["elasticity"] == {**elasticity, "E": 1e5}


class TestReplicates:
    def runs(self, raw, method, column="ClayCat", **table):
        change = {"tables": {"table1": {"seeds": 3, **table}}}
        return cases.runs(loading.load(loading.merged(raw, change), ROOT), "table1", method, column)

    @pytest.mark.parametrize("seeds", [(0, 0, 0, 0), (1, 1, 1, 1), (0, 0, 0, 2), (1, 2, 3, 0), (0, 11, 0, 0)])
    def test_names_say_the_seeds(self, seeds):
        chosen = dict(zip(SEEDS, seeds))
        assert parse_replicate(replicate_folder("A", chosen), ["A"], "scene") == ("A", chosen)

    def test_what_depends_on_equal_seeds_has_one_name(self):
        assert (
            replicate_folder("A", {}) == "A" and replicate_folder("A", dict.fromkeys(SEEDS, 2)) == "A+seed=2"
        )
        assert replicate_folder("A", {"gaussians": 1}) == "A+gaussians_seed=1"
        assert replicate_folder("A", {"gaussians": 1, "adaptor": 5}, ["gaussians"]) == "A+seed=1"
        assert replicate_folder("A", {"adaptor": 5}, ["prior", "gaussians"]) == "A"

    def test_one_seed_may_differ_from_the_common_one(self):
        _, seeds = parse_replicate("A+seed=2+prior_seed=0", ["A"], "scene")
        assert seeds == {"prior": 0, "gaussians": 2, "particles": 2, "adaptor": 2}

    @pytest.mark.parametrize("name", ["B+seed=1", "A+sed=1", "A+seed=-1", "A+seed=1+seed=1", "A+seed"])
    def test_mistakes(self, name):
        with refused(name):
            parse_replicate(name, ["A"], "scene")

    def test_every_row_of_a_table_has_all_replicates(self, raw, loaded):
        for method in loaded.tables["table1"].methods:
            expected = [f"ClayCat{seeds}/{method}" for seeds in ("", "+seed=1", "+seed=2")]
            assert self.runs(raw, method) == expected

    def test_what_does_not_vary_has_one_run(self, raw):
        assert self.runs(raw, "nclaw", vary=["adaptor"]) == ["ClayCat/nclaw"]
        # The base weights are no draw of the adaptor's.
        assert self.runs(raw, "neuma_without_adaptor", vary=["adaptor"]) == ["ClayCat/neuma_without_adaptor"]
        expected = [f"ClayCat{seeds}/neuma" for seeds in ("", "+adaptor_seed=1", "+adaptor_seed=2")]
        assert self.runs(raw, "neuma", vary=["adaptor"]) == expected
        # Without an adaptor all seeds are 1: the folder of the replicate.
        assert self.runs(raw, "nclaw", vary=SEEDS[:3])[1] == "ClayCat+seed=1/nclaw"

    def test_bodies_of_an_experiment_are_of_its_replicate(self, raw, loaded):
        assert loaded.body_scenes("fish_into_duck+seed=1") == ["SandFish+seed=1", "JellyDuck+seed=1"]
        assert self.runs(raw, "nclaw", "letter_N_sand")[2] == "letter_N_sand+seed=2/nclaw"
        assert loaded.experiment("letter_N_sand+seed=1") == loaded.experiment("letter_N_sand")

    def test_a_replicate_changes_seeds_only(self, raw):
        loaded = loading.load(loading.merged(raw, {"training": {"seed": 10}}), ROOT)
        plain = cases.case(loaded, "ClayCat", "neuma").options
        other = cases.case(loaded, "ClayCat+seed=2", "neuma").options
        assert (plain.seed, other.seed) == (10, 12)
        assert other.model_copy(update={"seed": 10}) == plain
        assert cases.case(loaded, "ClayCat+seed=2", "neuma+seed=5").options.seed == 7
        assert cases.case(loaded, "ClayCat+prior_seed=2", "neuma").options == plain
        assert loaded.scene("ClayCat+seed=2") == loaded.scene("ClayCat")


class TestFrames:
    def frames(self, raw, scene=None, **dataset):
        changes = {"dataset": dataset, "scenes": {"BouncyBall": {"steps": 100, **(scene or {})}}}
        return loading.load(loading.merged(raw, changes), ROOT).frame_steps("BouncyBall")

    def test_a_number_of_frames_is_even_and_ends_with_the_video(self, raw):
        assert self.frames(raw, frames=5) == (0, 25, 50, 75, 100)
        assert self.frames(raw, frames=1000) == tuple(range(101))

    def test_a_stride_starts_with_the_video(self, raw):
        assert self.frames(raw, frames=None, stride=25) == (0, 25, 50, 75, 100)
        assert self.frames(raw, frames=None, stride=30) == (0, 30, 60, 90)

    def test_steps_of_every_video(self, raw):
        assert self.frames(raw, frames=None, stride=10, steps=40) == (0, 10, 20, 30, 40)

    def test_a_scene_may_list_its_own(self, raw):
        own = {"frames": [0, 7, 9]}
        assert self.frames(raw, own, frames=None, stride=10, steps=40) == (0, 7, 9)


class TestLike:
    def test_a_scene_like_another_has_its_settings_and_its_own(self, raw):
        change = {"Soft": {"like": "UnevenCat", "law": {"elasticity": {"E": 1e5}}}, "ClayCat": {"size": 0.3}}
        loaded = loading.load(loading.merged(raw, {"scenes": change}), ROOT)
        soft, cat = loaded.scene("Soft"), loaded.scene("ClayCat")
        assert (soft.size, soft.law.plasticity, soft.dt) == (0.3, cat.law.plasticity, cat.dt)
        assert soft.density == loaded.scene("UnevenCat").density
        assert soft.law.elasticity.plain() == {**cat.law.elasticity.plain(), "E": 1e5}

    @pytest.mark.parametrize(
        ("change", "place"),
        [
            ({"New": {"like": "ClayCatt"}}, "scenes.New.like"),
            ({"A": {"like": "B"}, "B": {"like": "A"}}, "scenes.B.like"),
            ({"A": {"like": "A"}}, "scenes.A.like"),
        ],
    )
    def test_mistakes(self, raw, change, place):
        with refused(place):
            loading.load(loading.merged(raw, {"scenes": change}), ROOT)


class TestVideos:
    def loaded(self, raw, **scenes):
        return loading.load(loading.merged(raw, {"scenes": scenes}), ROOT)

    def test_another_throw_of_the_same_object_is_one_line(self, raw):
        again = {"velocity": [0.5, -1.0, 0.0], "steps": 300}
        loaded = self.loaded(
            raw, ClayCat={"videos": [again, "OtherCat"]}, OtherCat={"like": "ClayCat", "shape": "duck"}
        )
        throw, cat = loaded.scene("ClayCat_throw2"), loaded.scene("ClayCat")
        assert cat.videos == ("ClayCat_throw2", "OtherCat")
        assert (throw.velocity, throw.steps) == ((0.5, -1.0, 0.0), 300)
        own = {"velocity", "steps", "videos", "like"}
        plain = [scene.model_dump(exclude=own) for scene in (throw, cat)]
        assert plain[0] == plain[1]

    def test_videos_are_not_handed_on(self, raw):
        loaded = self.loaded(raw, ClayCat={"videos": [{"height": 0.4}]}, Near={"like": "ClayCat"})
        assert not loaded.scene("Near").videos and not loaded.scene("UnevenCat").videos
        assert not loaded.scene("ClayCat_throw2").videos

    def test_pairs_of_throws_that_are_shown(self, raw):
        pairs = loading.read_yaml(ROOT / "config" / "studies" / "two_throws.yaml")
        loaded = loading.load(loading.merged(raw, pairs), ROOT)
        for material in ("Paste", "Gel"):
            slow, both = loaded.scene(f"{material}Slow"), loaded.scene(f"{material}Both")
            assert both.videos == (f"{material}Fast",) and not slow.videos
            own = {"videos", "images", "like"}
            assert slow.model_dump(exclude=own) == both.model_dump(exclude=own)
            assert not loaded.tables[f"two_throws_{material.lower()}"].default_target

    def test_all_videos_are_of_the_replicate(self, raw):
        loaded = self.loaded(raw, ClayCat={"videos": [{"height": 0.4}]})
        assert loaded.video_scenes("ClayCat+seed=2") == ["ClayCat+seed=2", "ClayCat_throw2+seed=2"]
        assert loaded.video_scenes("BouncyBall") == ["BouncyBall"]

    @pytest.mark.parametrize(
        ("scenes", "place"),
        [
            ({"ClayCat": {"videos": ["ClayCatt"]}}, "scenes.ClayCat.videos"),
            ({"ClayCat": {"videos": ["ClayCat"]}}, "scenes.ClayCat.videos"),
            ({"ClayCat": {"videos": ["UnevenCat", "UnevenCat"]}}, "scenes.ClayCat.videos"),
            ({"ClayCat": {"videos": ["BouncyBall"]}}, "scenes.ClayCat.videos"),
            ({"ClayCat": {"videos": [{"prior": "sand"}]}}, "scenes.ClayCat.videos"),
            ({"ClayCat": {"videos": [{"dt": 2.5e-4}]}}, "scenes.ClayCat.videos"),
            (
                {"ClayCat": {"videos": ["UnevenCat"]}, "UnevenCat": {"videos": ["BouncyBall"]}},
                "scenes.ClayCat.videos",
            ),
            (
                {"ClayCat": {"videos": [{}]}, "ClayCat_throw2": {"like": "ClayCat"}},
                "scenes.ClayCat.videos",
            ),
            (
                {"ClayCat": {"videos": [{"height": 0.4}], "images": {"dynamic": "mine.json"}}},
                "scenes.ClayCat.videos",
            ),
            ({"ClayCat": {"videos": [{"heigth": 0.4}]}}, "scenes.ClayCat_throw2.heigth"),
        ],
    )
    def test_mistakes(self, raw, scenes, place):
        with first_refused(place):
            self.loaded(raw, **scenes)


class TestFinerTruth:
    def loaded(self, raw, **changes):
        return loading.load(loading.merged(raw, changes), ROOT)

    def values(self, truth):
        return truth.grid, truth.dt, truth.particles

    def test_it_is_as_fine_as_simulation_and_scene_by_default(self, loaded):
        assert self.values(loaded.scene_truth("BouncyBall")) == (24, 1e-3, 8000)
        assert self.values(loaded.experiment_truth("letter_N_sand")) == (24, 5e-4, 8000)

    def test_settings_of_all_truths_and_of_one(self, raw):
        finer = {"grid": 40, "dt": 2.5e-4, "particles": 9000}
        loaded = self.loaded(raw, dataset=finer, scenes={"ClayCat": {"truth": {"grid": 50}}})
        assert self.values(loaded.scene_truth("BouncyBall+seed=2")) == (40, 2.5e-4, 9000)
        assert self.values(loaded.scene_truth("ClayCat")) == (50, 2.5e-4, 9000)
        assert self.values(loaded.experiment_truth("letter_N_clay")) == (40, 2.5e-4, 9000)
        assert loaded.frame_steps("BouncyBall") == self.loaded(raw).frame_steps("BouncyBall")

    def test_recorded_ones_are_twice_as_fine_and_asked_for_by_name(self, loaded):
        table = loaded.tables["finer_truth"]
        assert not table.default_target and set(loaded.tables["table1"].methods) < set(table.methods)
        for name, scene in zip(table.scenes, loaded.tables["table1"].scenes, strict=True):
            finer, plain = loaded.scene_truth(name), loaded.scene_truth(scene)
            assert finer.grid == 2 * plain.grid and finer.particles == 8 * plain.particles
            assert plain.dt == 2 * finer.dt
            assert loaded.scene(name).law == loaded.scene(scene).law
        assert not {*table.scenes, *loaded.random_scenes} & set(loaded.plain_scenes)

    def test_truths_outside_every_family_are_asked_for_by_name(self, loaded):
        """Their laws are of no prior and no default random scene, and no other table has them."""
        table = loaded.tables["outside"]
        assert not table.default_target and not {*table.scenes} & set(loaded.plain_scenes)
        assert not any(
            {*table.scenes} & {*t.scenes} for name, t in loaded.tables.items() if name != "outside"
        )
        known = [*loaded.priors.laws.values()]
        known += [loaded.scene(name).law for name in (*loaded.plain_scenes, *loaded.random_scenes)]
        pairs = {(law.elasticity.name, law.plasticity.name) for law in known}
        outside = [loaded.scene(name).law for name in table.scenes]
        chosen = {(law.elasticity.name, law.plasticity.name) for law in outside}
        assert len(chosen) == len(table.scenes) and not chosen & pairs

    @pytest.mark.parametrize(
        ("change", "place"),
        [
            ({"dataset": {"dt": 3e-4}}, "dataset.dt"),
            ({"dataset": {"dt": 2e-3}}, "dataset.dt"),
            ({"scenes": {"ClayCat": {"truth": {"dt": 1e-3}}}}, "scenes.ClayCat.truth.dt"),
            ({"scenes": {"ClayCat": {"truth": {"gird": 9}}}}, "scenes.ClayCat.truth.gird"),
        ],
    )
    def test_mistakes(self, raw, change, place):
        with first_refused(place):
            self.loaded(raw, **change)


class TestScaleOfThePaper:
    def overlay(self, raw, *names):
        for name in names:
            raw = loading.merged(raw, loading.read_yaml(ROOT / "config" / f"{name}.yaml"))
        return loading.load(raw, ROOT)

    def test_paper(self, raw):
        paper = self.overlay(raw, "paper")
        assert (paper.geometry.particles, paper.simulation.grid, paper.training.iterations) == (
            30000,
            32,
            1000,
        )
        assert (paper.dataset.dynamic.width, paper.dataset.static.height) == (800, 800)
        assert paper.gaussians.densification.max_count == 20000 and paper.device == "cuda"
        for scene in paper.scenes:
            assert paper.frame_steps(scene) == tuple(range(401))

    def test_light_differs_in_images_alone(self, raw, loaded):
        paper, light = self.overlay(raw, "paper"), self.overlay(raw, "paper", "studies/paper_light")
        assert light.frame_steps("BouncyBall") == tuple(range(0, 401, 4))
        same = ("device", "simulation", "gaussians", "training", "scenes", "kernel_cache")
        assert all(getattr(light, name) == getattr(paper, name) for name in same)
        roots = [getattr(c, root) for c in (loaded, paper, light) for root in ("data_root", "results_root")]
        assert len(set(roots)) == 6


def test_plain_values_build_the_section_again(loaded):
    """Settings that pass through a job as text are unchanged."""
    assert Config(**json.loads(json.dumps(loaded.plain()))) == loaded


def test_a_stage_depends_on_its_own_settings_alone_and_settings_on_no_torch():
    """An edit of the settings of figures does not repeat the fit of the Gaussians, and plans are fast."""
    grimp = pytest.importorskip("grimp")
    graph = grimp.build_graph("neuma_lib", include_external_packages=True)
    reached = graph.find_upstream_modules("neuma_lib.fitting.gaussians")
    assert {m for m in reached if m.startswith("neuma_lib.config")} == {
        "neuma_lib.config.base",
        "neuma_lib.config.gaussians",
    }
    command = (
        "import sys, neuma_lib.project.loading; print([m for m in ('torch', 'warp') if m in sys.modules])"
    )
    loaded = subprocess.run(
        [sys.executable, "-c", command], cwd=ROOT, text=True, capture_output=True, check=True
    )
    assert loaded.stdout.strip() == "[]"


def test_every_section_and_key_is_explained():
    for kind in Section.__subclasses__():
        assert kind.__doc__ and all(entry.description for entry in kind.model_fields.values()), kind.__name__


@pytest.mark.parametrize(("file", "text"), [(PAGE, settings_markdown), (SCHEMA, settings_schema)])
def test_page_and_schema_are_up_to_date(file, text):
    assert (ROOT / file).read_text() == text(), "run: python -m neuma_lib.project.page"


def test_page_and_schema_have_public_keys_alone():
    page, schema = settings_markdown(), json.loads(settings_schema())
    assert page.count("\n| `") <= 200
    assert "| `penalty` |" in page and "| `spread` |" not in page
    known = schema["$defs"]["IdentifyConfig"]["properties"]
    assert "penalty" in known and "spread" not in known
    assert {"training", "scenes", "advanced"} <= schema["properties"].keys()
