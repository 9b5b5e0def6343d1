"""Exported laws: complete files, time steps, released adaptors, and evaluation with numpy alone."""

import json
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import save_file

from neuma_lib.cli import main
from neuma_lib.evaluation.law_card import law_card
from neuma_lib.evaluation.law_export import export_law
from neuma_lib.io.exported import EXPORT, about_law, read_about
from neuma_lib.io.files import write_json
from neuma_lib.io.hdf5 import write_arrays
from neuma_lib.io.laws import load_adaptable, load_law, load_prior, save_adaptor, save_law, save_prior
from neuma_lib.io.weights import read_weights, write_weights
from neuma_lib.mechanics.adaptor import LAYER_KEYS
from neuma_lib.mechanics.analytic import analytic_law
from neuma_lib.mechanics.neural import NeuralElasticity, NeuralPlasticity, neural_law
from neuma_lib.mechanics.plasticity import PLASTICITIES
from neuma_lib.mechanics.structured import structured_law
from neuma_lib.mechanics.time_step import step_dependence
from neuma_lib.methods.constants import Constants
from neuma_lib.sim.model import MPM
from neuma_lib.sim.rollout import rollout
from neuma_lib.sim.state import State
from tests.support.errors import refused

pytestmark = pytest.mark.core

ROOT = Path(__file__).resolve().parents[2]
DT = 5e-4
HENCKY = {"name": "hencky", "E": 2e5, "nu": 0.3}
RETURNS = {
    "identity": {},
    "von_mises": {"yield_stress": 3e3},
    "drucker_prager": {"friction_angle": 30.0, "cohesion": 0.01},
    "fluid_projection": {},
    "viscous_flow": {"viscosity": 50.0, "yield_stress": 500.0},
    "crushable_foam": {"crush": 3e3, "tension": 1e3, "slope": 1.2, "relaxation": 2e-3},
    "herschel_bulkley": {"consistency": 20.0, "exponent": 1.5, "yield_stress": 100.0},
    "cohesive_drucker_prager": {"friction_angle": 35.0, "cohesion": 1e3, "dilation_angle": 10.0},
}
FOLLOWING = {"viscous_flow", "crushable_foam", "herschel_bulkley"}


def deformations(n=64, size=0.1, seed=0):
    generator = torch.Generator().manual_seed(seed)
    return torch.eye(3) + size * torch.randn(n, 3, 3, generator=generator)


def analytic(plastic="von_mises", elastic=HENCKY, dt=DT):
    return analytic_law({"elasticity": elastic, "plasticity": {"name": plastic, **RETURNS[plastic]}}, dt)


def networks(seed=0, size=30.0):
    """Random networks with stresses of a soft solid and a trained adaptor."""
    law = neural_law(seed=seed)
    for weight in law.elasticity.base:
        weight.data *= size ** (1 if weight.shape[0] == 9 else 0.5)
    return trained(law, seed)


def structured(plastic="von_mises", elastic=HENCKY, parts=("elasticity", "plasticity"), form="stretch"):
    spec = {"elasticity": elastic, "plasticity": {"name": plastic, **RETURNS[plastic]}, "form": form}
    return trained(structured_law(spec, DT, seed=3), 1, parts, rank=None)


def trained(law, seed, parts=("elasticity", "plasticity"), rank=4):
    law.attach_adaptor(rank=rank, seed=seed)
    generator = torch.Generator().manual_seed(seed)
    for name, part in law.parts.items():
        for change in part.adaptor.B if rank else part.adaptor.D:
            change.data = 0.3 * torch.randn(change.shape, generator=generator) * (name in parts)
    return law


def same(one, other, F=None, rel=0.0):
    F = deformations() if F is None else F
    for part in ("elasticity", "plasticity"):
        values = [getattr(law, part)(F).detach() for law in (one, other)]
        torch.testing.assert_close(*values, rtol=rel, atol=rel * float(values[1].abs().max()))


LAWS = {
    "networks": networks,
    "structured": structured,
    "structured, elastic": lambda: structured("identity"),
    "analytic": analytic,
    "analytic, viscous": lambda: analytic("viscous_flow"),
}


@pytest.mark.parametrize("make", LAWS.values(), ids=LAWS)
def test_a_law_is_written_and_read(tmp_path, make):
    law, path = make(), tmp_path / "law.safetensors"
    save_law(path, law, about_law(law, DT, scene="Cat", density=800.0))
    same(load_law(path), law)
    same(load_prior(path, dt=DT), law)
    about = read_about(path)
    assert (
        about["scene"] == "Cat"
        and about["density"] == 800.0
        and about["dt"] == DT
        and about["commit"] is None
    )
    assert about["units"]["length"] == "m" and about["schema"] == 1


@pytest.mark.parametrize("make", [networks, structured])
def test_separate_adaptor_keeps_its_weight(tmp_path, make):
    law, path = make(), tmp_path / "law.safetensors"
    save_law(path, law, about_law(law, DT), separate_adaptor=True)
    again = load_law(path)
    same(again, law)
    for each in (law, again):
        each.set_adaptor_weight(0.4)
    same(again, law)
    save_law(path, law, about_law(law, DT))  # merged with this weight
    same(load_law(path), law, rel=1e-6)


def test_separate_adaptor_is_merged_into_a_prior(tmp_path):
    """Otherwise a training, which attaches a new adaptor, would lose it."""
    law, path = networks(), tmp_path / "law.safetensors"
    save_law(path, law, about_law(law, DT), separate_adaptor=True)
    prior = load_adaptable(path, DT)
    prior.attach_adaptor(rank=4)
    same(prior, law, rel=1e-6)


def test_adaptor_file_of_a_structured_law_is_complete(tmp_path):
    law, path = structured(), tmp_path / "adaptor.safetensors"
    save_adaptor(path, law, None, 16.0, {})
    for load in (load_law, load_prior):
        same(load(path), law, rel=1e-6)


def test_equal_laws_give_equal_bytes(tmp_path):
    for name in "ab":
        save_law(tmp_path / name, networks(), about_law(networks(), DT), separate_adaptor=True)
    assert (tmp_path / "a").read_bytes() == (tmp_path / "b").read_bytes()


# The time step.


def returned(law, F):
    return law.plasticity.evaluate(F, law.plasticity.weights())


@pytest.mark.parametrize("plastic", PLASTICITIES)
def test_step_dependence_of_analytic_return_maps(plastic):
    """A map that does not depend on the step is a projection. For another map, two half steps equal a whole step, to
    second order in the step."""
    F = deformations(size=0.02).double()
    law = analytic(plastic)
    if plastic not in FOLLOWING:
        assert step_dependence(law) == "none"
        once = returned(law, F)
        torch.testing.assert_close(returned(law, once), once, rtol=0, atol=1e-12)
        return
    assert step_dependence(law) == "follows"

    def flow_and_gap(dt):
        one, half = analytic(plastic, dt=dt), analytic(plastic, dt=dt / 2)
        at_once, in_two = returned(one, F), returned(half, returned(half, F))
        return float((at_once - F).abs().max()), float((at_once - in_two).abs().max())

    (flow, gap), (less_flow, less_gap) = flow_and_gap(1e-6), flow_and_gap(5e-7)
    assert 0 < gap < 0.1 * flow
    assert less_flow == pytest.approx(flow / 2, rel=0.2) and less_gap < 0.35 * gap  # 1/4 in the limit


def test_step_dependence_of_networks():
    assert step_dependence(networks()) == "fixed"
    assert step_dependence(structured()) == "fixed"
    assert step_dependence(structured(parts=("elasticity",))) == "none"  # its return is von Mises'
    assert step_dependence(structured("viscous_flow", parts=("elasticity",))) == "follows"
    assert step_dependence(structured("identity")) == "none"
    law = networks()
    law.set_adaptor_weight(0.0)
    law.plasticity.base[-1].data.zero_()
    assert step_dependence(law) == "none"


@pytest.mark.parametrize("make", [networks, structured])
@pytest.mark.parametrize("load", [load_law, load_prior, load_adaptable])
def test_another_step_is_refused(tmp_path, make, load):
    law, path = make(), tmp_path / "law.safetensors"
    save_law(path, law, about_law(law, DT))
    load(path, dt=DT * (1 + 1e-9))
    with refused("law.safetensors: dt") as error:
        load(path, dt=2 * DT)
    assert "0.0005 s" in error.value.problem and "0.001 s" in error.value.problem


@pytest.mark.parametrize("make", [networks, structured])
def test_another_step_can_be_allowed(tmp_path, make):
    law, path = make(), tmp_path / "law.safetensors"
    save_law(path, law, about_law(law, DT))
    same(load_law(path, dt=2 * DT, any_time_step=True), law)
    assert main(["law", "export", str(path), str(tmp_path / "any.safetensors"), "--any-step"]) == 0
    same(load_prior(tmp_path / "any.safetensors", dt=2 * DT), law)
    assert read_about(tmp_path / "any.safetensors")["dt"] == DT


@pytest.mark.parametrize("make", [analytic, lambda *a: structured(*a, parts=("elasticity",))])
def test_laws_that_depend_on_the_step_are_adapted_to_it(tmp_path, make):
    path = tmp_path / "law.safetensors"
    for plastic, changes in {"von_mises": False, "viscous_flow": True}.items():
        law = make(plastic)
        save_law(path, law, about_law(law, DT))
        other, F = load_law(path, dt=DT / 2), deformations()
        wanted = analytic(plastic, dt=DT / 2)
        torch.testing.assert_close(other.plasticity(F), wanted.plasticity(F), rtol=0, atol=1e-5)
        assert changes == (not torch.allclose(other.plasticity(F), law.plasticity(F), atol=1e-4))


# Released adaptors.


def released(tmp_path, seed=0, rank=16):
    """Write a prior and an adaptor in the layout of the authors' files, and return the merged weights."""
    generator = torch.Generator().manual_seed(seed)
    prior, lora = {}, {}
    merged = {}
    for part, sizes in {"elasticity": (26.0, 40.0, 77.0), "plasticity": (0.9, 2.0, 4.6)}.items():
        base = neural_law(seed=seed).parts[part].base
        prior[part] = {key: size * W.data for key, size, W in zip(LAYER_KEYS, sizes, base, strict=True)}
        lora[part] = {}
        for key, W in prior[part].items():
            A = torch.randn(rank, W.shape[1], generator=generator) / W.shape[1] ** 0.5
            B = torch.randn(W.shape[0], rank, generator=generator)
            lora[part] |= {key.replace("weight", "lora_A"): A, key.replace("weight", "lora_B"): B}
            merged[f"{part}.{key}"] = W + 16 / rank * B @ A
    torch.save(prior, tmp_path / "jelly_0300.pt")
    torch.save({**lora, "loss": 0.1}, tmp_path / "1000_lora.pt")
    return merged


@pytest.mark.parametrize("rank", [16, 4])
def test_released_adaptors_are_merged_without_scale(tmp_path, rank):
    merged = released(tmp_path, rank=rank)
    law = load_law(tmp_path / "jelly_0300.pt", tmp_path / "1000_lora.pt")
    for kind, part in (NeuralElasticity, "elasticity"), (NeuralPlasticity, "plasticity"):
        wanted = kind(tuple(merged[f"{part}.{key}"] for key in LAYER_KEYS))(deformations())
        result = law.parts[part](deformations())
        torch.testing.assert_close(result, wanted, rtol=0, atol=1e-5 * float(wanted.abs().max()))
    law.set_adaptor_weight(0.0)
    same(law, load_prior(tmp_path / "jelly_0300.pt"))


def test_a_released_law_is_exported(tmp_path):
    merged = released(tmp_path)
    words = ["law", "export", tmp_path / "jelly_0300.pt", tmp_path / "law.safetensors", "--dt", "1e-3"]
    assert main([*map(str, words), "--adaptor", str(tmp_path / "1000_lora.pt")]) == 0
    same(load_law(tmp_path / "law.safetensors"), neural_law(merged), rel=1e-5)
    about = read_about(tmp_path / "law.safetensors")
    assert about["dt"] == 1e-3 and about["prior"] == "jelly_0300.pt" and about["metrics"] is None


DAMAGES = {
    "a layer is missing": lambda lora: lora["plasticity"].pop("final_layer.fc.lora_B"),
    "another shape": lambda lora: lora["elasticity"].update({"layers.0.fc.lora_A": torch.zeros(16, 9)}),
    "two ranks": lambda lora: lora["elasticity"].update({"layers.0.fc.lora_A": torch.zeros(4, 13)}),
    "not finite": lambda lora: lora["elasticity"]["layers.0.fc.lora_B"].fill_(float("nan")),
    "text": lambda lora: lora["elasticity"].update({"layers.0.fc.lora_A": "A"}),
    "a prior": lambda lora: lora.update({part: {} for part in ("elasticity", "plasticity")}),
    "no plasticity": lambda lora: lora.pop("plasticity"),
}


@pytest.mark.parametrize("damage", DAMAGES.values(), ids=DAMAGES)
def test_damaged_released_adaptors_are_refused(tmp_path, damage):
    released(tmp_path)
    lora = torch.load(tmp_path / "1000_lora.pt", weights_only=True)
    damage(lora)
    torch.save(lora, tmp_path / "1000_lora.pt")
    with refused("1000_lora.pt"):
        load_law(tmp_path / "jelly_0300.pt", tmp_path / "1000_lora.pt")


# Files with a wrong format.

METADATA = {
    "a later schema": {"schema": 2, "dt": DT},
    "no schema": {"dt": DT},
    "no keys": [],
    "a step of text": {"schema": 1, "dt": "1e-3"},
    "a step of zero": {"schema": 1, "dt": 0},
}


@pytest.mark.parametrize("about", METADATA.values(), ids=METADATA)
def test_invalid_metadata_is_refused(tmp_path, about):
    path = tmp_path / "law.safetensors"
    write_weights(path, neural_law().prior_state(), {EXPORT: about})
    for read in (read_about, load_law, load_prior):
        with refused("law.safetensors: export."):
            read(path)


def test_analytic_files_are_checked(tmp_path):
    path = tmp_path / "law.safetensors"
    law = analytic()
    save_law(path, law, about_law(law, DT))
    _, metadata = read_weights(path)
    for change in ({"E": -1.0}, {"E": "soft"}, {"name": "rubber"}, {"G": 3.0}):
        spec = {**metadata["analytic"], "elasticity": {**metadata["analytic"]["elasticity"], **change}}
        write_weights(path, {}, {**metadata, "analytic": spec})
        with refused("law.safetensors"):
            load_prior(path)
    save_law(path, law, about_law(law, DT))
    with refused("law.safetensors"):
        load_adaptable(path)


def test_a_failed_export_writes_nothing(tmp_path, capsys):
    law, bare = tmp_path / "law.safetensors", neural_law()
    save_law(law, bare, about_law(bare, DT))
    (tmp_path / "folder").mkdir()
    for words, complaint in (
        ([law, "new.npz"], "suffix is not .safetensors"),
        ([law, "new.safetensors", "--apart"], "no adaptor"),
        ([law, "new.safetensors", "--weight", "0.5"], "no adaptor"),
        ([law, "new.safetensors", "--weight", "0.5", "--separate"], "--separate"),
        ([law, "new.safetensors", "--dt", "1e-3"], "trained at a time step"),
        ([law, "new.safetensors", "--dt=-1"], "--dt: -1"),
        ([law, "new.safetensors", "--dt=0"], "--dt: 0"),
        ([law, "new.safetensors", "--dt=nan"], "--dt: nan"),
        ([law, "new.safetensors", "--dt=inf"], "--dt: inf"),
        (["missing.pt", "new.safetensors"], "does not exist"),
        ([tmp_path / "folder", "new.safetensors"], "config/config.yaml"),
    ):
        words = [str(tmp_path / w) if str(w).startswith("new") else str(w) for w in words]
        assert main(["law", "export", *words]) == 1
        captured = capsys.readouterr()
        assert complaint in captured.err and captured.err.count("\n") == 1 and not captured.out
        assert sorted(p.name for p in tmp_path.iterdir()) == ["folder", "law.safetensors"]


# From a folder of results.


def clay():
    return trained(neural_law(seed=2), 5)


@pytest.fixture
def project(tmp_path):
    """A project with the results of two methods on one scene."""
    shutil.copytree(ROOT / "config", tmp_path / "config")
    run = tmp_path / "results/ClayCat/neuma"
    save_prior(tmp_path / "results/priors/plasticine.safetensors", neural_law(seed=2), {})
    law = clay()
    save_adaptor(run / "adaptor.safetensors", law, 4, 16.0, {"stable": True})
    write_json(
        run / "metrics.json", {"tracer_rmse_mm": 3.5, "stable": True, "curve": [1.0], "diverged": None}
    )
    F = torch.stack([torch.eye(3).expand(50, 3, 3), deformations(50, 0.05)]).numpy()
    write_arrays(run / "rollout.h5", {"F": F, "frames": np.array([0, 9])}, {"dt": DT})
    results = {"law": {"elasticity": HENCKY, "plasticity": {"name": "viscous_flow", "viscosity": 80.0}}}
    write_json(tmp_path / "results/ClayCat/identified.json", results)
    (tmp_path / "results/ClayCat/constants").mkdir()
    return tmp_path


def test_a_folder_of_results_is_exported(project, capsys):
    pytest.importorskip("matplotlib")
    target, page = project / "out/law.safetensors", project / "out/law.png"
    words = ["law", "export", str(project / "results/ClayCat/neuma"), str(target), "--page", str(page)]
    assert main(words) == 0 and page.stat().st_size > 10_000
    same(load_law(target), clay(), rel=1e-6)
    assert main(["law", "show", str(target)]) == 0
    about = json.loads(capsys.readouterr().out.split("\n", 1)[1])
    assert about["metrics"] == {"tracer_rmse_mm": 3.5, "stable": True}
    assert (
        about | {"scene": "ClayCat", "method": "neuma", "prior": "plasticine", "dt": DT, "grid": 36} == about
    )
    assert about | {"density": 1000.0, "gravity": [0.0, -9.8, 0.0], "scale": 1.0, "kind": "networks"} == about
    # the frame before contact is left out, so that what is seen is what the other one has
    seen, sigma = about["visited"], torch.linalg.svdvals(deformations(50, 0.05).double())
    assert seen["stretch"] == pytest.approx([float(sigma[:, 2].min()), float(sigma[:, 0].max())])
    assert seen["shear_stress"] > 0
    card = target.with_suffix(".md").read_text()
    for text in ("ClayCat / neuma", "plasticine, 1.0", "36 cells", "| tracer RMSE [mm] | 3.5 |", f"{DT:g}"):
        assert text in card, text
    assert f"{seen['stretch'][0]:.4g}, {seen['stretch'][1]:.4g}" in card and "absorbed discretisation" in card
    assert "Other time steps" in card and "None" not in card


def test_a_card_states_what_is_known_and_what_the_law_is_not_for(tmp_path):
    """Unknown values have no row. Constants of the material hold on any grid and at any time step."""
    about = about_law(analytic_law({"elasticity": HENCKY}), None)
    card = law_card(about)
    assert "scene" not in card and "| grid |" not in card and "time step [s]" not in card
    assert "seen is unknown" in card and "another density" in card.lower()
    assert "Other grids" not in card and "Other time steps" not in card
    networks_about = about | {"step": "fixed", "dt": 1e-3, "grid": 24, "metrics": {"diverged_at_step": 7}}
    card = law_card(networks_about)
    assert "Other grids" in card and "Other time steps" in card and "at which it diverged" in card
    assert "Other time steps" not in law_card(networks_about | {"any_step": True})
    odd = law_card(about | {"scene": "a|b\nc", "visited": "x", "metrics": 3, "dt": "y"})
    assert "a/b c" in odd and all(
        line.startswith(("|", "#", "-", "`", "It")) for line in odd.splitlines() if line
    )


def test_constants_are_exported_with_their_step(project):
    target = project / "law.safetensors"
    assert main(["law", "export", str(project / "results/ClayCat/constants"), str(target)]) == 0
    assert load_law(target).plasticity.values["dt"] == DT
    assert load_law(target, dt=1e-3).plasticity.values["dt"] == 1e-3
    about = read_about(target)
    assert about["kind"] == "analytic" and about["prior"] is None and about["visited"] is None


def test_the_constants_of_the_material_are_exported_if_there_are_any(project):
    """They hold on any grid, while those of the fit state theirs."""
    file = project / "results/ClayCat/identified.json"
    on_grid = json.loads(file.read_text())["law"]
    material = {**on_grid, "plasticity": {"name": "viscous_flow", "viscosity": 70.0}}
    write_json(file, {"law": on_grid, "grid": 24, "material": {"law": material}})
    model = Constants().load({"identified": file}, {}, DT)
    assert model.law.grid == 24 and model.law.plasticity.values["viscosity"] == 80.0
    target = project / "law.safetensors"
    assert main(["law", "export", str(project / "results/ClayCat/constants"), str(target)]) == 0
    assert read_about(target)["grid"] is None and load_law(target).grid is None
    assert load_law(target).plasticity.values["viscosity"] == 70.0


def test_a_law_is_used_on_another_grid_with_a_warning(tmp_path, caplog):
    law = networks()
    save_adaptor(tmp_path / "adaptor.safetensors", law, 4, 16.0, {"grid": 24})
    save_prior(tmp_path / "prior.safetensors", neural_law(seed=2), {})
    learned = load_law(tmp_path / "prior.safetensors", tmp_path / "adaptor.safetensors")
    one = torch.full((1,), 1e-3)
    state = State.rigid(torch.tensor([[0.5, 0.5, 0.5]]), one, 1e-3 * one, (0.0, 0.0, 0.0))
    for grid, warned in ((24, False), (32, True), (32, False)):
        caplog.clear()
        rollout(MPM(grid, 1e-4), learned, state, steps=1, frames=[1])
        assert ("learned on a grid of 24" in caplog.text) == warned


def test_folders_without_a_law_are_refused(project, capsys):
    for name, complaint in {"spring_gaus": "no material law", "neumaa": "no method 'neumaa'"}.items():
        (project / "results/ClayCat" / name).mkdir()
        assert (
            main(["law", "export", str(project / "results/ClayCat" / name), str(project / "x.safetensors")])
            == 1
        )
        assert complaint in capsys.readouterr().err


# Other simulators.

READ = """
import sys
sys.path.insert(0, {examples!r})
import numpy as np
import {module}
F = np.load("F.npy")
for k in range({count}):
    elasticity, plasticity, about = {module}.load(f"law{{k}}.safetensors")
    np.savez(f"out{{k}}.npz", elasticity=elasticity(F), plasticity=plasticity(F))
foreign = [m for m in ("torch", "warp", "scipy", "taichi", "safetensors", "neuma_lib") if m in sys.modules]
sys.exit(f"imported {{foreign}}" if foreign else 0)
"""


def in_numpy(folder, laws, module):
    """Evaluate both parts of laws by an example, in a process without other packages; F in float64."""
    for k, law in enumerate(laws):
        save_law(folder / f"law{k}.safetensors", law, about_law(law, DT))
    F = deformations(size=0.15).double()
    F[0] = F[0] @ torch.diag(torch.tensor([1.0, -0.4, 1.0]).double())  # turned inside out
    np.save(folder / "F.npy", F.numpy())
    code = READ.format(module=module, examples=str(ROOT / "examples"), count=len(laws))
    subprocess.run([sys.executable, "-c", code], cwd=folder, check=True, timeout=120)
    return F, [np.load(folder / f"out{k}.npz") for k in range(len(laws))]


def assert_as_ours(law, F, result):
    for part in ("elasticity", "plasticity"):
        ours = getattr(law, part)
        value = ours.evaluate(F, tuple(w.detach().double() for w in ours.weights()))
        np.testing.assert_allclose(result[part], value, rtol=0, atol=1e-5 * float(value.abs().max()))
        moved = (value - (F if part == "plasticity" else 0)).abs().max()
        assert moved > 1e-3 or isinstance(ours, PLASTICITIES["identity"])


def test_numpy_example_evaluates_networks(tmp_path):
    law = networks()
    law.plasticity.base[-1].data *= 50
    F, (result,) = in_numpy(tmp_path, [law], "law_in_numpy")
    assert_as_ours(law, F, result)


def test_numpy_example_evaluates_every_law(tmp_path):
    laws = [
        make(plastic, {**HENCKY, "name": elastic})
        for make in (analytic, structured)
        for elastic in ("hencky", "neo_hookean", "fixed_corotated")
        for plastic in ("identity", "von_mises", "drucker_prager", "viscous_flow")
    ]
    laws.append(networks())  # are handed on
    F, results = in_numpy(tmp_path, laws, "isotropic_in_numpy")
    for law, result in zip(laws, results, strict=True):
        assert_as_ours(law, F, result)


def test_numpy_example_simulates_as_the_library(tmp_path, monkeypatch):
    """An oscillating and falling cube with a return map, in float64 with the law's float32 weights. The order of
    floating point operations differs."""
    monkeypatch.syspath_prepend(str(ROOT / "examples"))
    import isotropic_in_numpy
    import mpm_in_numpy

    law, path, grid, steps, dt = analytic(), tmp_path / "law.safetensors", 20, 30, DT
    save_law(path, law, about_law(law, dt))
    x = torch.cartesian_prod(*[torch.linspace(0.45, 0.55, 5, dtype=torch.float64)] * 3)
    v = 40.0 * (x - 0.5) * torch.tensor([1.0, -1.0, 0.5], dtype=torch.float64)
    volume = torch.full((len(x),), 0.125**3 / len(x), dtype=torch.float64)
    ours = rollout(
        MPM(grid=grid, dt=dt), law, State(x, v, 1000 * volume, volume), steps=steps, frames=[steps]
    )
    theirs = x.numpy(), v.numpy(), np.zeros((len(x), 3, 3)), np.tile(np.eye(3), (len(x), 1, 1))
    law_and_return = isotropic_in_numpy.load(path)[:2]
    for _ in range(steps):
        one = float(volume[0])
        theirs = mpm_in_numpy.step(*law_and_return, *theirs, 1000 * one, one, dt, grid, (0, -9.8, 0))
    assert (ours.x[0] - x).abs().max() > 1e-3 and (ours.F[0] - torch.eye(3)).abs().max() > 1e-2
    np.testing.assert_allclose(theirs[0], ours.x[0], rtol=0, atol=1e-9)
    np.testing.assert_allclose(theirs[3], ours.F[0], rtol=0, atol=1e-7)


def test_the_example_runs_from_the_command_line(tmp_path):
    law = analytic()
    export_law(tmp_path / "law.safetensors", law, 1e-3)
    command = [sys.executable, str(ROOT / "examples/mpm_in_numpy.py"), str(tmp_path / "law.safetensors")]
    printed = subprocess.run(command, check=True, timeout=60, capture_output=True, text=True).stdout
    assert printed.startswith("0.00 s: lowest 0.2") and "0.28 s" in printed


def test_other_safetensors_are_refused(tmp_path):
    save_file({"x": torch.zeros(2)}, tmp_path / "x.safetensors")
    with refused("x.safetensors"):
        read_about(tmp_path / "x.safetensors")
