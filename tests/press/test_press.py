"""Around a press: what is assumed, observed order of convergence, pressures, pictures' triangles."""

import dataclasses
import errno
from types import SimpleNamespace

import numpy as np
import pytest

from vsfsim.core.errors import VsfsimError
from vsfsim.core.scene import parse_scene
from vsfsim.core.scene_tables.request import Request
from vsfsim.core.shape import Box, Capsule, Cylinder, Plane, Sphere
from vsfsim.generate.assume import with_probe
from vsfsim.generate.boundary import deformed_surface, face_pressure
from vsfsim.generate.effectors.probe import prepare, solve
from vsfsim.physics.contact import sdf
from vsfsim.physics.convergence import convergence
from vsfsim.press.command import Press
from vsfsim.sensing.tessellate import tessellate

BOX = '[object]\nshape = { box = [0.06, 0.05, 0.03] }\nyoung_modulus = 1e5\nresolution = 0.015\ntier = "linear"\n'


@pytest.mark.parametrize("order", [0.7, 3.5])
@pytest.mark.parametrize("sizes", [(8.0, 6.5, 4.0), (9.0, 8.0, 6.0, 3.0)])
def test_a_made_up_sequence_gives_its_order_and_limit_back(order, sizes):
    h = 1e-3 * np.array(sizes)
    found = convergence(h, 9.7 + 40.0 * (h / 0.01) ** order, tolerance=1e-9)
    assert found.order == pytest.approx(order, rel=1e-5) and found.extrapolated == pytest.approx(9.7, rel=1e-6)
    # the true error of the finest is 40 (h / 0.01)^p, and the estimate is 1.25 times it
    assert found.error == pytest.approx(1.25 * 40.0 * (h[-1] / 0.01) ** order, rel=1e-5)
    assert f"order of convergence {order:.2f}" in found.statement


@pytest.mark.parametrize(("force", "word"), [
    ((9.0, 9.5, 9.3), "go up and down"), ((9.0, 9.1, 9.4), "do not shrink from mesh to mesh"),
    ((9.0, 9.0 + 1e-6, 9.0), "agree to the solver's tolerance"), ((9.0, 9.0, 9.0), "agree to the solver's tolerance"),
])
def test_a_sequence_without_an_order_says_so_and_gives_its_spread(force, word):
    found = convergence([0.008, 0.006, 0.0045], force, tolerance=1e-4)
    assert found.order is None and found.extrapolated is None and word in found.statement
    assert found.error >= np.ptp(force)


def test_an_order_that_quadratic_elements_cannot_have_is_not_used():
    h = np.array([0.008, 0.006, 0.0045])
    found = convergence(h, 9.7 + (h / 0.004) ** 9, tolerance=1e-6)
    assert found.order == pytest.approx(9.0, rel=1e-3) and "4 was used" in found.statement
    # an order taken lower than observed extrapolates further and gives the larger error
    gain = (0.006 / 0.0045) ** 9 - 1.0
    assert found.error > 1.25 * (found.force[1] - found.force[2]) / gain


def test_what_is_left_out_is_assumed_and_said():
    prepared = prepare(parse_scene(BOX, "s.toml").sample(), Request())
    scene, notes = prepared.scene, prepared.notes
    assert prepared.tier == "linear" and scene.probe == Sphere(0.006)
    assert "a ball of 6 mm radius was taken" in notes[0]
    # first contact on the top at its middle, a tenth of the height deep
    assert scene.press.start == pytest.approx((0.0, 0.0, 0.036), abs=2e-6)
    assert scene.press.stop == pytest.approx((0.0, 0.0, 0.033), abs=2e-6)
    assert "from first contact at (0, 0, 0.036) m, 3 mm deep, 10 % of the height, in 10 frames" in notes[1]
    # who gives a path means the grammar's own ball
    scene, notes = with_probe(parse_scene(BOX + "[press]\nfrom = [0, 0, 0.06]\nto = [0, 0, 0.05]\n", "s.toml").sample())
    assert scene.probe == Sphere(0.02) and "20 mm radius" in notes[0]
    scene, notes = with_probe(parse_scene(BOX + "[probe]\nshape = { sphere = 0.004 }\n", "s.toml").sample())
    assert scene.probe == Sphere(0.004) and notes == []


@pytest.fixture(scope="module")
def pressed():
    text = (BOX + "[probe]\nshape = { plane = true }\n[press]\nfrom = [0, 0, 0.031]\nto = [0, 0, "
            "0.0297]\nframes = 2\nhold = 1\nretract = 2\n")
    request = Request()
    prepared = prepare(parse_scene(text, "s.toml").sample(), request)
    return prepared.model.mesh, solve(prepared, request)


def test_the_state_of_every_frame_is_saved(pressed):
    mesh, result = pressed
    saved = {name: values for name, (values, _) in result.saved().items()}
    assert saved["displacement"].shape == (5, len(mesh.points), 3)
    assert saved["contact_force"].shape == (5, len(mesh.surface_nodes()), 3) and saved["poses"].shape == (5, 1, 4, 4)
    assert result.deepest == 1 and "All 5 frames converged." in result.statement
    assert not {"arrays", "panels", "points"} & result.table().keys()
    # what the condensed problem pushed with, and what the deformed surface answers, agree to the tier's tolerance,
    # 1e-6, times a few
    assert saved["contact_force"].sum(axis=1) == pytest.approx(-result.force, abs=1e-9
                                                               + 1e-5 * np.abs(result.force).max())
    assert result.force == pytest.approx(result.more["body_force"][:, 0], rel=1e-8)
    assert (saved["contact_force"][4] == 0.0).all()


def test_frames_that_did_not_converge_are_crossed_out(pressed):
    _, result = pressed
    wrong = dataclasses.replace(result, touch=dataclasses.replace(result.touch, converged=np.arange(5) != 3))
    crosses = Press("small", (wrong,), "cpu").plot().axes[0].lines[1]
    assert crosses.get_marker() == "x" and crosses.get_xdata() == pytest.approx(1e3 * result.depth[3:4])


def test_pressure_adds_up_to_the_force(pressed):
    mesh, result = pressed
    pressure = face_pressure(mesh, result.arrays["contact_force"][0][1])
    top = mesh.points[mesh.faces][:, :, 2].min(axis=1) > 0.03 - 1e-9
    assert (pressure[top] > 0.0).all()
    # at the rim of the plate half a node's force is shared out to the side walls
    assert (pressure[top] * mesh.face_area()[top]).sum() == pytest.approx(result.force[1, 2], rel=0.2)
    # corner nodes of the rim pull a little, and a pressure has no sign
    assert (pressure * mesh.face_area()).sum() == pytest.approx(result.force[1, 2], rel=0.01)
    nodal = result.body[3][1][mesh.faces] @ [1, 1, 1, 3, 3, 3] / 12  # over the four triangles of each that a page draws
    assert (nodal * mesh.face_area()).sum() == pytest.approx(result.force[1, 2], rel=0.01)


def test_the_drawn_surface_is_closed_and_bends_with_the_body(pressed):
    mesh, result = pressed
    vertices, triangles, owner, length = deformed_surface(mesh, result.arrays["displacement"][0][1])
    assert len(triangles) == len(owner) == len(length) == 9 * len(mesh.faces)
    edges = np.sort(np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]]), axis=1)
    assert (np.unique(edges, axis=0, return_counts=True)[1] == 2).all(), "watertight"
    # 0.3 mm under a flat plate; its points sink in by the penetration, under 1 % of an element
    assert vertices[:, 2].max() == pytest.approx(0.0297, abs=1e-4)
    top = mesh.points[mesh.faces[owner]][:, :, 2].min(axis=1) > 0.03 - 1e-9
    assert length[top] == pytest.approx(3e-4, rel=0.2), "the plate presses the whole top by as much"


@pytest.mark.parametrize("shape", [Sphere(0.02), Capsule(0.01, 0.03), Cylinder(0.015, 0.04),
                                   Box((0.02, 0.03, 0.05)), Plane()])
def test_drawn_probes_lie_on_their_surface_and_are_wound_outwards(shape):
    vertices, faces = tessellate(shape, 0.1)
    if isinstance(shape, Plane):
        assert vertices[:, 2].max() == 0.0
        return
    # sharp edges stand over the fillets by up to 0.73 of 0.5 mm
    assert np.abs(sdf.distance(shape, vertices)).max() < 4e-4
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    assert (np.einsum("ij,ij->i", np.cross(b - a, c - a), (a + b + c) / 3.0) > 0.0).all()


@pytest.mark.parametrize("way", ["picture", "plot", "gif", "save"])
def test_a_full_disk_is_named(pressed, tmp_path, monkeypatch, way):
    def full(*_):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("vsfsim.data.disk.os.fsync", full)
    file = tmp_path / f"out.{'npz' if way == 'save' else 'gif' if way == 'gif' else 'png'}"
    with pytest.raises(VsfsimError, match=f"(?s){file}.*(full|space)"):
        getattr(Press("small", (pressed[1],), "cpu"), way)(file)
    assert list(tmp_path.iterdir()) == []


def test_a_press_is_resolved_where_every_frame_is_or_none_is_measured():
    for found, given in ((True, None), (True, np.eye(1)), (False, np.eye(2))):
        assert Press("b", (SimpleNamespace(resolved=given),), "cpu").resolved is found
