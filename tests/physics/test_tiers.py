"""Tiers: the cheapest that is enough, refusals that say what would do, element sizes."""

import os
import re

import numpy as np
import pytest
import texts

from vsfsim.core.errors import MeshError, SceneError
from vsfsim.core.shape import Plane, Sphere
from vsfsim.core.solid import Solid
from vsfsim.physics import tiers
from vsfsim.physics.mesh.account import scan_foot
from vsfsim.physics.mesh.quadratic import assemble, quadratic_mesh
from vsfsim.physics.solve.touches import Solver


def scene(**keys):
    return texts.scene("block", **{"probe": None, "press": None, "resolution": None, **keys}).sample(0)


@pytest.mark.parametrize(("needs", "tier"), [
    ("[]", "linear"), ('["normal-force"]', "linear"), ('["appearance", "normal-force"]', "linear"),
    ('["contact"]', "linear"), ('["appearance"]', "linear"),
    ('["coupling", "bulging"]', "fem-coarse"),
    ('["bulging"]', "fem-coarse"), ('["normal-force", "large-deformation", "bulging"]', "fem"),
])
def test_auto_takes_the_cheapest_that_shows_every_need(needs, tier):
    assert tiers.choose(scene(needs=needs)) == tier
    assert tiers.choose(scene(needs=needs, tier='"fem"'), "fem-fine") == "fem-fine"


@pytest.mark.parametrize(("given", "asked", "message"), [
    (dict(needs='["large-deformation"]'), "fem-coarse",
     "block.toml: the scene needs large-deformation, which tier 'fem-coarse' cannot show; use 'fem' or above."),
    (dict(needs='["bulging"]', tier='"linear"'), None,
     "needs bulging, which tier 'linear' cannot show; use 'fem-coarse' or above."),
    (dict(), "fine", "unknown tier 'fine'. Did you mean 'fem-fine'? Allowed: auto, fem, fem-coarse, fem-fine, linear."),
])
def test_too_little_is_refused_and_the_message_names_what_would_do(given, asked, message):
    with pytest.raises(SceneError, match=re.escape(message)):
        tiers.choose(scene(**given), asked)


def test_the_linear_tier_presses_and_its_supports_carry_the_force(line, device):
    model = tiers.build(scene(needs="[]", resolution=0.01), "linear")
    probe = Sphere(0.02)
    solver = Solver(model, probe, device=device, options=tiers.options("linear"), linear=True)
    frames = solver.run(line([[0.0, 0.0, z] for z in (0.0501, 0.049, 0.047, 0.049, 0.0501)], probe))
    assert frames.converged.all()
    force = frames.force[:, 0, 2]
    # Hertz for 3 mm is 10 N on a half-space of this material, which the block is not
    assert force[0] == 0.0 and 2.0 < force[2] < 20.0 and force[2] > 2.0 * force[1]
    # frictionless: the way out is the way in
    assert force[3] == pytest.approx(force[1], rel=5e-3) and force[4] == pytest.approx(0.0, abs=1e-6)
    assert (frames.force_balance < 5e-3).all()
    assert frames.reaction[2, 0, 2] == pytest.approx(force[2], rel=5e-3)


def test_a_finer_tier_is_finer_and_the_scenes_resolution_wins():
    s = scene()
    sizes = [tiers.element_size(s.object, tier, s.probe) for tier in ("fem-coarse", "fem", "fem-fine")]
    assert sizes == sorted(sizes, reverse=True) and sizes[-1] < sizes[0]
    # a small tip needs small elements; a plane has no size and sets none
    assert tiers.element_size(s.object, "fem", Sphere(0.002)) < sizes[1]
    assert tiers.element_size(s.object, "fem",
                              Plane()) == pytest.approx((0.06 * 0.06 * 0.03) ** (1 / 3) * tiers.TIERS["fem"].body)
    assert tiers.element_size(scene(resolution=0.004).object, "linear", Sphere(0.002)) == 0.004


def test_the_model_holds_what_the_scene_says():
    inclusion = "{ box = [-0.03, -0.03, 0.0, 0.0, 0.03, 0.03], value = 4e5 }"
    s = scene(resolution=0.015, pose=[0.1, -0.2, 0.3], yaw=0.7, density=500.0,
              young_modulus=f"{{ base = 1e5, inclusions = [ {inclusion} ] }}")
    model = tiers.build(s, "fem-coarse")
    # the object frame's base centre lies at the pose
    assert model.mesh.points.min(axis=0)[2] == pytest.approx(0.3)
    middle = 0.5 * (model.mesh.points.min(axis=0) + model.mesh.points.max(axis=0))
    assert middle == pytest.approx([0.1, -0.2, 0.315])
    assert model.mesh.volume.sum() == pytest.approx(0.06 * 0.06 * 0.03, rel=1e-12)
    # the inclusion is the half at negative x of its own frame, and meshed exactly: a grid plane lies at x = 0
    centre = model.mesh.points[model.mesh.tets[:, :4]].mean(axis=1)
    own_x = (centre[:, 0] - 0.1) * np.cos(0.7) + (centre[:, 1] + 0.2) * np.sin(0.7)
    assert np.allclose(model.young_modulus, np.where(own_x < 0.0, 4e5, 1e5)[:, None], rtol=1e-12)
    # gradients turned with the body: they differentiate world coordinates
    x = model.mesh.points[model.mesh.tets[:, :4]]
    assert np.einsum("mkc,mkd->mcd", model.mesh.gradients[:, 0], x[:, 1:] - x[:, :1]) == pytest.approx(
        np.broadcast_to(np.eye(3), (len(x), 3, 3)), abs=1e-10)


def test_a_scan_is_cut_as_finely_as_a_box_of_its_size(tmp_path):
    trimesh = pytest.importorskip("trimesh")
    block = trimesh.creation.box((0.06, 0.06, 0.03))
    block.export(tmp_path / "scan.ply")
    for factor, more in ((1.0, ""), (1000.0, ""), (100.0, ", scale = 0.01")):
        block.copy().apply_scale(factor).export(tmp_path / f"x{factor:g}.ply")
        scan = scene(shape=f'{{ mesh = "{tmp_path}/x{factor:g}.ply"{more} }}')
        for tier in ("fem-coarse", "fem-fine"):
            size = tiers.element_size(scene().object, tier, scan.probe)
            assert tiers.element_size(scan.object, tier, scan.probe) == pytest.approx(size, rel=1e-6)
    # a file that changed is read again, whatever its time says
    path = tmp_path / "x1.ply"
    stamp = path.stat().st_mtime_ns
    block.copy().apply_scale(0.5).export(path)
    os.utime(path, ns=(stamp, stamp))
    half = scene(shape=f'{{ mesh = "{path}" }}')
    assert tiers.element_size(half.object, "fem",
                              Plane()) == pytest.approx(0.5 * tiers.element_size(scene().object, "fem", Plane()),
                                                        rel=1e-6)
    (tmp_path / "empty.obj").write_text("")
    with pytest.raises(MeshError, match=r"empty\.obj' has no faces"):
        tiers.element_size(scene(shape=f'{{ mesh = "{tmp_path}/empty.obj" }}').object, "fem", Plane())


def test_the_foot_of_a_scan_is_said_and_a_narrow_one_warned_of():
    def said(foot):
        # a frustum: a square foot under a square top of 0.1 m
        v = np.array([[x * w, y * w, z] for z, w in ((0.0, foot), (0.1, 0.1)) for x in (-0.5, 0.5)
                      for y in (-0.5, 0.5)])
        return scan_foot(Solid(v, np.array([[0, 1, 2, 4]]), np.zeros(1, int), ("body",)))

    assert said(0.08) == (pytest.approx(0.001), (
        'fixed = "bottom" holds the scan\'s lowest 1 %, 1.0 mm: a foot of 80 x 80 mm under a body of 100 x 100 mm.'))
    assert said(0.02)[0] == pytest.approx(0.005)
    assert "lowest 5 %, 5.0 mm: a foot of 20 x 20 mm under a body of 100 x 100 mm" in said(0.02)[1]
    assert ("may tip rather than be indented; fixed = [-0.051, -0.051, -0.001, 0.051, 0.051, 0.025] would hold its "
            "lowest quarter" in said(0.02)[1])


ROUND = {"{ rod = [0.06, 0.006] }": np.pi * 0.006**2 * 0.06, "{ cylinder = [0.012, 0.02] }": np.pi * 0.012**2 * 0.02,
         "{ sphere = 0.02 }": 4.0 / 3.0 * np.pi * 0.02**3}


@pytest.mark.parametrize("shape", ROUND)
def test_round_bodies_have_their_volume_surface_and_top_at_every_tier(shape):
    """That of the solver's curved elements, which are 1.6e-4 too small at most; tetrahedra of flat sides lack 4.5 %."""
    for tier in tiers.TIERS:
        mesh = quadratic_mesh(tiers.body(scene(shape=shape), tier)[0])
        assert mesh.volume.sum() == pytest.approx(ROUND[shape], rel=2e-4)
        radius, *length = (0.006, 0.06) if "rod" in shape else (0.012, 0.02) if "cylinder" in shape else (0.02,)
        area = 2.0 * np.pi * radius * (length[0] + radius) if length else 4.0 * np.pi * radius**2
        assert mesh.face_area().sum() == pytest.approx(area, rel=1e-4)
        assert mesh.points[:, 2].max() == pytest.approx(0.02 if "cylinder" in shape else 2.0 * radius, rel=1e-9)


def test_layers_that_end_at_supports_have_a_limit_and_take_none_of_a_part():
    sheet = "{ base = 1e5, inclusions = [{ box = [-0.02, -0.02, 0.015, 0.02, 0.02, 0.0153], value = 1e8 }] }"
    s = scene(young_modulus=sheet, resolution=0.004, fixed=[-1.0, -0.021, 0.0146, 1.0, 0.0128, 0.0262])
    assert tiers.body(s, "fem", focus=np.array([[0.0, 0.0, 0.03]]))[0].parts < 0.01
    flat = {"shape": "{ cylinder = [0.05, 0.02] }", "resolution": 0.005}
    s = scene(**flat, fixed=[-1.0, -1.0, 0.0006, 1.0, 1.0, 0.0194])
    assert len(tiers.body(s, "fem")[0].tets) == len(tiers.body(scene(**flat), "fem")[0].tets)


BAR = dict(shape="{ rod = [0.06, 0.006] }", fixed=[-1.0, -1.0, -1.0, 1.0, 1.0, 0.004])


@pytest.mark.parametrize("tier", ["linear", "fem"])
def test_a_round_bar_is_as_stiff_as_its_section(tier):
    """Energies of stretch, bending and torsion of Saint-Venant's fields: E A, E I and G J per length."""
    model = tiers.build(scene(**BAR), tier)
    stiffness, modulus, nu, radius, length = assemble(len(model.mesh.points), model.blocks), 1e5, 0.3, 0.006, 0.06
    x, y, z = (model.mesh.points - [0.0, 0.0, radius]).T
    inertia = 0.25 * np.pi * radius**4
    for field, exact, within in (
        ((x, -nu * y, -nu * z), modulus * np.pi * radius**2, 2e-4),
        ((x * z, -nu * y * z, 0.5 * (nu * (y**2 - z**2) - x**2)), modulus * inertia, 1e-3),
        ((0.0 * x, -x * z, x * y), modulus / (2.0 + 2.0 * nu) * 2.0 * inertia, 5e-3),
    ):
        u = np.stack(field, axis=1).ravel()
        assert u @ (stiffness @ u) == pytest.approx(exact * length, rel=within)
