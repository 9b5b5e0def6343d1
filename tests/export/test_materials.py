"""Materials of other engines: their formulas against our laws in NumPy, round trips, and refusals."""

import json
import math
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from neuma_lib.cli import main
from neuma_lib.errors import InputError
from neuma_lib.evaluation.material_point import returned, stress
from neuma_lib.export.laws import import_law, law_for_engine
from neuma_lib.export.materials import ENGINES, RULES, engine_law, engine_material
from neuma_lib.export.nearest import nearest, sampled_states, trial_states
from neuma_lib.io.exported import about_law
from neuma_lib.io.laws import load_law, save_law
from neuma_lib.io.mjcf import read_elasticity
from neuma_lib.mechanics.analytic import analytic_law
from neuma_lib.mechanics.neural import neural_law
from neuma_lib.mechanics.structured import structured_law
from tests.support.errors import refused

pytestmark = pytest.mark.core

DT, RHO = 5e-4, 900.0
MODULI = {"E": 3e4, "nu": 0.3}
CONSTANTS = {
    "identity": {},
    "von_mises": {"yield_stress": 1.2e3},
    "drucker_prager": {"friction_angle": 25.0},
    "cohesive_drucker_prager": {"friction_angle": 30.0, "cohesion": 400.0},
    "fluid_projection": {},
    "viscous_flow": {"viscosity": 4.0},
}
MAPPED = [(engine, *names) for engine in ENGINES for names in RULES[engine]]


def spec_of(elastic, plastic="identity", **constants):
    moduli = {key: constants.pop(key, value) for key, value in MODULI.items()}
    part = {"name": plastic, **CONSTANTS[plastic], **constants}
    return {"elasticity": {"name": elastic, **moduli}, "plasticity": part}


def states(count=200, size=0.08, J=None, seed=0):
    """Deformation gradients (count, 3, 3), with a given determinant if J is given."""
    F = np.eye(3) + size * np.random.default_rng(seed).standard_normal((count, 3, 3))
    return F if J is None else F * (J / np.linalg.det(F))[:, None, None] ** (1 / 3)


# Formulas of the engines, transcribed from genesis-world 1.4.5, newton 1.8.0 and the documentation of MuJoCo 4.0.0.


def genesis(kind, a, F_trial):
    """Kirchhoff stress after the return of trial states."""
    mu, lam = a.E / (2 * (1 + a.nu)), a.E * a.nu / ((1 + a.nu) * (1 - 2 * a.nu))
    mu, lam = getattr(a, "mu", mu), getattr(a, "lam", lam)
    U, S, Vh = np.linalg.svd(F_trial)
    U[:, :, 2] *= np.linalg.det(U)[:, None]
    Vh[:, 2] *= np.linalg.det(Vh)[:, None]
    J, eye, F, Ft = np.linalg.det(F_trial)[:, None, None], np.eye(3), F_trial, F_trial.transpose(0, 2, 1)
    if kind == "MPM.Elastic" and a.model == "neohooken":
        return mu * F @ Ft + eye * (lam * np.log(J) - mu)
    if kind == "MPM.Liquid":
        shear = 2 * mu * (F - U @ Vh) @ Ft if a.viscous else 0.0
        return shear + eye * lam * J * (J - 1)
    strain = np.log(S)
    deviator = strain - strain.mean(1, keepdims=True)
    norm = np.linalg.norm(deviator, axis=1, keepdims=True)
    if kind == "MPM.ElastoPlastic":
        excess = np.maximum(0, norm - a.von_mises_yield_stress / (2 * mu))
        F = U @ (np.exp(strain - excess / norm * deviator)[:, :, None] * Vh)
        J = np.linalg.det(F)[:, None, None]
    if kind == "MPM.Sand":
        sine, trace = math.sin(math.radians(a.friction_angle)), strain.sum(1, keepdims=True)
        alpha = math.sqrt(2 / 3) * 2 * sine / (3 - sine)
        excess = np.maximum(0, norm + (3 * lam + 2 * mu) / (2 * mu) * trace * alpha)
        strain = np.where(trace >= 0, 0, strain - excess / norm * deviator)
        principal = 2 * mu * strain + lam * strain.sum(1, keepdims=True)
        return U @ (principal[:, :, None] * U.transpose(0, 2, 1))
    return 2 * mu * (F - U @ Vh) @ F.transpose(0, 2, 1) + eye * lam * J * (J - 1)


def newton(kind, a, F_trial):
    """Stress times the undeformed volume, for a step in which the body flows without resistance of its inertia."""
    mu = a.young_modulus / (2 * (1 + a.poisson_ratio))
    lam = a.young_modulus * a.poisson_ratio / ((1 + a.poisson_ratio) * (1 - 2 * a.poisson_ratio))
    U, S, _ = np.linalg.svd(F_trial)
    strain = np.log(S)
    principal = 2 * mu * strain + lam * strain.sum(1, keepdims=True)
    mean = principal.mean(1, keepdims=True)
    deviator, pressure = principal - mean, -mean
    bounded = np.clip(pressure, -a.tensile_yield_ratio * a.yield_pressure, a.yield_pressure)
    limit = math.sqrt(2) * (
        a.yield_stress + a.friction * (bounded + a.tensile_yield_ratio * a.yield_pressure)
        if a.friction else a.yield_stress
    )  # fmt: skip
    norm = np.linalg.norm(deviator, axis=1, keepdims=True)
    relaxed = limit + (norm - limit) / (1 + mu * DT / a.viscosity) if a.viscosity else limit
    deviator = np.where(norm > limit, deviator * relaxed / norm, deviator)
    return U @ ((deviator - bounded)[:, :, None] * U.transpose(0, 2, 1))


def mujoco(kind, a, F):
    mu, lam = a.young / (2 * (1 + a.poisson)), a.young * a.poisson / ((1 + a.poisson) * (1 - 2 * a.poisson))
    green = 0.5 * (F.transpose(0, 2, 1) @ F - np.eye(3))
    trace = np.trace(green, axis1=1, axis2=2)[:, None, None]
    return F @ (2 * mu * green + lam * trace * np.eye(3)) @ F.transpose(0, 2, 1)


FORMULAS = {"genesis": genesis, "newton": newton, "mujoco": mujoco}


@pytest.mark.parametrize("engine, elastic, plastic", MAPPED)
def test_the_formula_of_the_engine_is_that_of_our_law(engine, elastic, plastic):
    spec = spec_of(elastic, plastic)
    material = engine_material(spec, RHO, DT, engine)
    approximate = {"fluid": 0.02, "viscous_flow": 0.02 if engine == "genesis" else 1e-9}
    tolerance = max(approximate.get(elastic, 1e-9), approximate.get(plastic, 1e-9))
    if engine == "genesis" and elastic == "fluid":
        tolerance = 1e-9
    J = None
    if "drucker" in plastic or elastic == "fluid":
        J = np.random.default_rng(1).uniform(0.9, 0.99, 200)
    F = states(size=2e-3 if tolerance > 1e-3 else 0.08, J=None if tolerance > 1e-3 else J)
    law = analytic_law(spec, DT)
    ours = stress(law, returned(law, torch.from_numpy(F))).numpy()
    theirs = FORMULAS[engine](material.kind, SimpleNamespace(**material.arguments), F)
    if (
        plastic == "viscous_flow" and engine == "genesis"
    ):  # a flow that has become steady: no elastic shear is left
        dev = lambda t: t - np.trace(t, axis1=1, axis2=2)[:, None, None] * np.eye(3) / 3  # noqa: E731
        strain = dev(0.5 * (F + F.transpose(0, 2, 1)))
        expected = 2 * CONSTANTS[plastic]["viscosity"] * strain / DT
        assert np.linalg.norm(dev(theirs) - expected) < tolerance * np.linalg.norm(expected)
        ours, theirs = (np.trace(t, axis1=1, axis2=2) for t in (ours, theirs))
    assert np.linalg.norm(theirs - ours) < tolerance * np.linalg.norm(ours)
    assert material.notes[0].startswith("same formula") == (
        tolerance == 1e-9 and "converted" not in material.notes[0]
    )


@pytest.mark.parametrize("engine, elastic, plastic", MAPPED)
def test_a_material_is_read_back_as_the_same_law(engine, elastic, plastic):
    spec = spec_of(elastic, plastic)
    material = engine_material(spec, RHO, DT, engine)
    again, density = engine_law(engine, material.kind, material.arguments, DT)
    assert density == (RHO if engine == "genesis" else None)
    F = torch.from_numpy(states(J=np.full(200, 0.97), size=0.05))
    if engine == "newton" and elastic == "fluid":  # read as the solid that newton simulates
        assert again["elasticity"]["name"] == "hencky" and again["plasticity"]["yield_stress"] == 0
        return
    one, other = (analytic_law(each, DT) for each in (spec, again))
    torch.testing.assert_close(
        stress(one, returned(one, F)), stress(other, returned(other, F)), rtol=1e-9, atol=1e-6
    )  # fmt: skip


def test_cohesion_is_the_tensile_strength_of_newton():
    spec = spec_of("hencky", "drucker_prager", cohesion=0.01)
    a = SimpleNamespace(**engine_material(spec, RHO, DT, "newton").arguments)
    F, law = states(J=np.full(200, 0.99), size=0.05), analytic_law(spec)
    ours = stress(law, returned(law, torch.from_numpy(F))).numpy()
    assert np.linalg.norm(newton("mpm", a, F) - ours) < 1e-9 * np.linalg.norm(ours)
    again, _ = engine_law("newton", "mpm", vars(a))
    assert again["plasticity"]["cohesion"] == pytest.approx(0.01, rel=1e-9)


def test_a_refusal_names_the_engines_that_have_the_law():
    with refused("law stvk + identity", problem="genesis has no such material", remedy="mujoco can"):
        engine_material(spec_of("stvk"), RHO, DT, "genesis")


# Fits.


def test_the_nearest_law_of_a_law_that_the_engine_has_is_that_law():
    for engine, elastic, plastic in MAPPED:
        if plastic in ("cohesive_drucker_prager", "viscous_flow"):
            continue
        spec = spec_of(elastic, plastic)
        J = np.full(300, 0.97) if plastic in ("drucker_prager", "fluid_projection") else None
        fit = nearest(analytic_law(spec), torch.from_numpy(states(300, 0.04, J)), engine, DT)
        assert fit.error < 1e-3, (engine, elastic, plastic, fit)
        assert fit.spec["elasticity"]["name"] == elastic


def test_a_fit_finds_the_small_strain_moduli_of_another_family():
    law = analytic_law(spec_of("ogden", **{}) | {"elasticity": {"name": "ogden", **MODULI, "alpha": 3.0}})
    fit = nearest(law, torch.from_numpy(states(300, 0.01)), "genesis", DT)
    assert fit.errors["stress"] < 0.03
    assert fit.spec["elasticity"]["E"] == pytest.approx(MODULI["E"], rel=0.02)


@pytest.mark.parametrize("engine", ENGINES)
def test_every_nearest_law_can_be_exported(engine):
    fit = nearest(analytic_law(spec_of("hencky")), torch.from_numpy(states(300, 0.15)), engine, DT)
    engine_material(fit.spec, RHO, DT, engine)


def test_trial_states_and_samples_stay_near_the_visited_ones():
    visited = {"stretch": [0.8, 1.15], "shear": [-0.2, 0.2], "pressed": 0.9}
    F = sampled_states(visited)
    sigma = torch.linalg.svdvals(F)
    ratio = (sigma[:, 0] / sigma[:, 2]).sqrt()
    assert sigma.min() >= 0.8 and sigma.max() <= 1.15 and torch.linalg.det(F).min() >= 0.9 - 1e-12
    assert (ratio - 1 / ratio).max() <= 0.2 + 1e-12
    assert (
        0 < (torch.linalg.svdvals(trial_states(F)).log().std() - sigma.log().std()) < 0.5 * sigma.log().std()
    )


def test_networks_need_a_fit_and_a_bad_one_needs_force():
    law = neural_law(seed=0)
    known = about_law(
        law, DT, density=RHO, visited={"stretch": [0.8, 1.2], "shear": [-0.3, 0.3], "pressed": 0.8}
    )
    with refused(f"law {law.name}", problem="no networks", remedy="--fit"):
        law_for_engine(law, known, "genesis")
    with refused(f"law {law.name}", problem="stress error", remedy="--force"):
        law_for_engine(law, known, "mujoco", fit=True)
    material, about = law_for_engine(law, known, "mujoco", fit=True, force=True)
    assert about["fit"]["stress"] > 0.1 and material.arguments["young"] > 0


# Files.


@pytest.fixture
def law_file(tmp_path):
    def write(spec=None, name="law.safetensors", **known):
        law = analytic_law(spec or spec_of("stvk"), DT)
        std = {"E": {"value": 3e4, "log_std": 0.05}}
        save_law(
            tmp_path / name, law, about_law(law, **{"dt": DT, "density": RHO, "constants": std, **known})
        )
        return str(tmp_path / name)

    return write


@pytest.mark.parametrize("engine, suffix", [("mujoco", ".xml"), ("mujoco", ".json"), ("newton", ".json")])
def test_files_state_law_density_scale_step_grid_and_contact(law_file, tmp_path, engine, suffix, capsys):
    spec = spec_of("stvk" if engine == "mujoco" else "hencky")
    out = tmp_path / f"out{suffix}"
    assert main(["law", "export", law_file(spec), str(out), "--engine", engine]) == 0, capsys.readouterr().err
    text = out.read_text()
    for word in ('"E": 30000.0', "log_std", "density", "900", "scale", "substep", "constants of the material",
                 "Contact is no part of a law"):  # fmt: skip
        assert word in text, word
    spec_again = import_law(out, tmp_path / "again.safetensors")
    assert spec_again["elasticity"] == {**spec["elasticity"], "E": 3e4}
    same = load_law(tmp_path / "again.safetensors")
    F = torch.from_numpy(states())
    torch.testing.assert_close(stress(same, F), stress(load_law(law_file(spec), dt=DT), F))


def test_constants_fitted_on_a_grid_are_called_so(law_file, tmp_path):
    save = law_file(spec_of("stvk"), grid=32)
    assert main(["law", "export", save, str(tmp_path / "a.json"), "--engine", "mujoco"]) == 0
    assert "fitted on a grid of 32 cells" in (tmp_path / "a.json").read_text()


def test_a_scaled_law_is_converted_to_the_world(law_file, tmp_path):
    spec = spec_of("hencky", "von_mises")
    file = law_file(spec, scale=2.0)
    assert main(["law", "export", file, str(tmp_path / "a.json"), "--engine", "newton", "--world"]) == 0
    a = json.loads((tmp_path / "a.json").read_text())["arguments"]
    assert a["young_modulus"] == pytest.approx(3e4 / 4)
    assert a["yield_stress"] == pytest.approx(1.2e3 / 4 / math.sqrt(2)) and a["poisson_ratio"] == 0.3


def test_the_mesh_of_mjcf_has_the_mass_and_volume_of_the_cube(law_file, tmp_path):
    import xml.etree.ElementTree as ElementTree

    assert main(["law", "export", law_file(), str(tmp_path / "a.xml"), "--engine", "mujoco"]) == 0
    root = ElementTree.parse(tmp_path / "a.xml").getroot()
    bodies = root.findall("worldbody/body")
    x = np.array([[float(v) for v in body.get("pos").split()] for body in bodies])
    masses = np.array([float(body.find("inertial").get("mass")) for body in bodies])
    tets = np.array(root.find("deformable/flex").get("element").split(), int).reshape(-1, 4)
    edges = x[tets[:, 1:]] - x[tets[:, :1]]
    volumes = np.linalg.det(edges) / 6
    assert volumes.min() > 0 and volumes.sum() == pytest.approx(0.2**3, rel=1e-6)
    assert masses.sum() == pytest.approx(RHO * 0.2**3, rel=1e-6)
    lumped = np.bincount(tets.ravel(), np.repeat(RHO * volumes / 4, 4))
    np.testing.assert_allclose(masses, lumped, rtol=1e-5)
    assert read_elasticity(tmp_path / "a.xml") == {"young": 3e4, "poisson": 0.3, "damping": 0.0}


# Wrong uses: one clear line each.

HENCKY = {"name": "hencky", **MODULI}
WRONG_SPECS = {
    "unknown engine": ("bullet", spec_of("hencky"), "'bullet' must be one of genesis, newton, mujoco"),
    "unknown family": ("genesis", {"elasticity": {"name": "rubber"}}, "'rubber' is unknown"),
    "missing constant": ("mujoco", {"elasticity": {"name": "stvk", "E": 1e4}}, "nu: this constant is missing"),
    "hencky in genesis": ("genesis", spec_of("hencky"), "newton can"),
    "stvk in newton": ("newton", spec_of("stvk"), "mujoco can"),
    "plastic in mujoco": ("mujoco", {"elasticity": {"name": "stvk", **MODULI},
                                     "plasticity": {"name": "von_mises", "yield_stress": 1e3}}, "No engine can"),
    "ogden": ("newton", {"elasticity": {"name": "ogden", **MODULI, "alpha": 4.0}}, "No engine can"),
    "tait": ("genesis", {"elasticity": {"name": "tait", **MODULI}}, "No engine can"),
    "cohesive sand in genesis": ("genesis", spec_of("hencky", "drucker_prager", cohesion=0.01), "no cohesion"),
    "bingham in genesis": ("genesis", spec_of("hencky", "viscous_flow", yield_stress=9.0), "no yield stress"),
    "no strength in genesis": ("genesis", {"elasticity": {"name": "fixed_corotated", **MODULI},
                                           "plasticity": {"name": "von_mises", "yield_stress": 0.0}}, "newton"),
    "dilation in newton": ("newton", spec_of("hencky", "cohesive_drucker_prager", dilation_angle=5.0), "dilation"),
    "foam": ("newton", {"elasticity": HENCKY, "plasticity": {"name": "crushable_foam", "crush": 1e3, "tension": 1e2,
                                                             "slope": 1.0}}, "No engine can"),
    "other moduli": ("newton", {"elasticity": HENCKY, "plasticity": {"name": "von_mises", "yield_stress": 1e3,
                                                                     "E": 1e5, "nu": 0.3}}, "must equal elasticity.E"),
}  # fmt: skip


@pytest.mark.parametrize("case", WRONG_SPECS)
def test_an_unsupported_part_is_refused(case):
    engine, spec, words = WRONG_SPECS[case]
    if case == "no strength in genesis":
        words = "must be greater than 0 Pa"
    with pytest.raises(InputError) as info:
        engine_material(spec, RHO, DT, engine)
    assert (
        type(info.value).__name__ == "InputError" and words in str(info.value) and "\n" not in str(info.value)
    )


@pytest.mark.parametrize(
    "density, substep, words",
    [(None, DT, "density: is missing"), (RHO, None, "substep: is missing"), (-1.0, DT, "-1.0 must be"),
     ([800.0, 900.0], DT, "must be one positive number"), (RHO, math.inf, "inf must be")],
)  # fmt: skip
def test_density_and_step_are_needed(density, substep, words):
    with pytest.raises(InputError) as info:
        engine_material(spec_of("stvk"), density, substep, "mujoco")
    assert words in str(info.value) and "\n" not in str(info.value)


WRONG_MATERIALS = {
    "class": ("genesis", "MPM.Snow", {}, "'MPM.Snow' must be one of"),
    "argument": ("genesis", "MPM.Elastic", {"stiffness": 1}, "MPM.Elastic.stiffness: is unknown"),
    "text": ("genesis", "MPM.Elastic", {"E": "soft"}, "'soft' must be a number"),
    "model": ("genesis", "MPM.Elastic", {"model": "stvk"}, "'stvk' must be one of"),
    "stretches": ("genesis", "MPM.ElastoPlastic", {"use_von_mises": False}, "limits of stretches"),
    "no step": ("genesis", "MPM.Liquid", {"viscous": True}, "substep: is missing"),
    "bounds": ("genesis", "MPM.Sand", {"nu": 0.6}, "must lie between"),
    "damping": ("newton", "mpm", {"young_modulus": 1e4, "damping": 0.1}, "no counterpart"),
    "hardening": ("newton", "mpm", {"young_modulus": 1e4, "hardening": 1.0}, "no counterpart"),
    "rigid grains": ("newton", "mpm", {"friction": 0.6}, "is rigid"),
    "crushing": ("newton", "mpm", {"young_modulus": 1e4, "yield_pressure": 1e4}, "crushing"),
    "both": ("newton", "mpm", {"young_modulus": 1e4, "yield_stress": 10.0}, "together"),
    "steep": ("newton", "mpm", {"young_modulus": 1e4, "friction": 2.0}, "90 degrees"),
    "flex damping": ("mujoco", "elasticity", {"young": 1e4, "damping": 0.1}, "no counterpart"),
    "no modulus": ("mujoco", "elasticity", {}, "young: is missing"),
}


@pytest.mark.parametrize("case", WRONG_MATERIALS)
def test_a_material_without_counterpart_is_refused(case):
    engine, kind, arguments, words = WRONG_MATERIALS[case]
    with pytest.raises(InputError) as info:
        engine_law(engine, kind, arguments)
        analytic_law(engine_law(engine, kind, arguments)[0])
    assert (
        type(info.value).__name__ == "InputError" and words in str(info.value) and "\n" not in str(info.value)
    )


def test_wrong_commands_print_one_line(law_file, tmp_path, capsys):
    networks = tmp_path / "n.safetensors"
    scaled = law_file(scale=0.5, name="s.safetensors")
    plain = law_file()
    save_law(networks, neural_law(), about_law(neural_law(), DT, density=RHO))
    corrected = tmp_path / "c.safetensors"
    law = structured_law({**spec_of("hencky"), "form": "stretch"}, DT)
    save_law(corrected, law, about_law(law, DT, density=RHO))
    (tmp_path / "two.xml").write_text("<mujoco/>")
    (tmp_path / "bad.json").write_text('{"engine": 3}')
    out = str(tmp_path / "o.json")
    wrong = {
        (plain, out, "--engine", "unity"): "must be one of genesis, newton, mujoco, usd",
        (plain, out, "--engine", "usd"): "the suffix is not .usda",
        (plain, str(tmp_path / "o.txt"), "--engine", "mujoco"): "mujoco reads .json or .xml",
        (plain, out, "--fit"): "--engine: is missing",
        (plain, out, "--engine", "mujoco", "--weight", "0.5"): "Leave them out",
        (law_file(density=None, name="d.safetensors"), out, "--engine", "mujoco"): "density: is missing",
        (law_file(dt=None, name="t.safetensors"), out, "--engine", "mujoco"): "substep: is missing",
        (scaled, out, "--engine", "mujoco"): "--world",
        (str(networks), out, "--engine", "genesis"): "no networks",
        (str(networks), out, "--engine", "genesis", "--fit"): "does not state the states",
        (str(corrected), out, "--engine", "genesis"): "no structured laws",
    }
    commands = {("law", "export", *words): text for words, text in wrong.items()}
    target = str(tmp_path / "l.safetensors")
    commands |= {
        ("law", "import", str(tmp_path / "two.xml"), target): "has 0 flexes",
        ("law", "import", str(tmp_path / "bad.json"), target): "must have the texts",
        ("law", "import", str(tmp_path / "none.json"), target): "none.json",
        ("law", "import", str(tmp_path / "two.xml"), "l.pt"): "the suffix is not .safetensors",
        ("scene", "export", plain, out, "--engine", "newton"): "is not a folder",
    }
    for words, text in commands.items():
        assert main(list(words)) == 1, words
        printed = capsys.readouterr().err
        assert text in printed and printed.count("\n") == 1, (words, printed)
