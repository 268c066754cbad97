"""The reference data against the scripts that compute them, and the scripts' own consistency."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest

import references
from references.cells import BASE, CELLS, Cell
from references.closed_forms import comparisons
from references.presses import FACTOR, build, limit

FOLDER = Path(references.__file__).parent
BLOCK = ("cylinder", 0.06, 0.03)


def test_every_reference_says_where_it_comes_from_and_is_in_the_index():
    index = (FOLDER / "README.md").read_text()
    files = sorted(FOLDER.glob("*.json"))
    assert files
    for path in files:
        assert references.load(path.stem)["origin"] and f"`{path.name}`" in index, path
    for script in FOLDER.glob("[!_]*.py"):
        assert f"`{script.name}`" in index, script


def test_closed_forms_give_the_stored_values():
    found = comparisons()
    assert len(found) > 30
    # the stored values have five digits or more
    assert {what: computed for what, computed, stored in found if computed != pytest.approx(stored, rel=3e-5)} == {}


@pytest.mark.parametrize("cell", [
    Cell(BLOCK, ("sphere", 0.02), 0.004), Cell(BLOCK, ("sphere", 0.02), 0.004, foam="pe-foam"),
    Cell(("box", 0.06, 0.05, 0.03), ("capsule", 0.006, 0.012), 0.003, 0.3, at=0.01)])
def test_forces_are_the_gradient_of_the_energy_and_the_tangent_theirs(cell):
    """At random displacements, in contact, in the half plane and in space."""
    press, origins = build(cell, 1.3)
    rng, there = np.random.default_rng(0), origins[-1]
    u, way = np.zeros((2, press.basis.N))
    u[press.free], way[press.free] = 1e-4 * rng.standard_normal(len(press.free)), rng.standard_normal(len(press.free))
    assert press.contact(u, there)[0].min() < 0.0

    def rest(u):
        return sum(press.forces(u, there))

    slope = (press.energy(u + 1e-8 * way, there) - press.energy(u - 1e-8 * way, there)) / 2e-8
    assert rest(u) @ way == pytest.approx(slope, rel=1e-5)  # central differences: rounding of the energy over the step
    change = ((rest(u + 1e-9 * way) - rest(u - 1e-9 * way)) / 2e-9)[press.free]
    # points that enter or leave contact within the step have no second derivative
    assert np.linalg.norm(press.tangent(u, there) @ way[press.free] - change) < 2e-3 * np.linalg.norm(change)


@pytest.mark.slow
def test_a_small_press_is_that_of_hertz_and_a_flat_punch_that_of_sneddon():
    """On bodies over a hundred and 20 times as large as the contact."""
    hertz = Cell(("cylinder", 0.2, 0.2), ("sphere", 0.02), 4e-4, 0.3)
    press, origins = build(hertz, 4.0)
    expected = 4.0 / 3.0 * BASE / (1.0 - 0.3**2) * np.sqrt(0.02 * 4e-4) * 4e-4
    assert press.curve(origins)[-1] == pytest.approx(expected, rel=0.03)
    punch = Cell(("cylinder", 0.1, 0.1), ("cylinder", 0.005), 1e-4, 0.3)
    press, origins = build(punch, 3.0)
    assert press.curve(origins)[0] == pytest.approx(2.0 * BASE / (1.0 - 0.3**2) * 0.005 * 2e-5, rel=0.06)


def test_a_body_has_its_volume_and_its_parts():
    ball = Cell(("sphere", 0.025), ("plane",), 0.002)
    assert build(ball, 3.0)[0].dx.sum() == pytest.approx(4.0 / 3.0 * np.pi * 0.025**3, rel=2e-3)
    inside = Cell(BLOCK, ("sphere", 0.02), 0.003, parts=(("sphere", 0.0, 0.015, 0.01, 30.0),))
    press, _ = build(inside, 4.0)
    stiff = press.law.mu[:, 0] > press.law.mu.min() * 2.0
    assert press.dx[stiff].sum() == pytest.approx(4.0 / 3.0 * np.pi * 0.01**3, rel=2e-3)


def test_curves_are_extrapolated_by_their_own_order():
    exact, meshes = np.array([1.0, 3.0]), FACTOR ** -np.arange(3.0)
    found, error = limit(exact + 0.1 * np.multiply.outer(meshes**2, exact))
    assert found == pytest.approx(exact, rel=1e-6) and (error < 0.05).all()
    found, error = limit([[1.0, 3.0], [1.1, 3.3], [1.0, 3.0]])  # no order: the spread
    assert found == pytest.approx(exact) and error == pytest.approx([0.125, 0.125])


@pytest.mark.slow
def test_s1_is_recomputed():
    """On 2.5 elements over the contact's radius, by vsfsim's law, which is 0.3 % softer there than that of the file."""
    data = references.load("s1")
    assert dataclasses.astuple(CELLS[0])[:3] == (("box", *data["setting"]["block_m"]), ("sphere", 0.02), 0.005)
    press, origins = build(CELLS[0], 2.5)
    assert press.curve(origins)[-1] == pytest.approx(data["force_N"][-1], rel=0.01)
