"""Presets and variants on scenes: options, runs, priors and sources of models."""

from pathlib import Path

import pytest

from neuma_lib.errors import InputError
from neuma_lib.methods.registry import built_in_presets, methods
from neuma_lib.project import cases
from tests.support.errors import refused

ROOT = Path(__file__).resolve().parents[2]


def test_a_name_holds_a_preset_and_options(loaded):
    assert cases.preset(loaded, "neuma")[1] == {}
    chosen, given = cases.preset(loaded, "neuma+rank=4+lr_elastic=0.1+views=0,2+prior=sand")
    assert chosen == loaded.methods["neuma"]
    assert given == {"rank": 4, "lr_elastic": 0.1, "views": [0, 2], "prior": "sand"}
    assert cases.title(loaded, "neuma+rank=4+views=0,2") == "NeuMA, rank 4, views 0,2"


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("neumo", "no method 'neumo'; did you mean neuma"),
        ("neuma+rank", "a variant of a method is written +key=value"),
        ("neuma+rank=", "a variant of a method is written +key=value"),
        ("neuma+rank=4+rank=8", "'rank' is given twice"),
        ("neuma+ranks=4", "no option 'ranks'; did you mean rank"),
        ("neuma+anchors=50", "no option 'anchors'"),
        ("neuma+form=energy", "no option 'form'"),
        ("spring_gaus+margin=0", "no option 'margin'"),
        ("neuma+guesses=prior", "no option 'guesses'"),
        ("constants+prior=sand", "no option 'prior'"),
    ],
)
def test_names_with_mistakes_are_refused(loaded, name, message):
    with refused(name, problem=message):
        cases.preset(loaded, name)


@pytest.mark.parametrize("name", ["neuma+rank=x", "neuma_structured+form=secant"])
def test_a_wrong_value_names_the_variant(loaded, name):
    with refused(name):
        cases.case(loaded, "BouncyBall", name)


def test_options_are_layers_of_section_scene_preset_and_variant(changed):
    loaded = changed(
        training={"lr_elastic": 1.0, "lr_plastic": 1.0, "iterations": 1},
        advanced={"training.alpha": 1.0},
        scenes={"BouncyBall": {"training": {"lr_plastic": 2.0, "alpha": 2.0, "iterations": 2}}},
        methods={"neuma": {"options": {"alpha": 3.0, "iterations": 3}}},
    )
    options = cases.case(loaded, "BouncyBall", "neuma+iterations=4").options
    assert (options.lr_elastic, options.lr_plastic, options.alpha, options.iterations) == (1.0, 2.0, 3.0, 4)


def test_built_in_presets_can_be_changed_and_added_to(changed):
    loaded = changed(
        methods={"neuma": {"title": "Mine"}, "low": {"kind": "neuma", "title": "L", "options": {"rank": 2}}}
    )
    assert cases.title(loaded, "neuma") == "Mine"
    assert cases.case(loaded, "BouncyBall", "low").options.rank == 2
    assert [*loaded.methods] == [*built_in_presets(), "low"]


def test_a_preset_may_take_the_fit_of_another(loaded):
    base = "neuma_without_binding"
    own, other = (cases.case(loaded, "BouncyBall", f"{name}+lr_scale=1") for name in (f"{base}_own", base))
    assert own.name == other.name == f"{base}+lr_scale=1"
    assert own.options == other.options and own.product() == other.product()
    sources = [case.method.particle_source(case) for case in (own, other)]
    assert sources == ["gaussians", "binding"]


@pytest.mark.parametrize(
    ("preset", "where"),
    [
        ({"kind": "neumo"}, "methods.new.kind"),
        ({}, "methods.new"),
        ({"same_fit_as": "neumo"}, "methods.new.same_fit_as"),
        ({"same_fit_as": "neuma_without_binding_own"}, "methods.new.same_fit_as"),
        ({"same_fit_as": "neuma", "options": {"rank": 4}}, "methods.new"),
        ({"same_fit_as": "neuma", "kind": "structured"}, "methods.new.kind"),
        ({"kind": "neuma", "options": {"margin": 0.1}}, "methods.new.options.margin"),
        ({"kind": "structured", "options": {"margins": 0.1}}, "methods.new.options.margins"),
        ({"kind": "neuma", "options": {"prior": "snad"}}, "methods.new.options.prior"),
        ({"kind": "constants", "options": {"prior": "sand"}}, "methods.new.options.prior"),
    ],
)
def test_presets_with_mistakes_name_the_key(changed, preset, where):
    with refused(where):
        changed(methods={"new": {"title": "new", **preset}})


@pytest.mark.parametrize(
    ("key", "value", "new"),
    [
        ("law", "identified", "kind"),
        ("material", {"rank": 4}, "options"),
        ("structured", {"margin": 0.1}, "options"),
        ("springs", {"anchors": 9}, "options"),
        ("pac_nerf", {"guesses": "prior"}, "options"),
        ("prior", "sand", "options.prior"),
        ("trained_as", "neuma", "same_fit_as"),
        ("judged_on", "particles", "evaluate_on"),
    ],
)
def test_keys_of_former_versions_name_the_new_one(changed, key, value, new):
    with refused(f"methods.mine.{key}") as caught:
        changed(methods={"mine": {"title": "Mine", key: value}})
    assert caught.value.problem.endswith(f" to methods.mine.{new}")


def test_methods_that_tables_name_exist(changed):
    table = {"scenes": ["BouncyBall"], "methods": ["neuma+law_from=ClayCatt"]}
    with refused("tables.new"):
        changed(tables={"new": table})
    with refused("figures.beside"):
        changed(figures={"beside": ["spring_gaus+law_from=ClayCat"]})


def test_identified_friction_leaves_other_scenes_their_coefficients(changed, loaded):
    own = changed(identify={"contact_friction": "fitted"}, simulation={"contact": "particles"})
    for name in ("constants", "neuma_structured"):
        elsewhere = f"{name}+law_from=ClayCat"
        assert cases.case(own, "BouncyBall", name).source().options == {}
        assert cases.case(own, "BouncyBall", elsewhere).source().options == {"elsewhere": True}
        assert cases.case(loaded, "BouncyBall", elsewhere).source().options == {}


class TestPriors:
    def test_of_the_scene_or_the_preset(self, loaded):
        names = ("neuma", "neuma+prior=sand")
        assert [cases.case(loaded, "BouncyBall", name).prior for name in names] == ["jelly", "sand"]
        with refused("neuma+prior=snad"):
            cases.case(loaded, "BouncyBall", "neuma+prior=snad")

    def test_the_identified_law_is_a_prior_of_any_method(self, changed, loaded):
        for name in ("neuma+prior=identified", "neuma_structured"):
            assert cases.case(loaded, "BouncyBall", name).prior == "identified"
        law = loaded.priors.laws["jelly"].plain()
        for changes in (
            {"priors": {"laws": {"identified": law}}},
            {"scenes": {"ClayCat": {"prior": "identified"}}},
        ):
            with pytest.raises(InputError):
                changed(**changes)

    def test_a_structured_method_corrects_an_analytic_law(self, changed, loaded):
        case = cases.case(loaded, "BouncyBall", "neuma_structured")
        assert case.method.fit_options(case)["base"] is None
        assert case.method.fit_inputs(case)["identified"] == "results/BouncyBall/identified.json"
        published = cases.case(loaded, "BouncyBall", "neuma_structured+prior=jelly")
        assert published.method.fit_options(published)["base"] == loaded.priors.laws["jelly"].plain()
        assert "identified" not in published.method.fit_inputs(published)
        own = changed(
            scenes={"BouncyBall": {"prior": "my/law.pt"}},
            methods={"new": {"title": "new", "kind": "structured"}},
        )
        mine = cases.case(own, "BouncyBall", "new")
        with refused("new on BouncyBall"):
            mine.method.fit_options(mine)

    def test_it_is_identified_in_the_views_of_the_training(self, changed, loaded):
        def name(settings, scene, method):
            return cases.case(settings, scene, method).identified()

        assert name(loaded, "BouncyBall", "neuma_structured") == "identified.json"
        assert name(loaded, "BouncyBall", "neuma_structured+views=0,2") == "identified+views=0,2.json"
        assert name(loaded, "BouncyBall", "constants+views=1") == "identified+views=1.json"
        own = changed(identify={"views": [0, 1]}, scenes={"ClayCat": {"training": {"views": [1, 2]}}})
        assert name(own, "BouncyBall", "neuma_structured+views=0,1") == "identified.json"
        assert name(own, "ClayCat", "constants") == "identified+views=1,2.json"


class TestLawFrom:
    """A model that is obtained in one scene moves another."""

    def test_everything_about_the_law_is_of_its_scene(self, changed):
        scenes = {"ClayCat": {"training": {"iterations": 7, "covariance_from": "total"}}}
        loaded = changed(scenes=scenes)
        case = cases.case(loaded, "BouncyBall+seed=2", "neuma+law_from=ClayCat+rank=4")
        assert (case.scene, case.moved) == ("ClayCat+seed=2", "BouncyBall+seed=2")
        assert case.name == "neuma+rank=4"
        assert case.prior == "plasticine" and not case.learned_from_moved_scene
        assert case.options == cases.case(loaded, "ClayCat+seed=2", "neuma+rank=4").options
        assert case.product() == "results/ClayCat+seed=2/neuma+rank=4/adaptor.safetensors"
        true = cases.case(loaded, "BouncyBall", "true_law+law_from=ClayCat")
        assert true.method.model_options(true)["law"] == loaded.scene("ClayCat").law.plain()

    def test_the_body_stays_that_of_the_scene(self, loaded):
        case = cases.case(loaded, "ClayCat", "neuma+law_from=UnevenCat")
        assert case.density(case.moved) == loaded.scene("ClayCat").density
        assert case.method.start_file(case) == "results/ClayCat/velocity.json"

    def test_mistakes(self, loaded):
        with refused("neuma+law_from=ClayCatt"):
            cases.case(loaded, "BouncyBall", "neuma+law_from=ClayCatt")
        with refused("spring_gaus+law_from=ClayCat"):
            cases.case(loaded, "BouncyBall", "spring_gaus+law_from=ClayCat")


def test_pac_nerf_has_its_own_start_and_particles(loaded):
    for own, base in (("pac_nerf_own", "pac_nerf"), ("pac_nerf_own+guesses=prior", "pac_nerf+guesses=prior")):
        mine, shared = (cases.case(loaded, "BouncyBall", name) for name in (own, base))
        assert mine.options == shared.options and mine.product() == shared.product()
        assert mine.method.start_file(mine) == shared.product()
        assert (mine.method.particle_source(mine), shared.method.particle_source(shared)) == (
            "field",
            "binding",
        )
        assert mine.method.body_inputs(mine) and not shared.method.body_inputs(shared)
        assert {own, base} <= set(loaded.tables["table1_systems"].methods)
    assert cases.run_folder(loaded, "BouncyBall+adaptor_seed=2", "pac_nerf") == "BouncyBall/pac_nerf"


def test_what_a_method_draws_names_its_run(loaded):
    folder = "ClayCat+adaptor_seed=1"
    runs = {name: cases.run_folder(loaded, folder, name).partition("/")[0] for name in loaded.methods}
    drawn = {name for name, run in runs.items() if run == folder}
    assert drawn == {"neuma", "neuma_particle_supervision", "neuma_without_binding", "neuma_without_binding_own",
                     "neuma_same_inputs", "neuma_structured"}  # fmt: skip


def test_every_method_states_its_files_without_torch(loaded):
    for name in loaded.methods:
        case = cases.case(loaded, "ClayCat", name)
        assert all(isinstance(path, str) for path in case.source().paths)
        assert bool(case.method.product) == bool(case.method.fit_inputs(case))
        assert type(case.method) is type(methods()[case.method.name])


def test_no_fit_depends_on_the_true_law(changed):
    """Options of all fits are the same if the constants of the true law differ. The law of the prior is another one."""
    scenes = ("BouncyBall", "ClayCat", "HoneyBottle")
    constants = {"law": {"elasticity": {"E": 4.2e4, "nu": 0.123}}}
    before, after = changed(), changed(scenes=dict.fromkeys(scenes, constants))
    for scene in scenes:
        for name in before.methods:
            one, other = (cases.case(settings, scene, name) for settings in (before, after))
            assert one.scene_law != other.scene_law and other.scene_law["elasticity"]["nu"] == 0.123
            assert one.prior_law == other.prior_law and one.prior_law not in (one.scene_law, other.scene_law)
            if one.method.product:
                assert one.method.fit_options(one) == other.method.fit_options(other), name
