"""`vsfsim press` as a user runs it: a scan, each kind of probe, and paths that make no sense."""

import json

import numpy as np
import pytest
import trimesh
from PIL import Image
from texts import changed, text
from typer.testing import CliRunner

from vsfsim.cli.main import app
from vsfsim.core.errors import VsfsimError
from vsfsim.core.shelf import find_scene
from vsfsim.robot.arm import Arm


@pytest.fixture
def press(vsfsim, tmp_path):
    """Runs `vsfsim press` on a block, changed: press(*words, shape=..., size=..., tier=..., probe=...)."""
    def run(*words, given=None, size=0.012, tier="fem-coarse", probe="sphere = 0.01", start=0.04, stop=0.037, **keys):
        (tmp_path / "s.toml").write_text(given or text(
            "block", resolution=size, young_modulus=5e4, poisson_ratio=0.45, tier=f'"{tier}"',
            probe=f"{{ shape = {{ {probe} }} }}",
            press=f"{{ from = [0.0, 0.0, {start}], to = [0.0, 0.0, {stop}], frames = 2 }}", **keys))
        return vsfsim("press", "s.toml", *words, cwd=tmp_path)

    return run


def pressed(out):
    """The JSON of a press that worked: every frame converged, forces balance, the probe is pushed back up."""
    assert out.returncode == 0, out.stdout + out.stderr
    result = json.loads(out.stdout)
    force, reaction = np.array(result["force"]), np.array(result["reaction"])
    assert all(result["converged"]) and result["depth"] == sorted(result["depth"])
    # the tolerance of tier fem-coarse, on the sum of unbalanced nodal forces
    unbalanced = np.linalg.norm(force - reaction, axis=1)
    assert unbalanced.max() < 2e-3 * np.linalg.norm(force, axis=1).max()
    assert (np.diff([0.0, *force[:, 2]]) > 0.0).all()
    return result


@pytest.mark.parametrize(("probe", "half", "low", "fine", "error"), [
    # low: a rigid punch on a half-space, E* = 5e4 / (1 - 0.45^2) = 6.3e4 Pa, at 3 mm (Johnson 1985, ch. 3 and 4):
    # Hertz for the sphere, 2 a E* d for the cylinder and the box; the block is only 30 mm thick, so it is stiffer.
    # fine: for the sphere and the capsule the force with resolution = 0.006, within 1 % of that with 0.003; for the
    # others that of a quarter of the block with cells of 1.7 and 2 mm at the rim, still 3 % above the limit. error: of
    # the mesh of 12 mm against it, measured +11.4, +20.5, +5.8 and +5.5 %: the contact radius is half an element, or
    # the error of a rim along which elements are 5 mm long; without such it is 17 and 15 %
    ("sphere = 0.01", 0.01, 1.37, 1.550, 0.14), ("capsule = [0.008, 0.01]", 0.013, 1.22, 1.334, 0.23),
    pytest.param("cylinder = [0.012, 0.02]", 0.01, 4.5, 6.783, 0.07, marks=pytest.mark.slow),
    pytest.param("box = [0.02, 0.024, 0.02]", 0.01, 4.6, 7.267, 0.07, marks=pytest.mark.slow),
    # a plate on the whole block: not less than with free sides, E A e
    ("plane = true", 0.0, 18.0, 23.56, 0.02),
])
def test_each_probe_presses_a_soft_block(press, probe, half, low, fine, error):
    result = pressed(press("--json", "-", probe=probe, start=0.03 + half, stop=0.027 + half))
    assert result["depth"][-1] == pytest.approx(0.003, abs=1e-5)
    assert low < result["force"][-1][2] == pytest.approx(fine, rel=error)


def test_a_scan_with_a_hole_in_millimetres(press, tmp_path):
    # a dome of 60 x 60 x 30 mm with a flat base, whole and with some of its faces missing
    ball = trimesh.creation.icosphere(subdivisions=2, radius=30.0)
    ball.vertices[:, 2] = np.maximum(ball.vertices[:, 2], 0.0)
    ball.update_faces(ball.nondegenerate_faces())
    ball.export(tmp_path / "whole.stl")
    ball.update_faces(np.arange(len(ball.faces)) > 0)
    ball.export(tmp_path / "dome.stl")
    whole, result = (pressed(press("--plot", "p.png", "--json", "-", shape=f'{{ mesh = "{name}.stl" }}', size=0.02,
                                   start=0.04, stop=0.037)) for name in ("whole", "dome"))
    notes = " ".join(result["notes"])
    assert "read as millimetres" in notes and 'fixed = "bottom" holds the scan\'s lowest 1 %, ' in notes
    assert "Not watertight" in notes and "Not watertight" not in " ".join(whole["notes"])
    assert "tip" not in notes and (tmp_path / "p.png").read_bytes()[:4] == b"\x89PNG"
    # Hertz for two spheres, R = 7.5 mm: 4/3 E* sqrt(R) d^1.5 = 1.2 N; the dome of 30 mm is bonded to its base
    force = result["force"][-1][2]
    assert force == pytest.approx(1.2, rel=0.4) and force == pytest.approx(whole["force"][-1][2], rel=0.1)


def test_a_probe_that_misses_is_reported_and_one_inside_is_refused(press):
    missed = press(tier="linear", start=0.06, stop=0.05)
    assert missed.returncode == 2 and "[press] never brings the probe, or what moves with it, into" in missed.stderr
    assert "note: The probe starts 1.5 mm inside the body" in press(tier="linear", start=0.0385, stop=0.037).stdout
    out = press(tier="linear", probe="sphere = 0.005", start=0.015, stop=0.012)
    assert out.returncode == 2
    # on a busy machine a run has told how far it is
    assert "error: s.toml [press]: from = [0.0, 0.0, 0.015] puts the whole probe inside the body" in out.stderr
    assert out.stdout == "" and "Traceback" not in out.stderr


def test_two_lines_of_toml_give_force_picture_file_and_statement(press, tmp_path):
    trimesh.creation.capsule(radius=8.0, height=14.0, count=[16, 16]).export(tmp_path / "tip.stl")
    scene = ('[object]\nshape = { box = [0.06, 0.06, 0.03] }\nyoung_modulus = 5e4\nresolution = 0.012\n[probe]\nshape '
             '= { mesh = "tip.stl", scale = 0.001 }\n')
    out = press("--picture", "p.png", "--save", "s.npz", given=scene)
    assert out.returncode == 0, out.stderr
    assert ("All 10 frames converged." in out.stdout and "of an element" in out.stdout
            and "No [press] is given: the probe goes from above, at the middle" in out.stdout)
    assert "the centre of its bounding box is the probe's origin; distance grid of" in out.stdout
    assert (tmp_path / "p.png").read_bytes()[:4] == b"\x89PNG"
    with np.load(tmp_path / "s.npz") as data:
        assert set(json.loads(str(data["units"]))) == set(data.files) - {"units"}
        assert data["contact_force"].shape == (10, len(data["surface_nodes"]), 3)
        assert data["displacement"].shape == (10, len(data["points"]), 3)
        # the force on the probe is what the surface pushes back with, to the tier's tolerance
        tolerance = 1e-4 * np.abs(data["force"]).max()
        assert data["contact_force"].sum(axis=1) == pytest.approx(-data["force"], abs=tolerance)


def test_refinement_prints_the_meshes_and_says_what_they_are_worth(press, tmp_path):
    out = press("--refine", "3", "--json", "r.json", "--gif", "g.gif", tier="linear", size=0.015)
    with Image.open(tmp_path / "g.gif") as film:
        assert film.n_frames == 2
    found = json.loads((tmp_path / "r.json").read_text())["refinement"]
    assert (out.returncode == 0 and "normal force N" in out.stdout and len(found["meshes"]) == len(found["force"]) == 3
            and np.all(np.diff(found["edge"]) < 0.0))
    assert found["force"] == pytest.approx([m["normal_force"][-1] for m in found["meshes"]])
    assert found["error"] > 0.0 and ("Observed order" in found["statement"] or "No order" in found["statement"])
    # the mesh's own error is far under what a wrong force would be: Hertz is 1.4 N, see above
    assert 1.2 < found["force"][-1] < 2.8


def small_turn(turn):
    """The vector of rotations so small that their skew part is it."""
    return 0.5 * np.stack([turn[..., 2, 1] - turn[..., 1, 2], turn[..., 0, 2] - turn[..., 2, 0],
                           turn[..., 1, 0] - turn[..., 0, 1]], axis=-1)


def test_a_plant_is_pressed_by_the_arm_of_its_scene(tmp_path):
    """The same command as for a block: one touch with its joint torques, which are J^T of the recorded forces; plot,
    picture and file beside it. The touch converges in 16, 24, 32 and 40 frames."""
    (tmp_path / "s.toml").write_text(changed(
        find_scene("plants-mini").read_text(), ('species = { choice', 'species = "rubber-plant" #'),
        ("max_segments = 250", "max_segments = 50"), ("depth = 0.24", "depth = 0.08"),
        ("approach = 0.14", "approach = 0.12"), ("width = 480\nheight = 432", "width = 120\nheight = 108"),
        ("free = 5, in = 64, hold = 2, out = 14", "free = 1, in = 16, hold = 1, out = 2")))
    run = CliRunner()
    out = run.invoke(app, ["press", str(tmp_path / "s.toml"), "--json", "-", "--plot",
                           str(tmp_path / "p.png"), "--picture", str(tmp_path / "q.png"), "--save",
                           str(tmp_path / "s.npz"), "--seed", "9"])
    assert out.exit_code == 0, out.output
    found, saved = json.loads(out.stdout), np.load(tmp_path / "s.npz")
    force, reaction, torque = (np.array(found[key]) for key in ("force", "reaction", "torque"))
    assert all(found["converged"]) and np.linalg.norm(force, axis=1).max() > 0.5
    assert np.abs(force - reaction).max() < 1e-3 * np.abs(force).max()
    # the torque of a joint is the work of all wrenches while it turns by a little: central differences of the capsules'
    # poses
    base = np.eye(4)
    base[0, 3] = -0.62
    arm, t = Arm(base=base), int(np.linalg.norm(force, axis=1).argmax())
    before, after = (arm.body_poses(saved["q"][t] + sign * 1e-5 * np.eye(7)) for sign in (-1, 1))
    spin = small_turn(after[..., :3, :3] @ np.swapaxes(before[..., :3, :3], -1, -2))
    work = ((after - before)[..., :3, 3] * saved["body_force"][t]
            + spin * saved["body_moment"][t]).sum(axis=(1, 2)) / 2e-5
    assert torque[t] == pytest.approx(work, abs=1e-6)
    assert torque.shape == (20, 7) and np.abs(torque).max() > 0.05 and (np.diff(found["depth"][1:17]) > 0.0).all()
    assert saved["node_position"].shape[0] == 20
    assert np.abs(saved["node_position"][17] - saved["node_rest"]).max() > 1e-3, "it bends"
    assert all((tmp_path / name).stat().st_size > 2000 for name in ("p.png", "q.png"))
    refused = run.invoke(app, ["press", str(tmp_path / "s.toml"), "--refine", "3"])
    assert isinstance(refused.exception, VsfsimError) and "leave --refine out" in str(refused.exception)
