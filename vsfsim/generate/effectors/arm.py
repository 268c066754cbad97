"""Object views of plants touched by an arm: grown, seen, touched, and the truth said."""

from __future__ import annotations

import dataclasses
import time
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from vsfsim.core.errors import SceneError
from vsfsim.core.plant import Plant
from vsfsim.core.scene import CameraSpec, Scene, TouchSpec, parse_scene
from vsfsim.core.shape import Family
from vsfsim.data.records import AUDIT_COLUMNS, ObjectView, Touch, View
from vsfsim.generate.effectors.probe import _BALANCE, REASONS
from vsfsim.generate.plants.aim import ArmAim, aim_arm, load
from vsfsim.generate.plants.surface import plant_view
from vsfsim.generate.plants.truth import plant_truth
from vsfsim.physics.rods.family import grow as grow_family
from vsfsim.physics.rods.model import RodModel, build
from vsfsim.physics.rods.solver import RodBatch, RodFrames, RodOptions, RodSolver
from vsfsim.robot.arm import Arm
from vsfsim.robot.chain import chain_of
from vsfsim.robot.dynamic import IMPEDANCE, POSITION, series, simulate
from vsfsim.robot.joint_torque import body_torque
from vsfsim.robot.path import times
from vsfsim.sensing.camera import look_at
from vsfsim.sensing.kinect import kinect_depth

_DEPTH = 3  # random stream of the depth camera's noise, after those of `generate.run`
# rad/s: the dynamic arm takes its time, so that no joint turns faster; readings are then further apart in time
JOINT_RATE = 0.3
# Newton iterations of a guarded touch: of one try at a stride, of a frame, after which it is not tried in shorter
# strides any more, and in all.
TRAVEL, WORK, PATIENCE = 120, 120, 30_000
# with 200 for the second the work is a third more and the longest touch half as long again, and 3.7 % of the readings
# are marked instead of 4.5 %; with 400 and 800, those of other touches, it is twice as much


@dataclass
class Seconds:
    """Where the time goes, stage by stage: on the clock, and of this process's CPU [s]."""

    spent: Counter = field(default_factory=Counter)
    cpu: Counter = field(default_factory=Counter)
    _last: float = field(default_factory=time.process_time)

    def begin(self) -> float:
        """Starts a stage; the clock's time, for `charge`."""
        self._last = time.process_time()
        return time.perf_counter()

    def charge(self, stage: str, since: float) -> float:
        """Ends a stage and starts the next one."""
        now, busy = time.perf_counter(), time.process_time()
        self.spent[stage] += now - since
        self.cpu[stage] += busy - self._last
        self._last = busy
        return now


def make_views(jobs: Sequence[Any], *, device: str, progress: Callable[[int], None] | None = None,
               seconds: Seconds | None = None) -> list[ObjectView]:
    """The object views of some jobs (`generate.run.Job`), touched together.

    Args:
        device: Warp device. progress: called with the number of frames newly done. seconds: where the time is charged.
    """
    return touch([prepare_job(job, device=device, seconds=seconds) for job in jobs], device=device, progress=progress,
                 seconds=seconds)


@dataclass(frozen=True)
class Outline:
    """A view before it is seen: its scene, the plant as this view turns it, and that as beams. seeds: streams by name:
    "depth", and "aim" with the number of a touch."""

    scene: Scene
    touches: TouchSpec
    plant: Plant
    model: RodModel
    seeds: Callable[[str], Any]


def outline(job: Any) -> Outline:
    """The plant of a job (`generate.run.Job`), turned for its view."""
    from vsfsim.generate.run import _AIM, _BODY, _SCENE, stream

    r = job.recipe
    scene = parse_scene(r.scene_text, job.path).sample(stream(r.seed, _SCENE, job.object_index))
    assert scene.arm is not None and scene.touches is not None
    if "arm" in r.options:
        scene = dataclasses.replace(scene, arm=dataclasses.replace(scene.arm, model=r.options["arm"]))
    o, v = job.object_index, job.view_index

    def seeds(name: str) -> np.random.SeedSequence:
        return stream(r.seed, _DEPTH, o, v) if name == "depth" else stream(r.seed, _AIM, o, v, int(name.split()[1]))

    plant = grow(scene, stream(r.seed, _BODY, o), number=o).turned(2.0 * np.pi * v / r.views)
    return Outline(scene, dataclasses.replace(scene.touches, count=r.touches), plant,
                   build(plant, gravity=scene.gravity), seeds)


def prepare_job(job: Any, *, device: str, seconds: Seconds | None = None) -> Subject:
    """The view of a job, ready to be touched: its picture is taken and its touches are chosen."""
    seconds = seconds or Seconds()
    since = seconds.begin()
    o = outline(job)
    seconds.charge("grow", since)
    view = look(o, job, device=device, seconds=seconds)
    arm, aims, poses = choose(o, view.points(), range(o.touches.count), seconds=seconds)
    return Subject(job.name, job.split, (job.object_index, job.view_index), o.scene, o.plant, o.model, view, arm, aims,
                   poses)


def look(o: Outline, job: Any, *, device: str, seconds: Seconds) -> View:
    """What the scene's camera sees of the plant of a job."""
    since = seconds.begin()
    view = see(o.plant, o.scene.camera, device=device, renderer=job.recipe.renderer)
    if o.scene.camera.noise == "kinect":
        view = kinect_depth(view, o.seeds("depth"))
    seconds.charge("look", since)
    return view


def choose(o: Outline, cloud: np.ndarray, numbers: range, *, seconds: Seconds) -> tuple[Arm, list[ArmAim], np.ndarray]:
    """The scene's arm, the touches ``numbers`` of a view whose visible cloud (n, 3) [m] is given, and the poses of the
    arm's capsules along their lines (P, B, K, 4, 4) [m]."""
    since = seconds.begin()
    assert o.scene.arm is not None
    arm = load(o.scene.arm)
    aims = aim_arm(arm, o.scene.arm, o.touches, o.plant, cloud, lambda k: np.random.default_rng(o.seeds(f"aim {k}")),
                   numbers=numbers, where=str(o.scene.source))
    since = seconds.charge("aim", since)
    poses = np.stack([arm.body_poses(a.line) for a in aims], axis=1)
    seconds.charge("kinematics", since)
    return arm, aims, poses


@dataclass(frozen=True)
class Subject:
    """A view that is ready to be touched, or some touches of it. name, split: of the view. numbers: (object, view).
    plant: turned as this view shows it. poses: of the arm's capsules along the lines of the touches (P, B, K, 4, 4)
    [m]."""

    name: str
    split: str
    numbers: tuple[int, int]
    scene: Scene
    plant: Plant
    model: RodModel
    view: View
    arm: Arm | None
    aims: list[ArmAim]
    poses: np.ndarray


def grow(scene: Scene, seed: np.random.SeedSequence | int, *, number: int = 0) -> Plant:
    """The plant of a scene, as object ``number`` of its dataset.

    Raises:
        SceneError: its object is no family of plants, or a parameter is wrong.
    """
    shape = scene.object.shape
    if not isinstance(shape, Family):
        raise SceneError(f"{scene.source} [arm]: an arm touches plants; give [object.shape] family = \"plant\", not "
                         f"{type(shape).__name__.lower()}.")
    plant = grow_family(shape, np.random.default_rng(seed),
                        where=f"{scene.source} [object.shape] family '{shape.name}'", number=number)
    return dataclasses.replace(plant.turned(scene.object.yaw), poisson_ratio=min(scene.object.poisson_ratio, 0.49))


def see(plant: Plant, camera: CameraSpec, *, device: str, renderer: str) -> View:
    """The picture of a table camera that stands still while plants are turned."""
    low, high = plant.nodes.min(axis=0), plant.nodes.max(axis=0)
    intrinsics, pose = look_at(camera, np.array([0.0, 0.0, 0.5 * (low[2] + high[2])]))
    return plant_view(plant, intrinsics, pose, camera.width, camera.height, device=device, renderer=renderer)


def touch(subjects: Sequence[Subject], *, device: str, progress: Callable[[int], None] | None = None,
          seconds: Seconds | None = None) -> list[ObjectView]:
    """Carry out the touches of some views together."""
    found = solve(subjects, device=device, progress=None if progress is None else lambda frames, _: progress(frames),
                  seconds=seconds)
    return [finish(subject, frames, device=device, seconds=seconds) for subject,
            frames in zip(subjects, found, strict=True)]


def rod_options(scene: Scene) -> RodOptions:
    """Of the solver, as the scene has them."""
    assert scene.touches is not None and scene.arm is not None
    guarded = scene.arm.at_limit == "return"
    _, _, hold, out = scene.touches.frames
    options = RodOptions(force_limit=scene.touches.force_limit)
    return dataclasses.replace(options, guarded=True, hold=hold, out=out, travel=TRAVEL, work=WORK,
                               patience=PATIENCE) if guarded else options


def begin(batch: RodBatch, subject: Subject, number: int) -> slice:
    """The touches of a subject enter a batch, as of its solver's plant ``number``; their places."""
    aims = subject.aims
    return batch.add(np.full(len(aims), number), subject.poses, plan=np.stack([a.plan for a in aims]),
                     friction=subject.scene.object.friction, inward=np.array([a.inward for a in aims]))


def solve(subjects: Sequence[Subject], *, device: str, progress: Callable[[int, int], None] | None = None,
          seconds: Seconds | None = None, keep_nodes: bool = False) -> list[RodFrames]:
    """The equilibria of some views' touches, for each view its frames; in `plant_batches` views come and go.

    Args:
        progress: called with the number of frames newly done and of the touches that go on. keep_nodes: as of
        `RodSolver.run`.
    """
    seconds = seconds or Seconds()
    since = seconds.begin()
    solver = RodSolver([s.model for s in subjects], arm_of(subjects[0]).shapes, device=device,
                       options=rod_options(subjects[0].scene))
    batch = RodBatch(solver, sum(len(s.aims) for s in subjects), frames=len(subjects[0].aims[0].plan),
                     poses=len(subjects[0].poses), keep_nodes=keep_nodes)
    places = [begin(batch, s, k) for k, s in enumerate(subjects)]
    while batch.live:
        new = batch.advance()
        if progress is not None:
            progress(new, batch.live)
    out = [batch.take(some) for some in places]
    seconds.charge("solve", since)
    return out


def finish(subject: Subject, frames: RodFrames, *, device: str, seconds: Seconds | None = None) -> ObjectView:
    """The object view of a touched subject: records, torques and truth."""
    seconds = seconds or Seconds()
    since = seconds.begin()
    arm = arm_of(subject)
    touches = finish_touches(subject, frames)
    since = seconds.charge("torque", since)
    chain = chain_of(arm)
    truth = plant_truth(subject.model, subject.view, touches, chain, friction=subject.scene.object.friction,
                        device=device)
    seconds.charge("truth", since)
    return ObjectView(subject.name, *subject.numbers, subject.split, chain, subject.view, tuple(touches), truth)


def finish_touches(subject: Subject, frames: RodFrames) -> list[Touch]:
    """The records and torques of a touched subject."""
    arm = arm_of(subject)
    subject = dataclasses.replace(subject, arm=arm)
    return [_touch(subject, a, frames, b) for b, a in enumerate(subject.aims)]


def arm_of(subject: Subject) -> Arm:
    """Its arm; loaded anew in a process to which it did not travel."""
    assert subject.scene.arm is not None
    return subject.arm or load(subject.scene.arm)


def _touch(subject: Subject, a: ArmAim, frames: RodFrames, b: int) -> Touch:
    spec, arm = subject.scene.arm, subject.arm
    assert spec is not None and arm is not None
    n = int(frames.frames[b])
    if n < len(a.plan) and spec.at_limit == "end":
        # stopped by the force limit: what did not converge on the way there is no reading either
        good = np.flatnonzero(frames.converged[:n, b])
        n = int(good[-1]) + 1 if len(good) else 1
    # a touch whose first frame is past the limit has one frame, which was not solved
    q = a.angles(np.where(np.isfinite(frames.where[:n, b]), frames.where[:n, b], a.plan[:n]))
    postures = arm.postures(q)
    force, moment = frames.force[:n, b], frames.moment[:n, b]
    time_ = times(n)
    if spec.mode == "dynamic" and n > 1:
        time_ = time_ * max(1.0, float(np.abs(np.diff(q, axis=0)).max() / np.diff(time_).min()) / JOINT_RATE)
        motion = simulate(arm, q, time_, series(time_, force, moment),
                          drive=IMPEDANCE if spec.drive == "impedance" else POSITION)
        q, torque = motion.q, motion.torque
    else:
        torque = body_torque(arm, postures, force, moment=moment)
    link_force, link_moment = _by_link(arm, postures, force, moment)
    found = frames.converged[:n, b] & np.isfinite(torque).all(axis=1)
    converged = found & (frames.force_balance[:n, b] <= _BALANCE)
    audit = {name: getattr(frames, name)[:n, b] for name in AUDIT_COLUMNS if name != "min_det_f"}
    return Touch(time=time_, mount_pose=postures.tool, axis=a.axis, target=a.target, normal=-a.axis,
                 force=force.sum(axis=1), reaction=frames.reaction[:n, b], converged=converged,
                 residual=frames.residual[:n, b], iterations=frames.iterations[:n, b].astype(np.int64),
                 touched=bool((frames.contacts[:n, b] > 0).any()),
                 reason=np.where(converged, 0, np.where(found, len(REASONS), frames.reason[:n, b])).astype(np.int64),
                 reason_names=REASONS, audit=audit, q=q, torque=torque, link_force=link_force, link_moment=link_moment,
                 draws=a.draws, ended=int(frames.ended[b]) if spec.at_limit == "return" else None)


def _by_link(arm: Arm, at: Any, force: np.ndarray, moment: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Wrenches on the links, moments about their origins, two arrays (T, L, 3)."""
    place = arm.capsule_poses(at)[..., :3, 3] - at.links[:, arm.capsule_links][..., :3, 3]
    about = moment + np.cross(place, force)
    out = np.zeros((2, len(force), len(arm.links), 3))
    for k, link in enumerate(arm.capsule_links):
        out[0, :, link] += force[:, k]
        out[1, :, link] += about[:, k]
    return out[0], out[1]
