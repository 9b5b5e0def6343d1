"""Settings: errors name keys, variants and replicates name folders, the documentation follows the types."""

import json
from contextlib import contextmanager
from pathlib import Path

import pytest

from neuma_lib.config import simulation
from neuma_lib.config.base import Section
from neuma_lib.config.laws import LawConfig
from neuma_lib.config.variants import SEEDS, parse_replicate, replicate_folder
from neuma_lib.errors import InputError
from neuma_lib.fitting.families import FAMILIES
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
    ({"identify": {"contact_friction": 0.3}}, "identify.contact_friction"),
    (
        {"identify": {"contact_friction": "fitted"}, "simulation": {"contact": "nodes"}},
        "identify.contact_friction",
    ),
    ({"gaussians": {"densification": {"every": 3}}}, "gaussians.densification.every"),
    ({"methods": 3}, "methods"),
    ({"extensions": ["os"]}, "extensions"),
    ({"scenes": {"New": {"like": ["BouncyBall"]}}}, "scenes.New.like"),
    ({"simulation": {"boundary": "no_slp"}}, "simulation.boundary"),
    ({"simulation": {"boundary": "sticky"}}, "simulation.boundary"),
    ({"simulation": {"boundary": {"x_min": "sticky"}}}, "simulation.boundary"),
    ({"simulation": {"boundary": {"x_mn": "slip"}}}, "simulation.boundary"),
    *[
        ({"simulation": {"contact": contact, "boundary": boundary}}, "simulation.boundary")
        for contact, boundary in [("nodes", 0.3), ("released", {"y_min": 0.3}), ("particles", "sticky")]
    ],
    *[
        ({"simulation": {"contact": "particles", "boundary": {"y_min": boundary}}}, "simulation.boundary")
        for boundary in (-0.1, True, "0.3", [1], float("nan"), float("inf"))
    ],
    ({"scenes": {"BouncyBall": {"appearance": {"accent": "red"}}}}, "scenes.BouncyBall.appearance.accent"),
    ({"random": {"count": 1_000_000}}, "random.count"),
    ({"advanced": {"radiance.particles": 10**9}}, "radiance.particles"),
    ({"advanced": {"radiance.voxel": 1e-4}}, "radiance.voxel"),
    ({"seed": -1}, "seed"),
    ({"training": {"seed": 10**40}}, "training.seed"),
    # booleans are no numbers
    ({"training": {"rank": True}}, "training.rank"),
    ({"training": {"views": [False]}}, "training.views"),
    ({"advanced": {"random.velocity": [[0, 1], [0, True], [0, 1]]}}, "random.velocity"),
    ({"scenes": {"BouncyBall": {"density": True}}}, "scenes.BouncyBall.density"),
    ({"scenes": {"BouncyBall": {"training": {"rank": True}}}}, "scenes.BouncyBall.training.rank"),
    ({"scenes": {"BouncyBall": {"law": {"elasticity": {"E": True}}}}}, "scenes.BouncyBall.law.elasticity.E"),
    ({"methods": {"neuma": {"options": {"rank": True}}}}, "methods.neuma.options.rank"),
    # names are folders and parts of patterns
    *[
        ({"scenes": {name: {"like": "BouncyBall"}}}, f"scenes.{name}")
        for name in ("a.b", "a b", "a/b", "{a}", "a*", "", "-a", "figures", "none", "a" * 81)
    ],
    ({"methods": {"a.b": {"title": "x", "kind": "neuma"}}}, "methods.a.b"),
    ({"tables": {"../a": {"scenes": ["BouncyBall"]}}}, "tables.../a"),
]
NOT_FINITE = [float("nan"), float("inf"), -float("inf"), "nan", "inf", 10**400]
MISTAKES += [({"training": {"lr_elastic": value}}, "training.lr_elastic") for value in NOT_FINITE]
MISTAKES += [
    ({"scenes": {"BouncyBall": {"velocity": [0, value, 0]}}}, "scenes.BouncyBall.velocity.1")
    for value in NOT_FINITE
]
MISTAKES += [
    ({"scenes": {"BouncyBall": {"law": {"elasticity": {"E": value}}}}}, "scenes.BouncyBall.law.elasticity.E")
    for value in NOT_FINITE
]
MISTAKES += [
    ({"results_root": folder}, "results_root")
    for folder in ("", " ", "/", "//", "~", "~/x", ".", "..", "results/..", "/tmp", "/etc/x", "a{b}", "a\0")
]
MISTAKES += [
    ({"results_root": str(Path.home())}, "results_root"),
    ({"results_root": "config/x"}, "results_root"),
    ({"results_root": "data/"}, "results_root"),
    ({"data_root": ""}, "data_root"),
    ({"kernel_cache": "/"}, "kernel_cache"),
    ({"captures": {"root": ""}}, "captures.root"),
]


@pytest.mark.parametrize(("change", "place"), MISTAKES)
def test_mistakes_are_named(changed, change, place):
    with first_refused(place):
        changed(**change)


def test_a_scene_is_not_replaced_by_a_random_one_of_its_name(raw, loaded, tmp_path):
    name = next(iter(loaded.random_scenes))
    (tmp_path / "scenes.yaml").write_text(f"{name}: {{shape: ball}}\n")
    with refused(f"scenes.{name}"):
        loading.load({**raw, "scenes_file": str(tmp_path / "scenes.yaml")}, ROOT)


def test_folders_outside_of_the_project_can_hold_results(changed):
    for folder in ("/mnt/disk/results", "../elsewhere/results", "/dev/shm/results", "my results/"):
        assert changed(results_root=folder).results_root == folder


def test_names_of_walls_are_those_of_the_simulator():
    model = pytest.importorskip("neuma_lib.sim.model")
    assert (simulation.WALLS, simulation.CONDITIONS) == (model.WALLS, model.CONDITIONS)


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
def test_messages_name_what_is_meant(changed, change, message):
    with pytest.raises(InputError, match=message):
        changed(**change)


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


def test_every_mistake_is_reported_at_once(changed):
    with pytest.raises(InputError) as error:
        changed(training={"a": 1, "b": 2})
    assert "training.a" in str(error.value) and "training.b" in str(error.value)


def test_invalid_yaml_names_the_file(tmp_path):
    (tmp_path / "broken.yaml").write_text("a: [1,\n")
    with refused(tmp_path / "broken.yaml"):
        loading.read_yaml(tmp_path / "broken.yaml")


def test_numbers_without_a_point_are_numbers(changed):
    """YAML 1.1 reads 1e5 as text."""
    elasticity = {"name": "fixed_corotated", "E": "1e5", "nu": 0.2}
    jelly = changed(priors={"laws": {"jelly": {"elasticity": elasticity}}}).priors.laws["jelly"]
    assert jelly.plain()["elasticity"] == {**elasticity, "E": 1e5}


class TestReplicates:
    @pytest.fixture
    def runs(self, changed):
        def runs_of(method, column="ClayCat", **table):
            return cases.runs(changed(tables={"table1": {"seeds": 3, **table}}), "table1", method, column)

        return runs_of

    @pytest.mark.parametrize("seeds", [(0, 0, 0, 0), (1, 1, 1, 1), (0, 0, 0, 2), (1, 2, 3, 0), (0, 11, 0, 0)])
    def test_names_contain_the_seeds(self, seeds):
        chosen = dict(zip(SEEDS, seeds))
        assert parse_replicate(replicate_folder("A", chosen), ["A"], "scene") == ("A", chosen)

    def test_what_depends_on_equal_seeds_has_one_name(self):
        assert replicate_folder("A", {}) == "A"
        assert replicate_folder("A", dict.fromkeys(SEEDS, 2)) == "A+seed=2"
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

    def test_every_row_of_a_table_has_all_replicates(self, runs, loaded):
        for method in loaded.tables["table1"].methods:
            expected = [f"ClayCat{seeds}/{method}" for seeds in ("", "+seed=1", "+seed=2")]
            assert runs(method) == expected

    def test_what_does_not_vary_has_one_run(self, runs):
        assert runs("nclaw", vary=["adaptor"]) == ["ClayCat/nclaw"]
        # The base weights are no draw of the adaptor's.
        assert runs("neuma_without_adaptor", vary=["adaptor"]) == ["ClayCat/neuma_without_adaptor"]
        expected = [f"ClayCat{seeds}/neuma" for seeds in ("", "+adaptor_seed=1", "+adaptor_seed=2")]
        assert runs("neuma", vary=["adaptor"]) == expected
        # Without an adaptor all seeds are 1: the folder of the replicate.
        assert runs("nclaw", vary=SEEDS[:3])[1] == "ClayCat+seed=1/nclaw"

    def test_bodies_of_an_experiment_are_of_its_replicate(self, runs, loaded):
        assert loaded.body_scenes("fish_into_duck+seed=1") == ["SandFish+seed=1", "JellyDuck+seed=1"]
        assert runs("nclaw", "letter_N_sand")[2] == "letter_N_sand+seed=2/nclaw"
        assert loaded.experiment("letter_N_sand+seed=1") == loaded.experiment("letter_N_sand")

    def test_a_replicate_changes_seeds_only(self, changed):
        loaded = changed(training={"seed": 10})
        plain = cases.case(loaded, "ClayCat", "neuma").options
        other = cases.case(loaded, "ClayCat+seed=2", "neuma").options
        assert (plain.seed, other.seed) == (10, 12)
        assert other.model_copy(update={"seed": 10}) == plain
        assert cases.case(loaded, "ClayCat+seed=2", "neuma+seed=5").options.seed == 7
        assert cases.case(loaded, "ClayCat+prior_seed=2", "neuma").options == plain
        assert loaded.scene("ClayCat+seed=2") == loaded.scene("ClayCat")


@pytest.mark.parametrize(
    ("dataset", "scene", "expected"),
    [
        ({"frames": 5}, {}, (0, 25, 50, 75, 100)),
        ({"frames": 1000}, {}, tuple(range(101))),
        ({"frames": None, "stride": 25}, {}, (0, 25, 50, 75, 100)),
        ({"frames": None, "stride": 30}, {}, (0, 30, 60, 90)),
        ({"frames": None, "stride": 10, "steps": 40}, {}, (0, 10, 20, 30, 40)),
        ({"frames": None, "stride": 10, "steps": 40}, {"frames": [0, 7, 9]}, (0, 7, 9)),
    ],
)
def test_frames_of_a_video(changed, dataset, scene, expected):
    settings = changed(dataset=dataset, scenes={"BouncyBall": {"steps": 100, **scene}})
    assert settings.frame_steps("BouncyBall") == expected


class TestLike:
    def test_a_scene_like_another_inherits_its_settings(self, changed):
        change = {"Soft": {"like": "UnevenCat", "law": {"elasticity": {"E": 1e5}}}, "ClayCat": {"size": 0.3}}
        loaded = changed(scenes=change)
        soft, cat = loaded.scene("Soft"), loaded.scene("ClayCat")
        assert (soft.size, soft.law.plasticity, soft.dt) == (0.3, cat.law.plasticity, cat.dt)
        assert soft.density == loaded.scene("UnevenCat").density
        assert soft.law.elasticity.plain() == {**cat.law.elasticity.plain(), "E": 1e5}

    @pytest.mark.parametrize(
        ("scenes", "place"),
        [
            ({"New": {"like": "ClayCatt"}}, "scenes.New.like"),
            ({"A": {"like": "B"}, "B": {"like": "A"}}, "scenes.B.like"),
            ({"A": {"like": "A"}}, "scenes.A.like"),
        ],
    )
    def test_mistakes(self, changed, scenes, place):
        with refused(place):
            changed(scenes=scenes)


class TestVideos:
    def test_another_take_of_the_same_object_is_one_line(self, changed):
        again = {"velocity": [0.5, -1.0, 0.0], "steps": 300}
        cats = {"ClayCat": {"videos": [again, "OtherCat"]}, "OtherCat": {"like": "ClayCat", "shape": "duck"}}
        loaded = changed(scenes=cats)
        take, cat = loaded.scene("ClayCat_throw2"), loaded.scene("ClayCat")
        assert cat.videos == ("ClayCat_throw2", "OtherCat")
        assert (take.velocity, take.steps) == ((0.5, -1.0, 0.0), 300)
        own = {"velocity", "steps", "videos", "like"}
        assert take.model_dump(exclude=own) == cat.model_dump(exclude=own)

    def test_videos_are_not_inherited_and_belong_to_the_replicate(self, changed):
        loaded = changed(scenes={"ClayCat": {"videos": [{"height": 0.4}]}, "Near": {"like": "ClayCat"}})
        assert not loaded.scene("Near").videos and not loaded.scene("UnevenCat").videos
        assert not loaded.scene("ClayCat_throw2").videos
        assert loaded.video_scenes("ClayCat+seed=2") == ["ClayCat+seed=2", "ClayCat_throw2+seed=2"]
        assert loaded.video_scenes("BouncyBall") == ["BouncyBall"]

    def test_scenes_of_the_study_of_two_videos_differ_in_their_motion_only(self, changed):
        loaded = changed(**loading.read_yaml(ROOT / "config" / "studies" / "two_throws.yaml"))
        for material in ("Paste", "Gel"):
            slow, both = loaded.scene(f"{material}Slow"), loaded.scene(f"{material}Both")
            assert both.videos == (f"{material}Fast",) and not slow.videos
            own = {"videos", "images", "like"}
            assert slow.model_dump(exclude=own) == both.model_dump(exclude=own)
            assert not loaded.tables[f"two_throws_{material.lower()}"].default_target

    @pytest.mark.parametrize(
        ("cat", "others"),
        [
            ({"videos": ["ClayCatt"]}, {}),
            ({"videos": ["ClayCat"]}, {}),
            ({"videos": ["UnevenCat", "UnevenCat"]}, {}),
            ({"videos": ["BouncyBall"]}, {}),
            ({"videos": [{"prior": "sand"}]}, {}),
            ({"videos": [{"dt": 2.5e-4}]}, {}),
            ({"videos": ["UnevenCat"]}, {"UnevenCat": {"videos": ["BouncyBall"]}}),
            ({"videos": [{}]}, {"ClayCat_throw2": {"like": "ClayCat"}}),
            ({"videos": [{"height": 0.4}], "images": {"dynamic": "mine.json"}}, {}),
        ],
    )
    def test_mistakes(self, changed, cat, others):
        with first_refused("scenes.ClayCat.videos"):
            changed(scenes={"ClayCat": cat, **others})

    def test_a_mistake_in_a_take_names_its_scene(self, changed):
        with first_refused("scenes.ClayCat_throw2.heigth"):
            changed(scenes={"ClayCat": {"videos": [{"heigth": 0.4}]}})


class TestTruth:
    def values(self, truth):
        return truth.grid, truth.dt, truth.particles

    def test_resolution(self, loaded, changed):
        """It is that of simulation and scene by default, or that of all truths, or of one."""
        assert self.values(loaded.scene_truth("BouncyBall")) == (36, 1e-3, 8000)
        assert self.values(loaded.experiment_truth("letter_N_sand")) == (36, 5e-4, 8000)
        refined = {"grid": 40, "dt": 2.5e-4, "particles": 9000}
        own = changed(dataset=refined, scenes={"ClayCat": {"truth": {"grid": 50}}}, random={"count": 0})
        assert self.values(own.scene_truth("BouncyBall+seed=2")) == (40, 2.5e-4, 9000)
        assert self.values(own.scene_truth("ClayCat")) == (50, 2.5e-4, 9000)
        assert self.values(own.experiment_truth("letter_N_clay")) == (40, 2.5e-4, 9000)
        assert own.frame_steps("BouncyBall") == loaded.frame_steps("BouncyBall")

    def test_a_truth_on_the_grid_of_the_simulation_is_identified_on_it_alone(self, loaded, changed):
        shared = loaded.identify_of("BouncyBall+seed=1")
        assert shared == loaded.identify.model_copy(update={"refinement": 1.0})
        assert loaded.identify_of("BouncyBall_converged+seed=1") == loaded.identify
        assert loaded.identify.refined_particles > 0
        refined = changed(dataset={"grid": 40}, random={"count": 0})
        assert refined.identify_of("BouncyBall") == refined.identify

    def test_the_converged_table_has_96_cells_and_is_optional(self, loaded, changed):
        table = loaded.tables["table1_converged"]
        assert not table.default_target and set(loaded.tables["table1"].methods) < set(table.methods)
        for name, scene in zip(table.scenes, loaded.tables["table1"].scenes, strict=True):
            refined, plain = loaded.scene_truth(name), loaded.scene_truth(scene)
            assert refined.grid == 96 and refined.particles is None
            assert plain.dt == pytest.approx(4 * refined.dt)
            assert loaded.scene(name).law == loaded.scene(scene).law
        assert not {*table.scenes, *loaded.random_scenes} & set(loaded.plain_scenes)
        for grid, truth in ((24, 96), (32, 96), (64, 128)):
            other = changed(simulation={"grid": grid}, random={"count": 0})
            assert other.scene_truth(table.scenes[0]).grid == truth
        everywhere = changed(dataset={"grid": "converged"})
        assert (
            everywhere.scene_truth("ClayCat").grid == everywhere.experiment_truth("letter_N_clay").grid == 96
        )

    def test_laws_outside_every_family_are_in_no_prior_random_scene_or_other_table(self, loaded):
        table = loaded.tables["outside"]
        assert not table.default_target and not {*table.scenes} & set(loaded.plain_scenes)
        others = (t for name, t in loaded.tables.items() if name != "outside")
        assert not any({*table.scenes} & {*other.scenes} for other in others)
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
    def test_mistakes(self, changed, change, place):
        with first_refused(place):
            changed(**change)


class TestScaleOfThePaper:
    def overlay(self, raw, *names):
        for name in names:
            raw = loading.merged(raw, loading.read_yaml(ROOT / "config" / f"{name}.yaml"))
        return loading.load(raw, ROOT)

    def test_paper(self, raw):
        paper = self.overlay(raw, "paper")
        assert (paper.geometry.particles, paper.simulation.grid) == (30000, 32)
        assert paper.training.iterations == 1000
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


def test_a_stage_depends_on_its_own_settings_alone():
    """An edit of the settings of figures does not repeat the fit of the Gaussians."""
    grimp = pytest.importorskip("grimp")
    graph = grimp.build_graph("neuma_lib", include_external_packages=True)
    reached = graph.find_upstream_modules("neuma_lib.fitting.gaussians")
    sections = {f"neuma_lib.config.{name}" for name in ("base", "gaussians")}
    assert {m for m in reached if m.startswith("neuma_lib.config")} == sections


def test_every_section_and_key_is_explained():
    kinds = [kind for kind in Section.__subclasses__() if kind.__module__.startswith("neuma_lib.config.")]
    assert len(kinds) > 20
    for kind in kinds:
        assert kind.__doc__ and all(entry.description for entry in kind.model_fields.values()), kind.__name__


def test_families_of_the_library_are_those_of_the_shipped_settings(loaded):
    shipped = {name: law.plain() for name, law in loaded.identify.families.items()}
    assert {name: LawConfig(**spec).plain() for name, spec in FAMILIES.items()} == shipped


def test_page_and_schema_are_up_to_date():
    """Versions of pydantic write bounds of numbers as 0 or 0.0, so that the values of the schema are compared."""
    assert (ROOT / PAGE).read_text() == settings_markdown(), "run: python -m neuma_lib.project.page"
    schema = json.loads((ROOT / SCHEMA).read_text())
    assert schema == json.loads(settings_schema()), "run: python -m neuma_lib.project.page"


def test_page_and_schema_have_public_keys_alone():
    page, schema = settings_markdown(), json.loads(settings_schema())
    assert page.count("\n| `") <= 245
    assert "| `penalty` |" in page and "| `spread` |" not in page
    known = schema["$defs"]["IdentifyConfig"]["properties"]
    assert "penalty" in known and "spread" not in known
    assert {"training", "scenes", "advanced"} <= schema["properties"].keys()
