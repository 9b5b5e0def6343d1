"""Fit of a law to markers on a released beam: a twin with a known law, and the parts that it is made of."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from neuma_lib.config.specimens import SpecimenConfig
from neuma_lib.coupling.markers import MarkerTracks
from neuma_lib.coupling.specimens import Beam, clamped_beam, clamped_body, released
from neuma_lib.fitting import specimen_fit
from neuma_lib.fitting.families import Family
from neuma_lib.fitting.specimen_fit import Place, Record, fit_specimen, numerical_damping, specimen_problem
from neuma_lib.fitting.vibration import fit_vibration
from neuma_lib.io.markers import read_markers
from neuma_lib.mechanics.analytic import analytic_law
from neuma_lib.sim.clamps import Clamp
from neuma_lib.sim.equilibrium import solve_equilibrium
from tests.support.errors import refused
from tests.support.markers import write_markers
from tests.support.settle import settle

BEAM = Beam(0.1, 0.03, 0.03, 1070.0)
LAW = {
    "elasticity": {"name": "neo_hookean", "E": 2.7e5, "nu": 0.4},
    "viscosity": {"name": "maxwell", "modulus": 2.2e4, "relaxation": 0.025},
}
MARKERS = np.array([[0.094, 0.014, 0.0], [0.095, 0.002, 0.02], [0.090, -0.015, -0.02]])
"""Places of the markers on the beam [m]."""


def twin(load, cells, noise=1e-4, release=0.1234, seed=1):
    """A record of the beam with a load [kg], in axes with the root at (-0.02, 0.06, 0.03) m."""
    own = replace(BEAM, load=load)
    specimen = clamped_beam(own, LAW, cells)
    path = specimen_fit._simulated(specimen, specimen.law(LAW), 1.2)(MARKERS)
    times = np.arange(0.0, 1.25, 0.01)
    x = np.array([-0.02, 0.06, 0.03]) + path(np.clip(times - release, 0.0, None))
    x += noise * np.random.default_rng(seed).standard_normal(x.shape)
    return MarkerTracks(times, x)


@pytest.mark.slow
def test_constants_and_damping_of_a_twin():
    """Constants within 5 % and damping within 10 % from wrong guesses, an uncertain place, and noise of 0.1 mm.

    The time constant of the branch is seen by the change of damping with frequency, that is from two loads.
    """
    records = [Record(f"{load}", twin(load, 3, seed=k), load) for k, load in enumerate((0.0, 0.05))]
    guess = {
        "elasticity": {**LAW["elasticity"], "E": 2.2e5},
        "viscosity": {"name": "maxwell", "modulus": 3e4, "relaxation": 0.02},
    }
    fit = fit_specimen(
        BEAM,
        Family("zener", guess),
        records,
        Place((-0.018, 0.003), (0.061, 0.002)),
        fitted=("E", "modulus", "relaxation"),
        cells=3,
        duration=0.7,
    )
    truth = {"E": 2.7e5, "modulus": 2.2e4, "relaxation": 0.025}
    assert all(abs(fit.values[name] / value - 1) < 0.05 for name, value in truth.items()), fit.values
    for record in fit.records:
        assert abs(record.release - 0.1234) < 2e-3
        assert record.largest < 0.03 * BEAM.length
        assert abs(record.predicted.damping / record.measured.damping - 1) < 0.1
        assert abs(record.predicted.frequency / record.measured.frequency - 1) < 0.01
    assert abs(fit.root + 0.02) < 3e-3 and abs(fit.axis - 0.06) < 1e-3


def test_numerical_damping_is_less_than_a_fifth_of_a_silicone():
    """Of 4 cells along the height, and less of 6 cells. Silicone has 0.053."""
    damping = [numerical_damping(BEAM, LAW, cells, 0.5).damping for cells in (4, 6)]
    assert 0 < damping[1] < damping[0] < 0.053 / 5


@pytest.mark.parametrize("cells", [3, 4])
def test_the_sag_of_a_beam(cells):
    """That of Timoshenko's beam, to 3 % of bending and the 0.7 % by which a root without warping is stiffer (nu = 0.3).

    The clamp ends before a node at the root. Another end of the clamp changes it by up to 20 %.
    """
    E, nu, L, h, z = 2.7e5, 0.4, BEAM.length, BEAM.height, 0.095
    spec = {"elasticity": {"name": "neo_hookean", "E": E, "nu": nu}}
    specimen = clamped_beam(BEAM, spec, cells, torch.float64)
    quiet = int(0.1 / specimen.model.dt)
    rest = settle(specimen.model, specimen.law(spec), specimen.start, tolerance=2e-3, quiet=quiet)
    x = specimen.to_world(specimen.start.x)
    tip = (x[:, 0] > 0.09) & (x[:, 0] < L)
    sag = float((x - specimen.to_world(rest.x))[tip, 1].mean())
    bending = 12 * z * z * (6 * L * L - 4 * L * z + z * z) / (24 * h * h) / E
    shear = (L * z - z * z / 2) * 6 / 5 * 2 * (1 + nu) / E
    expected = BEAM.density * BEAM.gravity * (bending + shear)
    assert abs(sag / expected - 1) < 0.04


def test_a_beam_that_is_released_in_its_equilibrium_stays_there():
    """Positions and deformation of the particles are those of the equilibrium on the mesh. The sag of the particles is
    up to 8 % larger at 3 cells, and the beam vibrates about it with that amplitude, instead of the whole sag."""
    spec = {"elasticity": {"name": "neo_hookean", "E": 2.7e5, "nu": 0.4}}
    mesh, gravity = BEAM.mesh(), (0.0, -BEAM.gravity, 0.0)
    rest = solve_equilibrium(mesh, analytic_law(spec, 1e-3), BEAM.density, gravity, [BEAM.clamp])
    specimen = clamped_beam(BEAM, spec, 3, torch.float64, held=(mesh, rest))
    end = (specimen.places[:, 0] > 0.09).numpy()
    _, x = released(specimen, specimen.law(spec), 0.15, 0.01)
    drop = (specimen.places[:, 1] - x[..., 1])[:, end].mean(1)
    assert 5.8e-3 < drop[0] < 6.6e-3
    assert 0 <= float(drop.min() / drop[0] - 1) + 1e-3 and float(drop.max() / drop[0]) < 1.17
    with refused("clamp", problem="0 of its faces"):
        clamped_body(mesh, Clamp((0.3, -1, -1), (0.4, 1, 1)), 1000.0, gravity, spec, 0.01)


def test_a_load_adds_its_mass_at_the_upper_edge_of_the_free_end():
    loaded, plain = (clamped_beam(replace(BEAM, load=load), LAW, 3) for load in (0.05, 0.0))
    count = len(plain.start.x)
    assert torch.equal(loaded.start.x[:count], plain.start.x)
    assert float(loaded.start.mass[count:].double().sum()) * loaded.edge**3 == pytest.approx(0.05, rel=1e-5)
    x = loaded.to_world(loaded.start.x[count:].double())
    torch.testing.assert_close(
        x[:, :2], torch.tensor([0.1, 0.015]).double().expand(len(x), 2), rtol=0, atol=1e-6
    )
    assert float(x[:, 2].mean()) == pytest.approx(0.0, abs=1e-6)
    assert float(plain.start.mass.double().sum()) * plain.edge**3 == pytest.approx(
        1070 * 0.03**2 * (0.1 + 3 * 0.01), rel=1e-5
    )


def test_the_law_is_scaled_to_the_cube():
    """Waves cross the same share of the beam in the same time, and the viscous part keeps its share."""
    specimen = clamped_beam(BEAM, LAW, 3)
    law, world = specimen.law(LAW), analytic_law(LAW, specimen.model.dt)
    assert law.wave_speed(1070.0) * specimen.edge == pytest.approx(world.wave_speed(1070.0), rel=1e-4)
    assert law.viscosity.values["relaxation"] == 0.025
    specimen.model.check_courant(law, 1070.0)


@pytest.mark.parametrize(("frequency", "damping", "phase"), [(7.75, 0.053, 0.3), (3.3, 0.01, 2.5)])
def test_frequency_and_damping_of_a_known_vibration(frequency, damping, phase):
    w, t = 2 * math.pi * frequency, np.arange(0.0, 1.0, 0.01)
    values = -6.0 + 5.0 * np.exp(-damping * w * t) * np.cos(w * t + phase)
    fit = fit_vibration(t + 2.0, values)
    assert (fit.rest, fit.amplitude, fit.frequency, fit.damping) == pytest.approx(
        (-6, 5, frequency, damping), rel=1e-4
    )
    assert math.cos(fit.phase - phase) == pytest.approx(1, abs=1e-6)


def test_files_of_markers(tmp_path):
    """Columns by name, in metres, in turned axes; and refusals of what is missing."""
    tracks = twin(0.0, 2, noise=0.0)
    write_markers(tmp_path / "a.csv", tracks, ("p", "q", "r"))
    read = read_markers(tmp_path / "a.csv", ("q", "p"))
    np.testing.assert_allclose(read.positions, tracks.positions[:, [1, 0]], atol=1e-6)
    turned = read.turned("z", "-x")
    np.testing.assert_allclose(turned.positions[..., 0], read.positions[..., 2])
    np.testing.assert_allclose(turned.positions[..., 1], -read.positions[..., 0])
    assert np.linalg.det(np.array([[0, 0, 1], [-1, 0, 0], [0, -1, 0]])) > 0
    np.testing.assert_allclose(turned.positions[..., 2], -read.positions[..., 1])
    assert tracks.release() == twin(0.0, 2, noise=2e-4).release() == pytest.approx(0.13, abs=0.011)
    with refused("a.csv"):
        read_markers(tmp_path / "a.csv", ("s",))
    (tmp_path / "b.csv").write_text("t_s,p_x_m,p_y_m,p_z_m\n0,1,,2\n")
    with refused("b.csv"):
        read_markers(tmp_path / "b.csv", ("p",))
    with refused("markers"):
        MarkerTracks(np.array([0.0, 0.1, 0.1, 0.2]), np.zeros((4, 1, 3)))


def test_settings_describe_the_problem():
    settings = SpecimenConfig(
        folder="x",
        records=[{"file": "a.csv", "load": 0.05}],
        markers=["p"],
        along="z",
        up="x",
        size=(0.1, 0.03, 0.02),
        density=1000.0,
        root=(0.0, 1e-3),
        axis=(0.0, 1e-3),
        law=LAW,
        fitted=["E", "modulus"],
    )
    tracks = MarkerTracks(np.arange(4.0), np.ones((4, 1, 3)) * np.array([1.0, 2.0, 3.0]))
    beam, family, records, place = specimen_problem(settings, [tracks], ["a"])
    assert beam == Beam(0.1, 0.03, 0.02, 1000.0) and place == Place((0.0, 1e-3), (0.0, 1e-3))
    assert family.guess["modulus"] == 2.2e4 and records[0].load == 0.05
    assert records[0].tracks.positions[0, 0].tolist() == [3.0, 1.0, 2.0]
    for change, where in (
        ({"fitted": ["G"]}, "constant"),
        ({"up": "-z"}, "axis"),
        ({"cells": [1]}, "at least 2"),
    ):
        with pytest.raises(ValueError, match=where):
            SpecimenConfig(**{**settings.plain(), **change})
