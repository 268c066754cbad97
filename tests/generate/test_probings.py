"""Presses of a ball on planes of known stiffness, written here in three formats, as datasets without truth."""

import json

import numpy as np
import pytest
from typer.testing import CliRunner

from vsfsim.cli.main import app
from vsfsim.core.errors import DatasetError
from vsfsim.data.verify import verify
from vsfsim.generate.recorded.probings import Options, import_probings, view_from_above

RADIUS, FRAMES = 0.0035, 6
TILT = np.array([0.2, 0.0, 1.0]) / np.sqrt(1.04)


@pytest.fixture(autouse=True)
def folder(tmp_path):
    (tmp_path / "in").mkdir()


def presses(seed=0, stiffness=1.0, count=30, apart=0.004):
    """Presses on the plane z = -0.2 x: contacts (n, 3), centres and forces (n, T, 3); F = k d^1.5 along the normal."""
    rng = np.random.default_rng(seed)
    x, y = np.meshgrid(np.arange(6) * apart, np.arange(count // 6) * apart)
    contact = np.stack([x.ravel(), y.ravel(), -0.2 * x.ravel()], axis=1)
    depth = np.linspace(0.0, 0.003, FRAMES)
    k = stiffness * (4e3 + 4e3 * rng.random(count))
    position = contact[:, None] + (RADIUS - depth)[None, :, None] * TILT
    return contact, position, (k[:, None] * depth**1.5)[..., None] * TILT


def write_npz(path, made, radius=RADIUS, **more):
    contact, position, force = made
    np.savez(path.with_suffix(".npz"), position=position, force=force,
             normal=np.tile(TILT, (len(contact), 1)), radius=radius, **more)


def write_csv(path, made, head="press,x,y,z,fx,fy,fz,nx,ny,nz,radius"):
    rows = [[k, *p, *f, *TILT, RADIUS] for k, (ps, fs) in enumerate(zip(made[1], made[2])) for p, f in zip(ps, fs)]
    np.savetxt(path.with_suffix(".csv"), rows, delimiter=",", header=head, comments="", fmt="%.12g")


def write_mat(path, made):
    matio = pytest.importorskip("matio")
    from matio.utils.matclass import MatlabOpaque

    found = np.empty((len(made[0]), 1), object)
    for k, (contact, position, force) in enumerate(zip(*made)):
        found[k, 0] = MatlabOpaque({
            "CurrentPos": 1e3 * position, "DeformedForce": force, "ContactSurfNorm": TILT[:, None],
            "ContactPoint": 1e3 * contact[:, None], "ContactBallCenter": 1e3 * (contact + RADIUS * TILT)[:, None],
            "Fail": np.zeros((0, 0))}, "ProbingData")
    matio.save_to_mat(str(path.with_suffix(".mat")), {"RESULTS": found})


@pytest.mark.parametrize("write", [write_npz, write_csv, write_mat])
def test_each_format_gives_the_presses_that_were_made(write, tmp_path):
    made = presses()
    write(tmp_path / "in" / "plane", made)
    dataset = import_probings(tmp_path / "in", tmp_path / "d")
    assert verify(tmp_path / "d").ok
    view = dataset[0]
    assert len(view.touches) == 30 and view.probe.radius == pytest.approx(RADIUS) and not len(view.truth.points)
    for touch, contact, position, force in zip(view.touches, *made):
        np.testing.assert_allclose(touch.target, contact, atol=1e-8)
        np.testing.assert_allclose(touch.mount_pose[:, :3, 3], position, atol=1e-9)
        np.testing.assert_allclose(touch.normal_force(), force @ TILT, atol=1e-9)


def test_rows_of_a_press_that_was_stopped_are_left_out(tmp_path):
    contact, position, force = presses()
    position[3, 4:], force[3, 4:] = 0.0, 0.0
    write_mat(tmp_path / "in" / "plane", (contact, position, force))
    lengths = [len(touch.time) for touch in import_probings(tmp_path / "in", tmp_path / "d")[0].touches]
    assert lengths == [FRAMES] * 3 + [4] + [FRAMES] * 26


def test_what_is_left_out_and_how_well_another_day_repeats_it_is_told(tmp_path):
    """Forces a tenth larger on another day are off by a tenth of zero's error, and presses that say nothing count."""
    contact, position, force = presses()
    write_npz(tmp_path / "in" / "later", (contact + 2e-4 * TILT, position, 1.1 * force))
    position[5] = position[5, :1] - np.linspace(0.0, 4e-4, FRAMES)[:, None] * TILT
    force[6] *= 100.0
    position[7, 2] = np.nan
    failed = np.arange(30) == 8
    write_npz(tmp_path / "in" / "first", (contact, position, force), failed=failed)
    run = CliRunner().invoke(app, ["lab", "import", str(tmp_path / "in"), "--from", "probings", "--again", "later",
                                   "--touches", "12", "--out", str(tmp_path / "d"), "--json", str(tmp_path / "said")])
    said = json.loads((tmp_path / "said").read_text())
    assert said["left_out"] == {"first": {"less than 0.5 mm deep": 1, "over 20 N": 1, "failed": 2}, "later": {}}
    output = " ".join(run.output.split())
    assert "1 less than 0.5 mm deep" in output and "later repeats 26 places of first" in output
    assert said["again"]["later"]["rmse_ratio"] == pytest.approx(0.1 / 1.1, abs=1e-3)
    assert (said["objects"], said["touches"]) == (1, 12)


@pytest.mark.parametrize("pitch", [0.0005, 0.002])
def test_the_picture_is_the_plane_between_the_contacts(pitch):
    points = presses()[0]
    seen = view_from_above(points, pitch).points()
    assert np.abs(seen[:, 2] + 0.2 * seen[:, 0]).max() < 1e-6
    assert (np.ptp(seen, axis=0) > 0.8 * np.ptp(points, axis=0)).all()
    row = np.unique(seen[:, 1].round(5))
    assert np.median(np.diff(row[np.diff(row, prepend=-1) > 0.5 * pitch])) == pytest.approx(pitch, rel=0.05)


def test_a_pitch_of_zero_shows_the_contacts_alone_and_an_offset_moves_them_out(tmp_path):
    points = presses()[0]
    seen = view_from_above(points, 0.0).points()
    assert len(seen) == len(points) and np.abs(np.sort(seen, axis=0) - np.sort(points, axis=0)).max() < 1.5e-4
    write_npz(tmp_path / "in" / "plane", presses())
    moved = import_probings(tmp_path / "in", tmp_path / "d", Options(pitch=0.0, contact_offset=0.001))[0]
    np.testing.assert_allclose(moved.touches[4].target, points[4] + 0.001 * TILT, atol=1e-9)
    np.testing.assert_allclose(moved.touches[4].mount_pose[0, :3, 3], points[4] + RADIUS * TILT, atol=1e-9)


@pytest.mark.parametrize("write, options, said", [
    (lambda path: write_csv(path, presses(), head="press,x,y,z,fx,fy,fz,nx,ny,nz"), Options(), "plane.csv"),
    (lambda path: write_npz(path, presses(), contact=np.zeros((29, 3))), Options(), "plane.npz"),
    (lambda path: write_npz(path, presses(), radius=3.5), Options(), r"3\.5 m.*metres"),
    (lambda path: write_npz(path, presses()), Options(touches=40), "30 usable presses"),
    (lambda path: np.savez(path, force=1.0, position=1.0), Options(), "plane.npz"),
    (lambda path: write_npz(path, presses(count=6)), Options(), "10 are needed"),
    (lambda path: write_npz(path, presses()), Options(again=("plan",)), "and plan"),
    (lambda path: path.with_suffix(".csv").write_text(""), Options(), "plane.csv.*is empty"),
    (lambda path: None, Options(), "no file")])
def test_what_cannot_be_read_is_refused_with_its_name(write, options, said, tmp_path):
    write(tmp_path / "in" / "plane")
    with pytest.raises(DatasetError, match=said):
        import_probings(tmp_path / "in", tmp_path / "d", options)
    assert not (tmp_path / "d").exists()
