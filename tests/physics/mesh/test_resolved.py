"""Which frames mesh and tier do not resolve, that what can be resolved is, and round faces against Hertz."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from scipy.optimize import brentq
from scipy.special import ellipe, ellipk
from texts import scene

from references.closed_forms import hertz_layer
from vsfsim.core.errors import SceneError
from vsfsim.core.scene_tables.request import Request
from vsfsim.generate.effectors.probe import press
from vsfsim.physics.mesh.resolved import LIMIT, corner_det_f, resolved


def pressed(radius, depth, *, tier="fem-coarse", at=(0.0, 0.0), top=0.05, above=0.0, frames=3, parts="", **keys):
    """A press of a block by a ball, which ``parts`` may go with."""
    high = top + radius + above
    given = {"shape": "{ box = [0.1, 0.1, 0.05] }", "poisson_ratio": 0.45, "resolution": None, **keys}
    return press(scene("block", probe=f"{{ shape = {{ sphere = {radius} }}{parts} }}", press=f"""\
{{ path = {[[*at, high], [*at, high - depth]]}, frames = {frames} }}""", **given).sample(0), Request(tier=tier))


def test_a_small_ball_on_coarse_elements_is_marked_with_a_figure_and_one_that_the_mesh_resolves_is_not():
    result, good = pressed(0.003, 0.010, resolution=0.015), pressed(0.02, 0.005)
    assert not result.resolved.any() and (result.more["mesh_error"][result.converged] > LIMIT).all()
    assert "NOT RESOLVED" in result.text() and "NOT RESOLVED" not in good.text()
    assert "does NOT resolve the contact in 3 of 3 frames" in result.text()
    assert good.resolved.all() and (good.more["mesh_error"] < 0.06).all()
    felt_by_none = press_of("box = [0.02732, 0.02732, 0.001851]", {"resolution": 0.00759}, "sphere = 0.005121",
                            0.006972, 6e-5, frames=3, tier="fem-coarse")  # it lies between contact points, .04 mm deep
    assert felt_by_none.normal_force[1] == 0.0 and not felt_by_none.resolved[1]


def test_a_wall_that_bends_is_not_marked_for_its_small_contact():
    """A plate of 6 mm that is held along one side. On elements of 2.5 mm the forces at 1.8, 3.2, 4.6 and 6 mm are 7.9,
    14.8, 22.6 and 31.2 mN; those on 12 mm are off by 3, 1, 8 and 4 %, said to be by 10, 6, 5 and 4 %."""
    result = pressed(0.03, 0.007, at=(0.02, 0.0), top=0.006, above=0.001, frames=5, poisson_ratio=0.3, resolution=0.012,
                     shape="{ box = [0.1, 0.1, 0.006] }", fixed=[-0.06, -0.06, -1.0, -0.03, 0.06, 1.0])
    force = np.linalg.norm(result.more["body_force"][1:, 0], axis=1)
    assert np.abs(force / [0.0079, 0.0148, 0.0226, 0.0312] - 1.0).max() < 0.1
    error = result.more["mesh_error"][1:]
    assert result.resolved[1:].all() and (0.02 < error).all() and (error < LIMIT).all()


@pytest.mark.slow
def test_a_nub_beside_a_ball_gets_elements_of_its_own():
    """The nub was 53 to 141 % too stiff on elements that suit the ball; 0.1564, 0.4224 and 0.6788 N at 0.9, 1.9
    and 2.9 mm with `fem` on elements of 4.5 mm, smaller at the nub."""
    parts = ", parts = [{ shape = { sphere = 0.0015 }, offset = [0.026, 0.004, -0.0185] }]"
    result = pressed(0.02, 0.003, parts=parts, above=1e-4)
    assert result.converged.all() and (result.more["mesh_error"] < LIMIT).all()
    # measured: -1.8, +0.2, +2.1 %
    assert result.more["body_force"][:, 1, 2] == pytest.approx([0.1564, 0.4224, 0.6788], rel=0.04)


def test_det_f_at_corners_is_that_of_the_displacements(block):
    model = block((0.02, 0.02, 0.02), 0.01)
    points, tets = model.mesh.points, model.mesh.tets
    # a quadratic field, whose gradient at the corners is known
    bend = np.random.default_rng(0).normal(size=(3, 3, 3)) * 20.0
    u = np.einsum("cij,ni,nj->nc", bend, points, points)
    at = points[np.unique(tets[:, :4])]
    exact = np.linalg.det(np.eye(3) + np.einsum("cij,nj->nci", bend, at) + np.einsum("cij,ni->ncj", bend, at))
    assert corner_det_f(model.mesh, np.arange(len(points)), u) == pytest.approx(exact.min())


def test_a_frame_counts_by_error_corner_rotation_and_parts():
    error, corner = np.array([0, 0.05, 0.2, 0.05, np.nan]), np.array([1.0, 0.5, 0.5, -0.1, np.nan])
    assert resolved(error, corner, 0.0, np.ones(5, bool)).tolist() == [True, True, False, False, True]
    assert resolved(error, corner, np.array([0.2, 0.1, 0.0, 0.0, 0.0]), np.ones(5, bool)).tolist()[:2] == [False, True]
    assert resolved(error, corner, 0.0, np.ones(5, bool), parts=0.6).tolist()[:2] == [True, False]
    assert not resolved(error, corner, 0.0, np.zeros(5, bool)).any()


def press_of(shape, body, probe, top, depth, *, x=0.0, turn=0.0, frames=1, tier=None):
    """A press of a body whose keys ``body`` sets."""
    path = [[x, 0.0, top], [x, 0.0, float(top - depth)]]
    given = {"resolution": None, "young_modulus": 1e5, **body}
    return press(scene("block", shape=f"{{ {shape} }}", probe=f"{{ shape = {{ {probe} }} }}", press=f"""\
{{ path = {path}, rotation = [{turn}, 0.0, 0.0], frames = {frames} }}""", **given).sample(0), Request(tier=tier))


BALL = {"fixed": [-0.03, -0.03, -0.001, 0.03, 0.03, 0.012]}


@pytest.mark.parametrize(("shape", "probe", "top", "radius"), [
    ("sphere = 0.02", "plane = true", 0.04, 0.02), ("sphere = 0.02", "sphere = 0.02", 0.06, 0.01),
    pytest.param('mesh = "ball.stl"', "plane = true", 0.04, 0.02, marks=pytest.mark.slow)],
                         ids=["plate on ball", "ball on ball", "plate on scan"])
def test_contact_with_a_round_body_is_that_of_hertz_or_marked(shape, probe, top, radius, tmp_path, monkeypatch):
    """A ball of facets had 0.328 N for 0.469 under a plate, and an error of 5 % was told."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    trimesh.creation.icosphere(subdivisions=4, radius=0.02).export(tmp_path / "ball.stl")
    depths = np.array([0.0004, 0.0008])  # 1 and 2 % of the diameter
    result = press_of(shape, BALL, probe, top, depths[-1], turn=np.pi * (probe[0] == "p"), frames=2, tier="fem-coarse")
    exact = 4.0 / 3.0 * 1e5 / (1.0 - 0.3**2) * np.sqrt(radius) * depths**1.5
    off, told = np.abs(result.normal_force / exact - 1.0), result.more["mesh_error"]
    assert result.converged.all() and ((off < 0.05) | ~result.resolved & (off < told)).all(), (off, told)


def crossed(radius, across, depth, nu=0.3):
    """Hertz's force [N] between rigid balls and a cylinder of other radii, E = 1e5 Pa (Johnson 1985, section 4.2)."""
    one, other = 0.5 / radius, 0.5 / radius + 0.5 / across  # along and across the cylinder, the sharper one second

    def sharper(m):
        return (ellipe(m) / (1.0 - m) - ellipk(m)) / (ellipk(m) - ellipe(m)) - other / one

    m = brentq(sharper, 1e-6, 1.0 - 1e-9)
    k, e = ellipk(m), ellipe(m)
    return 2.0 * np.pi / 3.0 * 1e5 / (1.0 - nu**2) * depth / k * np.sqrt(depth * (k - e) / (one * m * k))


@pytest.mark.parametrize(("length", "radius", "ball", "resolution"), [
    (0.03, 0.006, 0.01, None), pytest.param(0.02, 0.006, 0.02, 0.0015, marks=pytest.mark.slow)],
                         ids=["rod", "rod of small elements"])
def test_a_ball_on_a_round_bar_is_that_of_hertz_or_marked(length, radius, ball, resolution):
    """Hertz's bodies are half-spaces. This one is held 1.6 radii below the contact, as a bonded layer is, which is
    stiffer, and its sides are free: its force lies between the two."""
    body = {"fixed": [-1.0, -1.0, -1.0, 1.0, 1.0, 0.4 * radius], "resolution": resolution}
    depths = [0.02 * radius, 0.04 * radius]  # 1 and 2 % of the diameter
    result = press_of(f"rod = [{length}, {radius}]", body, f"sphere = {ball}", 2.0 * radius + ball, depths[-1],
                      x=0.5 * length, frames=2, tier="fem-coarse")
    exact, mean = np.array([crossed(ball, radius, depth) for depth in depths]), ball / np.sqrt(1.0 + ball / radius)
    layer = np.array([bonded / free for free, bonded in (hertz_layer(
        depth, young_modulus=1e5, poisson_ratio=0.3, radius=mean, height=1.6 * radius) for depth in depths)])
    off, told = result.normal_force / exact - 1.0, result.more["mesh_error"]
    fits = (off > -0.05) & (off < 1.05 * layer - 1.0)
    assert result.converged.all() and (fits | ~result.resolved & (np.abs(off) < told)).all(), (off, layer, told)
    assert resolution is None or result.resolved[-1]


FOAM = {"material": '"pe-foam"', "poisson_ratio": None, "young_modulus": None}


BLOCK, SLAB, COARSE = [0.10, 0.10, 0.05], [0.06, 0.05, 0.03], {"resolution": 0.012}
LAYER = {"poisson_ratio": 0.45, "resolution": 0.006}


def foam(beta):
    """A foam of E = 1e5 Pa and nu = beta / (1 + 2 beta) on a bonded block (`references/closed_forms.py`), pressed."""
    nu = beta / (1.0 + 2.0 * beta)
    body = {"law": f'{{ name = "hyperfoam", mu = 1e5, alpha = 4.0, beta = {beta} }}', "poisson_ratio": nu}
    exact = hertz_layer(0.001, young_modulus=1e5, poisson_ratio=nu, radius=0.02, height=0.05)[1]
    return BLOCK, body, "sphere = 0.02", 0.07, 0.001, exact, 0.02


@pytest.mark.parametrize(("size", "body", "probe", "top", "depth", "exact", "unsure"), [
    (BLOCK, FOAM, "sphere = 0.02", 0.07, 0.001, 1.374, 0.02),
    *(pytest.param(*row, marks=pytest.mark.slow) for row in (
        foam(0.0), foam(3.0), (BLOCK, FOAM, "sphere = 0.02", 0.07, 0.005, 15.50, 0.02))),
    (SLAB, COARSE, "capsule = [0.006, 0.012]", 0.036, 0.003, 4.29, 0.0),
    (SLAB, COARSE, "capsule = [0.006, 0.03]", 0.036, 0.001, 1.849, 0.0),
    ([0.06, 0.02, 0.0017], LAYER, "sphere = 0.02", 0.0217, 0.0005, 2.42, 0.01),
    ([0.05, 0.05, 0.002], LAYER, "sphere = 0.02", 0.022, 0.0005, 1.93, 0.01)])
def test_the_error_is_not_told_as_of_a_ball_on_rubber(size, body, probe, top, depth, exact, unsure):
    """`references/foam_block.json`: at 1 mm the force was off by 14 % and told 6; the local indentation that makes up
    for small contacts is known for the neo-Hookean law alone. Under capsules on their side, whose forces are those on
    elements of 2.7 mm, it was off by 7 % and told 5.6 and 2.9, of the circle that has the contact's area. Layers
    thinner than their elements, whose forces are those on elements of 1.2 mm, were 30 and 28 % too soft and told 8."""
    turn = 0.5 * np.pi * (probe[0] == "c")
    result = press_of(f"box = {size}", body, probe, top, depth, turn=turn, tier="fem-coarse")
    off = abs(float(result.normal_force[-1]) / exact - 1.0)
    assert off < result.more["mesh_error"][-1] + unsure and (off < 0.1 or not result.resolved[-1])


PLATE = {"resolution": 0.004, "fixed": [-0.04, -0.03, -0.001, -0.015, 0.03, 0.02], "young_modulus": 1e6}
BRIDGE = {**PLATE, "resolution": 0.005, "fixed": [-0.04, -0.03, -0.001, -0.022, 0.03, 0.02]}


@pytest.mark.parametrize(("shape", "body", "x", "top", "depth", "marked"), [
    ("box = [0.05, 0.02, 0.003]", PLATE, 0.018, 0.009, 0.002, False),
    ("box = [0.05, 0.02, 0.003]", PLATE, 0.018, 0.009, 0.008, True),
    ("box = [0.06, 0.02, 0.004]", BRIDGE, 0.0, 0.010, 0.004, True),
    ("box = [0.06, 0.06, 0.03]", {"poisson_ratio": 0.45}, 0.0, 0.036, 0.001,
     False)], ids=["plate", "bent plate", "bridge", "block"])
def test_small_strain_is_told_where_elements_turn_further_than_it_follows(shape, body, x, top, depth, marked):
    """By 3.6, 21, 29, about 15 and 0.1 % the tier `linear` differs from `fem-coarse` here."""
    result = press_of(shape, body, "sphere = 0.006", top, depth, x=x, tier="linear")
    assert marked == ("too far for this tier" in result.text()) == (result.more["rotation"][-1] > 0.13)
    assert not (marked and result.resolved.any())


@pytest.mark.parametrize(("shape", "body", "probe", "top", "depth", "x"), [
    ("box = [0.06, 0.02, 0.010]", PLATE, "sphere = 0.006", 0.016, 0.006, 0.024),
    ("box = [0.02, 0.02, 0.02]", {}, "plane = true", 0.02, 0.004, 0.0)], ids=["turned", "squeezed"])
def test_a_scene_that_chose_no_tier_gets_one_that_follows_it(shape, body, probe, top, depth, x):
    body, turn = {**body, "resolution": 0.010}, np.pi * (probe[0] == "p")
    free, asked = (press_of(shape, body, probe, top, depth, x=x, turn=turn, tier=tier) for tier in (None, "fem"))
    assert free.more["tier"] == "fem" and free.normal_force == pytest.approx(asked.normal_force, rel=1e-9)
    assert any("too far for small strain: tier 'fem' was taken" in note for note in free.notes)


@pytest.mark.slow
def test_supports_that_end_inside_elements_are_told():
    """A disc clamped across, 3 % too soft on elements of 6 mm: their nodes in the box end before it."""
    body = {"fixed": [-1.0, -1.0, -1.0, -0.01, 1.0, 1.0], "young_modulus": 1e6}
    coarse, fine = (press_of("cylinder = [0.03, 0.004]", {**body, "resolution": size}, "sphere = 0.01", 0.0145, 0.006,
                             x=0.02, tier="fem", frames=3) for size in (0.006, 0.004))
    off = abs(float(coarse.normal_force[-1] / fine.normal_force[-1]) - 1.0)
    assert 0.02 < off < coarse.table()["support_error"][-1] and "resolve the supports in 1 of 3" in coarse.text()


def test_a_press_on_what_supports_hold_is_refused():
    with pytest.raises(SceneError, match="What is held is rigid, and a force on it has no meaning"):
        press_of("box = [0.05, 0.02, 0.003]", PLATE, "sphere = 0.006", 0.009, 0.002, x=-0.021)
