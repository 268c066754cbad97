"""Recordings of real robots in openvsf's layout, written here, as datasets without truth."""

import dataclasses
import itertools
import json
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial import cKDTree
from texts import text

from vsfsim.bench.evaluate import evaluate
from vsfsim.bench.protocol import record
from vsfsim.bench.task import load_task, open_dataset
from vsfsim.core.errors import DatasetError, TaskError
from vsfsim.data.dataset import Dataset
from vsfsim.data.formats.export import export
from vsfsim.data.formats.openvsf import pcd_bytes
from vsfsim.data.verify import summary_rows, verify
from vsfsim.generate.recorded import clouds
from vsfsim.generate.recorded.clouds import read_pcd, view_of_cloud
from vsfsim.generate.recorded.openvsf import GAUGE, Options, _on_arm, import_openvsf
from vsfsim.physics.mesh.membrane import READ_OUT, closed, ellipse
from vsfsim.robot.arm import Arm, body_torque
from vsfsim.vsf.observe import normal_force_rows
from vsfsim.vsf.sticking import stick

pytest.importorskip("yaml")

def task_of(kind, tmp_path):
    """The task of predicting readings of this kind."""
    (tmp_path / "task.toml").write_text(text(
        "sprung-v1", name='"recorded-v1"', observation=f'{{ kind = "{kind}" }}',
        dataset='{ folder = "recorded", scene = "real", seed = 0, objects = 4, views = 1, touches = 4 }',
        protocol="{ folds = 2, shots = [0, 2], draws = 1, trainings = 1, query = 2, seed = 0 }",
        noise="{ force_std = 0.0, tare_frames = 0, seed = 0 }", metrics='{ primary = "rmse_ratio", ranking_shot = 2 }'))
    return load_task(tmp_path / "task.toml")


def punyo(mount):
    """A Punyo's free dome over its base, as the sensor's published mesh has it: vertices [m] and triangles, those of
    the dome first, in the frame of the arm's link that carries it; the area inside the rim [m^2]; and its ``mount``."""
    a, b = 0.05725, 0.040
    flat, faces, rim = ellipse(a, b, READ_OUT)
    height = 30.89e-3 * np.clip(1.0 - (flat[:, 0] / a) ** 2 - (flat[:, 1] / b) ** 2, 0.0, None) ** 0.763
    height[rim] = 0.0
    z = np.array([-0.39394, 0.0, 0.91914])  # openvsf's figures, see vsfsim/robot/gen3.xml
    x = np.array([0.91914, 0.0, 0.39394])
    vertices = [0.0157, 0.0, 0.0655] + np.column_stack([flat, height]) @ np.stack([x, np.cross(z, x), z])
    p = vertices[faces][:, :, :2]
    e, f = p[:, 1] - p[:, 0], p[:, 2] - p[:, 0]
    area = 0.5 * (e[:, 0] * f[:, 1] - e[:, 1] * f[:, 0]).sum()
    return SimpleNamespace(vertices=vertices, triangles=closed(faces, rim), area=float(area), mount=mount)


def write_object(place, rng, *, bubble, touches=4, frames=9, tare=5):
    """One object: a block of springs under a bubble, or a push on the last link of the arm; returns what was felt."""
    arm = Arm(punyo=bubble is not None, tool="flange")
    start = np.array([0.0, 0.35, np.pi, -2.0, 0.0, 0.6, 1.57]) + 0.05 * rng.standard_normal(7)
    end = arm.postures(start[None]).tool[0]
    if bubble is not None:
        end = end @ bubble.mount
    top = np.zeros(3) if bubble is None else bubble.vertices[bubble.vertices[:, 2].argmax()]
    apex = end[:3, 3] + end[:3, :3] @ top
    springs = apex + rng.uniform([-0.08, -0.08, -0.04], [0.08, 0.08, 0.0], (4000, 3))
    out = []
    for k in range(touches):
        stop = start + 0.03 * rng.standard_normal(7) * [1, 1, 0, 1, 0, 1, 0] + [0, 0.02, 0, 0, 0, 0, 0]
        way = np.r_[np.zeros(tare), np.linspace(0.0, 1.0, frames - tare)]
        q = start - [0, 0.12, 0, 0, 0, 0, 0] + way[:, None] * (stop - start + [0, 0.12, 0, 0, 0, 0, 0])
        seq = place / f"seq_{k:03d}"
        seq.mkdir(parents=True)
        if bubble is None:
            np.save(seq / "angles.npy", q)
            force = np.zeros((frames, len(arm.capsules), 3))
            force[tare:, -1] = np.linspace(0.0, 4.0, frames - tare)[:, None] * [0.2, 0.1, 1.0]
            felt = body_torque(arm, arm.postures(q), force, moment=np.zeros_like(force))
            np.save(seq / "torques.npy", felt - arm.gravity_torque(q) + rng.standard_normal(7))
        else:
            np.save(seq / "kinova_state.npy", q)
            body = arm.postures(q).tool @ bubble.mount
            turn = body[:, :3, :3]
            dome = bubble.triangles[:2 * (len(bubble.vertices) - 1) - 64]
            stuck = stick(springs, np.einsum("tij,nj->tni", turn, bubble.vertices) + body[:, None, :3, 3], dome)
            rows = normal_force_rows(stuck, len(springs), turn[:, :, 2]) / bubble.area
            felt = rows @ np.full(4000, 2.0)
            felt = np.where(np.arange(frames) < tare, 0.0, felt + 50.0)
            np.save(seq / "punyo_pressure.npy", (106_500.0 + felt[:, None]) / 100.0)
            np.save(seq / "punyo_state.npy", np.tile(bubble.vertices, (frames, 1, 1)))
        out.append((q, felt))
    eye = apex + [0.3, 0.1, 0.5]
    floor = apex + np.c_[rng.uniform(-0.4, 0.4, (3000, 2)), np.full(3000, -0.05)]
    cloud, colours = np.concatenate([springs, floor]), rng.integers(0, 255, (7000, 3)).astype(np.uint8)
    (place / "bg_pcd.pcd").write_bytes(pcd_bytes(cloud, colours))
    low, high = springs.min(axis=0) - 0.002, springs.max(axis=0) + 0.002
    (place / "rgbd_factory_config.yaml").write_text(
        f"bbox:\n- {low.tolist()}\n- {high.tolist()}\nview:\n  origin: {eye.tolist()}\nfps_num: 30000\n")
    return out, (low, high), eye


@pytest.fixture(scope="module")
def plants(tmp_path_factory):
    place, rng = tmp_path_factory.mktemp("rec") / "real", np.random.default_rng(0)
    felt = {f"plant{k}": write_object(place / f"plant{k}", rng, bubble=None) for k in range(4)}
    return felt, place, import_openvsf(place, place.parent / "d", Options(tare=5))


@pytest.fixture(scope="module")
def shoes(tmp_path_factory):
    place, rng, bubble = tmp_path_factory.mktemp("rec") / "real", np.random.default_rng(1), punyo(_on_arm()[0])
    felt = {f"shoe{k}": write_object(place / f"shoe{k}", rng, bubble=bubble) for k in range(4)}
    mesh = place.parent / "punyo.obj"
    mesh.write_text("".join([*(f"v {x!r} {y!r} {z!r}\n" for x, y, z in bubble.vertices.tolist()),
                             *(f"f {a} {b} {c}\n" for a, b, c in (bubble.triangles + 1).tolist())]))
    return felt, place, mesh, import_openvsf(place, place.parent / "d", Options(bubble=mesh, tare=5))


def test_torques_of_an_arm_lose_weight_and_tare_and_nothing_else(plants):
    felt, _, dataset = plants
    for view in dataset:
        touches, (low, high), eye = felt[view.name]
        assert len(view.touches) == 4 and len(view.truth.points) == 0 and view.truth.region_names == ()
        for touch, (q, want) in zip(view.touches, touches, strict=True):
            assert np.array_equal(touch.q, q[4:]) and touch.touched and touch.converged.all()
            assert "min_det_f" not in touch.audit and np.isnan(touch.audit["force_balance"]).all()  # nobody read them
            assert np.abs(touch.torque - want[4:]).max() < 1e-9
            assert np.isnan(touch.force).all() and np.isnan(touch.reaction).all()
        cloud = view.view.points()
        assert len(cloud) > 300 and (cloud > low - 0.02).all() and (cloud < high + 0.02).all()
        assert np.allclose(view.view.camera_pose[:3, 3], eye)
    assert verify(dataset.path).ok
    assert ("true E", "none Pa over all elements") in summary_rows(dataset.path)
    assert "no elements" in repr(dataset[0].truth)


def test_pressures_of_a_bubble_become_pascals_over_the_tare(shoes, tmp_path):
    felt, _, _, dataset = shoes
    for view in dataset:
        read = np.ravel(record(view, task_of("pressure", tmp_path)).clean)
        assert read == pytest.approx(np.ravel([w[4:] for _, w in felt[view.name][0]]), abs=1e-6)
        for touch, (_, want) in zip(view.touches, felt[view.name][0], strict=True):
            assert touch.rest_pressure == GAUGE and np.allclose(touch.pressure - GAUGE, want[4:], atol=1e-6)
            assert touch.node_position.shape == (5, 390, 3) and len(touch.node_triangles) == 714
            local = np.einsum("tij,tni->tnj", touch.mount_pose[:, :3, :3],
                              touch.node_position - touch.mount_pose[:, None, :3, 3])
            assert np.abs(local - touch.node_rest).max() < 1e-6
            assert 0.030 < view.probe.height < 0.0315 and np.abs(touch.node_rest[:, 2]).min() < 1e-6
    assert verify(dataset.path).ok


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "method"), [
    *itertools.product(["joint-torque", "pressure"], ["point-vsf", "sbml"]), ("pressure", "surface-gp")])
def test_methods_are_scored_on_recordings(plants, shoes, tmp_path, kind, method):
    dataset = plants[2] if kind == "joint-torque" else shoes[3]
    task = task_of(kind, tmp_path)
    found = evaluate(method, task, open_dataset(task, dataset.path), check=False)
    assert all(np.isfinite(found.scores["rmse_ratio"][shot].mean) for shot in task.protocol.labels)
    assert "stiffness_spearman" not in found.scores


def test_a_task_of_what_was_not_read_is_refused(plants, tmp_path):
    with pytest.raises(TaskError, match="has no contact force"):
        record(plants[2][0], task_of("normal-force", tmp_path))


def test_a_cloud_is_read_as_it_was_written_and_becomes_a_picture(tmp_path):
    rng = np.random.default_rng(2)
    points = rng.uniform(-0.1, 0.1, (5000, 3))
    points[:, 2] = 0.02 * np.sin(20 * points[:, 0])
    points = points.astype(np.float32).astype(float)
    colours = rng.integers(0, 256, points.shape).astype(np.uint8)
    (tmp_path / "c.pcd").write_bytes(pcd_bytes(points, colours))
    found, painted = read_pcd(tmp_path / "c.pcd")
    assert np.array_equal(found, points) and np.array_equal(painted, colours)
    packed = (colours.astype(np.uint32) << [16, 8, 0]).sum(axis=1, dtype=np.uint32)
    rows = "\n".join(f"{x!r} {y!r} {z!r} {int(c)}" for (x, y, z), c in zip(points.tolist(), packed))
    (tmp_path / "a.pcd").write_text("VERSION .7\nFIELDS x y z rgb\nSIZE 8 8 8 4\nTYPE F F F U\nCOUNT 1 1 1 1\n"
                                    f"WIDTH 5000\nHEIGHT 1\nPOINTS 5000\nDATA ascii\n{rows}\n")
    assert np.array_equal(read_pcd(tmp_path / "a.pcd")[1], colours)
    eye = np.array([0.1, -0.4, 0.5])
    view = view_of_cloud(points, colours, points[:, 0] > -0.05, eye)
    distance, index = cKDTree(points).query(view.points())
    assert distance.max() < 0.003 and (points[index, 0] > -0.053).all()
    (tmp_path / "bad.pcd").write_bytes(pcd_bytes(points, colours)[:-100])
    with pytest.raises(DatasetError, match=r"bad\.pcd cannot be understood as a PCD file"):
        clouds.read_pcd(tmp_path / "bad.pcd")


@pytest.mark.parametrize("harm, words", [
    (lambda seq: (seq / "angles.npy").unlink(), r"seq_001 has no kinova_state.npy or angles.npy"),
    (lambda seq: np.save(seq / "torques.npy", np.zeros((9, 6))),
     r"torques.npy has the shape \(9, 6\); \(9, 7\)"),
    (lambda seq: np.save(seq / "angles.npy", np.full((9, 7), np.nan)),
     r"angles.npy is not finite in frame 0"),
    (lambda seq: (seq.parent / "bg_pcd.pcd").unlink(),
     r"has no bg_pcd.pcd and rgbd_factory_config.yaml.*--assets"),
    (lambda seq: (seq.parent / "rgbd_factory_config.yaml").write_text("bbox: [["),
     r"cannot be read as YAML"),])
def test_a_bad_folder_is_named_and_leaves_nothing(tmp_path, harm, words):
    write_object(tmp_path / "real" / "one", np.random.default_rng(3), bubble=None, touches=2)
    harm(tmp_path / "real" / "one" / "seq_001")
    with pytest.raises(DatasetError, match=words):
        import_openvsf(tmp_path / "real", tmp_path / "d", Options(tare=5))
    assert [p.name for p in tmp_path.iterdir()] == ["real"]


def test_words_on_the_command_line_are_checked(plants, shoes, tmp_path):
    _, place, mesh, _ = shoes
    with pytest.raises(DatasetError, match=r"nothing names the mesh of the bubble.*--bubble"):
        import_openvsf(place, tmp_path / "d", Options(tare=5))
    with pytest.raises(DatasetError, match="the first 10 are its tare"):
        import_openvsf(place, tmp_path / "d", Options(bubble=mesh))
    with pytest.raises(DatasetError, match="exists already"):
        import_openvsf(place, plants[2].path, Options(bubble=mesh, tare=5))
    for k in range(1, 3):
        np.save(place / "shoe0" / f"seq_{k:03d}" / "keep.npy", np.zeros(1))  # files of others do not matter
    assert len(import_openvsf(place / "shoe0", tmp_path / "one", Options(bubble=mesh, tare=5, every=2))) == 1


def test_what_we_export_for_openvsf_comes_back(plants, tmp_path):
    """Joint angles and torques to the bit, without a second subtraction of the weight."""
    _, _, dataset = plants
    out = export(dataset.path, "openvsf", tmp_path / "o")
    assert json.loads((out / "plant1" / "manifest.json").read_text())["torques"] == "contact"
    back = import_openvsf(out, tmp_path / "back")
    for one, other in zip(dataset, back, strict=True):
        for a, b in zip(one.touches, other.touches, strict=True):
            assert np.array_equal(a.q, b.q[1:]) and np.allclose(a.torque - a.torque[0], b.torque[1:], atol=1e-12)
        seen, again = one.view.points(), other.view.points()
        assert abs(len(seen) - len(again)) < 0.4 * len(seen)
    assert Dataset.open(tmp_path / "back").names() == dataset.names()
    assert dataclasses.asdict(dataset.recipe)["tier"] == "recorded"
