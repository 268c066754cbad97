"""The family of artificial plants: the named plants, their stiffness by the figures of their parts, their budgets."""

from __future__ import annotations

import numpy as np
import pytest

from vsfsim.core.errors import SceneError
from vsfsim.physics.rods.model import build, sections
from vsfsim.scenes._artificial_kinds import BRANCH, JOINT, KINDS, LEAF, PETIOLE, PLANTS, TRUNK
from vsfsim.scenes.artificial_plant import (
    E_SHEATH,
    E_STEEL,
    YIELD_STRESS,
    blade_modulus,
    grow,
    round_modulus,
    wire_core,
)

BUDGET = {"wood_segments": 120, "leaf_segments": 300}


def planted(name, seed=0, **options):
    return grow({"plant": name, **BUDGET, **options}, np.random.default_rng(seed), where="test")


@pytest.fixture(scope="module")
def all_plants():
    return {name: planted(name) for name in PLANTS}


def test_there_are_24_named_plants_of_13_kinds_with_wood_and_leaves(all_plants):
    assert len(PLANTS) == 24 and {named.kind for named in PLANTS.values()} == set(KINDS) and len(KINDS) == 13
    for name, p in all_plants.items():
        count = np.bincount(p.region[1:], minlength=5)
        assert p.name == name and p.notes[0].startswith(name)
        assert count[TRUNK] + count[BRANCH] <= 1.1 * BUDGET["wood_segments"] and count[JOINT] >= 1
        assert 20 <= count[LEAF] and count[LEAF] + count[PETIOLE] <= BUDGET["leaf_segments"]
        assert 0.4 < p.nodes[:, 2].max() < 1.3 and p.nodes[1:, 2].min() >= 0.02
    order = [grow({**BUDGET}, np.random.default_rng(0), where="test", number=k).name for k in range(26)]
    assert order[:24] == list(PLANTS) and order[24] == order[0]


def test_parts_have_the_bending_stiffness_of_their_wires(all_plants):
    """docs/plants.md: a twig of 1.2 mm wire in 4 mm has 0.023 N m^2, a petiole of 0.5 mm in 2 mm 7.7e-4 N m^2; a leaf
    with a midrib of 0.5 mm 6 to 8e-4 N m^2 (a sheet of 0.2 GPa, 40 mm wide, 0.5 mm thick)."""
    def bending(outer, wire):
        return round_modulus(outer, wire, 0.0) * np.pi * outer**4 / 64.0

    # the source's sheath is a third to a tenth of the wire, so rounding to two figures is not what differs
    assert bending(0.004, 0.0012) == pytest.approx(0.023, rel=0.05)
    assert bending(0.002, 0.0005) == pytest.approx(7.7e-4, rel=0.05)
    assert bending(0.004, 0.0012) == pytest.approx(np.pi / 64 * (E_STEEL * 0.0012**4 + E_SHEATH
                                                                 * (0.004**4 - 0.0012**4)))
    leaf = blade_modulus(0.04, 0.0005, 0.0005, 2e8) * 0.04 * 0.0005**3 / 12.0
    assert 6e-4 < leaf < 8e-4
    # of rods up to 5.3 mm in a monstera's stalks, of petioles that stand for up to four
    bands = {BRANCH: (5e-3, 8.0), PETIOLE: (6e-4, 1.0), TRUNK: (0.15, 400.0)}
    for name, p in all_plants.items():
        bend = sections(p)[1][:, 1] * p.lengths()
        for region, (low, high) in bands.items():
            mine = bend[1:][p.region[1:] == region]
            assert not len(mine) or (low < mine.min() and mine.max() < high), (name, region, mine.min(), mine.max())


def test_a_pot_gives_way_with_its_rotational_stiffness():
    """A horizontal force on a trunk at the height h above the joint finds k_t / h^2 in series with the trunk."""
    p = planted("orange-tree", variation=0.0)
    trunk = [int(i) for i in np.flatnonzero(p.region == TRUNK)]
    tip = trunk[-1]
    m = build(p)
    joint = m.kphi[1, 1]  # E I / L of the segment that stands for the pot's filling
    assert 30.0 <= joint <= 100.0
    h = p.nodes[tip, 2] - p.nodes[0, 2]
    stiff = float(m.point_stiffness(np.array([tip]), np.ones(1), np.zeros((1, 3)), np.array([[1.0, 0.0, 0.0]]))[0])
    bend = sum(length * arm**2 / ei for length, arm, ei in
               ((p.lengths()[i], p.nodes[tip, 2] - 0.5 * (p.nodes[i] + p.nodes[p.parent[i]])[2],
                 m.kphi[i, 1] * p.lengths()[i]) for i in trunk))
    # the trunk leans a little, and the sum takes each segment's moment at its middle
    assert 1.0 / stiff == pytest.approx(h**2 / joint + bend, rel=0.05)


def test_thickness_tells_the_stiffness_of_a_plants_round_parts(all_plants):
    for name in ("orange-tree", "weeping-fig", "umbrella-tree"):
        p = all_plants[name]
        mine = np.flatnonzero(np.isin(p.region[1:], (TRUNK, BRANCH, PETIOLE))) + 1
        bend = np.log(sections(p)[1][mine, 1] * p.lengths()[mine])
        assert np.corrcoef(np.log(p.radius[mine]), bend)[0, 1] > 0.9, name


def test_plants_repeat_and_differ():
    a, b, c = planted("bamboo"), planted("bamboo"), planted("bamboo", seed=1)
    assert np.array_equal(a.nodes, b.nodes) and np.array_equal(a.young_modulus, b.young_modulus)
    assert len(a.nodes) != len(c.nodes) or not np.allclose(a.nodes, c.nodes)
    assert len({grow({"plant": "random", **BUDGET}, np.random.default_rng(k), where="t").name for k in range(12)}) > 5


@pytest.mark.parametrize(("options", "words"), [
    ({"plant": "orange-tre"}, "orange-tree"), ({"segments": 3}, "segments"), ({"wood_segments": 2}, "from 10 to 1000"),
    ({"variation": True}, "from 0 to 0.5"), ({"girth": 2.5}, r"girth is .* must be a number from 0\.5 to 2")])
def test_wrong_parameters_are_refused(options, words):
    with pytest.raises(SceneError, match=words):
        grow(options, np.random.default_rng(0), where="test.toml [object.shape]")


def test_wires_yield_at_their_plastic_moment_where_the_scene_says_so():
    """docs/plants.md: s_y d^3 / 6, 0.15 N m for a wire of 1.44 mm and 300 MPa; the figure of a leaf or petiole that
    stands for several is theirs together. Wood and the pot's filling do not yield."""
    assert wire_core(0.0014422496, 2.0)[1] == pytest.approx(2 * 0.15, rel=1e-6)
    assert planted("monstera").yielding is None
    for name in ("monstera", "orange-tree"):
        p = planted(name, yields=True)
        core, bend = p.yielding, sections(p)[1][:, 1] * p.lengths()
        wired = np.isin(p.region, (BRANCH, PETIOLE, LEAF))
        wired[0] = False
        assert (core[wired] > 0.0).all() and (core[p.region == JOINT] == 0.0).all()
        assert (core[p.region == TRUNK, 1] > 0.0).all() == (name == "monstera")  # its short trunk has a core
        assert (core[1:, 0] <= bend[1:] * (1 + 1e-9)).all() and np.median(core[wired, 0] / bend[wired]) > 0.8
        branch = p.region == BRANCH
        assert core[branch, 1] == pytest.approx(YIELD_STRESS * p.wire[branch] ** 3 / 6.0)


def test_girth_scales_diameters_and_wires_and_nothing_else():
    thin, thick = (planted("rubber-plant", girth=girth) for girth in (1.0, 1.3))
    round_part = np.isin(thin.region, (TRUNK, BRANCH, PETIOLE))
    assert np.array_equal(thin.parent, thick.parent) and np.array_equal(thin.nodes, thick.nodes)
    assert thick.radius[round_part] == pytest.approx(1.3 * thin.radius[round_part])
    assert thick.wire == pytest.approx(1.3 * thin.wire)
    leaf = thin.region == LEAF
    assert np.array_equal(thin.half_width[leaf], thick.half_width[leaf])
    assert (thick.young_modulus[leaf] > 1.5 * thin.young_modulus[leaf]).all()  # of the midrib, by the fourth power
    assert np.array_equal(planted("rubber-plant").young_modulus, thin.young_modulus)
