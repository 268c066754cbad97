"""The reference data against the scripts that compute them, and the scripts' own consistency."""

from pathlib import Path

import numpy as np
import pytest

import references
from references.closed_forms import comparisons
from references.flat_punch import stiffness
from references.soft_block import Block, Press, curve, s1
from references.soft_block_foam import FoamPress
from references.soft_block_inclusion import half_block, s2

FOLDER = Path(references.__file__).parent


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


def test_a_flat_punch_gives_the_stored_values():
    stored = references.load("flat_punch")
    for side, found in zip(stored["side_m"][:2], stored["stiffness_by_cells_N_per_m"], strict=False):
        assert stiffness(side, stored["cells_over_half"][0]) == pytest.approx(found[0], rel=1e-6)


@pytest.fixture(scope="module", params=["neo-hooke", "foam"])
def pressed(request):
    """A coarse quarter block under a sphere, displaced at random, in contact."""
    block = Block.quarter((0.1, 0.1, 0.05), 0.02, 0.02, 1.5, 3)
    rows = np.array(references.load("foam_block")["setting"]["mu_alpha_beta"])
    press = Press(block, 1e5, 0.45, 0.02) if request.param == "neo-hooke" else FoamPress(block, rows, 0.02)
    press.centre[2] -= 0.004
    rng = np.random.default_rng(0)
    u = np.zeros(press.u.size)
    u[press.block.free] = 2e-4 * rng.standard_normal(len(press.block.free))
    return press, u.reshape(-1, 3), rng


def test_forces_are_the_gradient_of_the_energy(pressed):
    press, u, rng = pressed
    assert press.contact(u)[2].max() > 0.0
    way = np.zeros(u.size)
    way[press.block.free] = rng.standard_normal(len(press.block.free))
    way = way.reshape(-1, 3)
    step = 1e-8
    slope = (press.energy(u + step * way) - press.energy(u - step * way)) / (2.0 * step)
    # central differences: rounding of the energy over the step, 1e-16 / 1e-8
    assert (press.unbalanced(u) * way).sum() == pytest.approx(slope, rel=1e-5)


def test_the_tangent_is_the_gradient_of_the_forces(pressed):
    press, u, rng = pressed
    free = press.block.free
    way = np.zeros(u.size)
    way[free] = rng.standard_normal(len(free))
    step = 1e-9
    change = (press.unbalanced(u + step * way.reshape(-1, 3)) - press.unbalanced(u - step * way.reshape(-1, 3)))
    expected = change.reshape(-1)[free] / (2.0 * step)
    found = press.tangent(u) @ way[free]
    # points that enter or leave contact within the step have no second derivative
    assert np.linalg.norm(found - expected) < 1e-3 * np.linalg.norm(expected)


def test_the_mesh_of_s2_conforms_to_the_inclusion():
    setting = references.load("s2")["setting"]
    block, stiff = half_block(tuple(setting["block_m"]), np.array([0.015, 0.0, 0.03798]), 0.012, 4, 1)
    assert block.weights.sum() == pytest.approx(0.5 * np.prod(setting["block_m"]), rel=1e-12)
    assert block.face_weights.sum() == pytest.approx(0.5 * np.prod(setting["block_m"][:2]), rel=1e-12)
    # quadratic faces on the sphere: 1.1e-4 too little on this mesh
    assert block.weights[stiff].sum() == pytest.approx(2.0 / 3.0 * np.pi * 0.012**3, rel=2e-4)
    # every side that belongs to one element alone lies on the surface: the parts of the mesh are connected
    grid = block.cells.reshape(-1, 3, 3, 3)
    sides = np.concatenate([np.take(grid, end, axis=k).reshape(-1, 9) for k in (1, 2, 3) for end in (0, 2)])
    found, count = np.unique(np.sort(sides, axis=1), axis=0, return_counts=True)
    corners = block.points[found[count == 1]]
    outside = (np.abs(corners - block.points.min(axis=0)) < 1e-9) | (np.abs(corners - block.points.max(axis=0)) < 1e-9)
    assert outside.all(axis=1).any(axis=1).all()


@pytest.mark.slow
def test_s1_is_recomputed():
    """Cells of 5 mm at the contact; finer ones come nearer, see references/README.md."""
    data = references.load("s1")
    force = curve(s1(0.005, data["setting"]), [0.0025, 0.005])
    stored = np.interp([0.0025, 0.005], data["depth_m"], data["force_N"])
    # 1.3 % and 0.7 % too large on this mesh
    assert force == pytest.approx(stored, rel=0.015)


@pytest.mark.slow
def test_s2_is_recomputed():
    """Four elements along the inclusion's box, cells of 7.5 mm at the contact."""
    data = references.load("s2")
    force = curve(s2(4, data["setting"]), data["depth_m"])
    # 4.0 % and 6.6 % too large on this mesh
    assert force == pytest.approx(data["force_N"], rel=0.07)
    assert force == pytest.approx(data["recomputed"]["force_N"][data["recomputed"]["cell_m"].index(0.0075)], rel=1e-3)
