"""Time of a bubble on a soft object: `vsfsim measure bubble`.

Two measurements on a shoe of `shoes-punyo-mini`, at tier `fem` with cells small enough for 5,000 tetrahedra. *One
touch*: a sealed poke, after another touch of the same object, when mesh, factor, inflation and kernels exist; CPU
seconds and iterations of a frame with their parts. *A batch*: touches of that object that advance together, touches a
minute. Every frame reports its progress, so that an interrupted run has shown something.
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass

import numpy as np

from measurements.measurement import Column, Measurement, Progress, Table
from vsfsim.core.scene import Scene, TouchSpec, load_scene
from vsfsim.core.shelf import find_scene
from vsfsim.data.streams import Stream, stream
from vsfsim.generate.aim import Aim
from vsfsim.generate.effectors import bubble as touch_bubble
from vsfsim.generate.solid import surface_of
from vsfsim.physics import clock, tiers
from vsfsim.physics.bubble.sensor import BubbleModel, build_bubble
from vsfsim.physics.elements.block import elements_of
from vsfsim.physics.model import Model
from vsfsim.physics.runtime import compile_kernels
from vsfsim.physics.solve.coupled import CoupledSolver
from vsfsim.physics.solve.frames import Frames, Reason
from vsfsim.physics.solve.kernels import coupled_kernels

SCENE = "shoes-punyo-mini"
TIER, RESOLUTION = "fem", 0.0095  # m: 5,256 tetrahedra
FRAMES = 15
TARGET_FRAME, TARGET_MINUTE = 0.5, 200.0
"""Targets: seconds a frame on one CPU core; touches a minute on one H200."""
_PICTURE = (160, 120)  # pixels of the view that targets are drawn on


@dataclass(frozen=True)
class Poke:
    """The second touch of an object."""

    device: str
    """Warp device."""
    tier: str
    """Fidelity of the object."""
    tets: int
    """Tetrahedra of the object [-]."""
    unknowns: int
    """Unknowns of both bodies together [-]."""
    nodes: int
    """Nodes of the bubble [-]."""
    frames: int
    """Frames of the touch [-]."""
    in_contact: int
    """Frames with a force [-]."""
    force: float
    """Contact force at full depth [N]."""
    pressure: float
    """Change of the gauge pressure there [Pa]."""
    seconds: float
    """Time of a frame in contact, on the clock [s]."""
    cpu_seconds: float
    """Time of a frame in contact, of the process [s]."""
    worst_seconds: float
    """Time of the slowest frame [s]."""
    newton: float
    """Newton iterations of a frame in contact [-]."""
    cg: float
    """Conjugate gradients of a frame in contact [-]."""
    converged: float
    """Share of all frames that converged [-]."""
    residual: float
    """Worst relative residual of a converged frame [-]."""
    parts: dict[str, float]
    """Time of each part of the solver over the touch [s]."""
    build_seconds: float
    """Time to build mesh, factor and bubble, once an object [s]."""
    first_seconds: float
    """Time of the first touch [s]."""


@dataclass(frozen=True)
class Batch:
    """Many touches of one object together."""

    device: str
    """Warp device."""
    tier: str
    """Fidelity of the object."""
    touches: int
    """Number of touches [-]."""
    frames: int
    """Frames of a touch [-]."""
    seconds: float
    """Time of all touches [s]."""
    per_minute: float
    """Touches a minute [1/min]."""
    newton: float
    """Newton iterations of a frame in contact, mean [-]."""
    cg: float
    """Conjugate gradients of a frame in contact, mean [-]."""
    converged: float
    """Share of the frames that converged [-]."""
    reasons: dict[str, int]
    """Number of frames that did not, by reason."""
    difference: float | None
    """Largest difference of a force from the CPU's, over the largest force [-]; None if not compared."""


@dataclass(frozen=True)
class _Subject:
    """The object and the bubble that presses it."""

    scene: Scene
    """Without distributions."""
    body: Model
    """The object."""
    sensor: BubbleModel
    """The bubble."""
    aims: list[Aim]
    """One for each touch."""
    spec: TouchSpec
    """Frames of a touch."""
    seconds: float
    """Time to build body and sensor [s]."""


def schedule(frames: int) -> tuple[int, int, int, int]:
    """Frames (free, in, hold, out) of a touch of ``frames`` frames, at least 4."""
    out = max(1, (frames - 2) // 4)
    return 1, frames - 2 - out, 1, out


def prepare(touches: int, *, frames: int = FRAMES, tier: str = TIER, resolution: float | None = RESOLUTION,
            nodes: int | None = None) -> _Subject:
    """The shoe, the bubble and ``touches`` + 1 aims, as `vsfsim generate` draws them."""
    from vsfsim.sensing.camera import look_at, render

    began = time.perf_counter()
    scene = load_scene(find_scene(SCENE)).sample(stream(0, Stream.SCENE, 0))
    spec = scene.required_sensor
    scene = dataclasses.replace(scene, object=dataclasses.replace(scene.object, resolution=resolution),
                                sensor=dataclasses.replace(spec, nodes=nodes or spec.nodes))
    body = tiers.build(scene, tier, seed=stream(0, Stream.BODY, 0))
    sensor = build_bubble(scene.sensor)
    seconds = time.perf_counter() - began
    intrinsics, pose = look_at(dataclasses.replace(scene.camera, width=_PICTURE[0], height=_PICTURE[1]),
                               body.mesh.points.mean(axis=0))
    view = render(surface_of(body.solid, scene), intrinsics, pose, *_PICTURE)
    spec = dataclasses.replace(scene.touches, count=touches + 1, frames=schedule(frames))
    aims = touch_bubble.aim(dataclasses.replace(scene, touches=spec), body, sensor, view,
                            lambda k: np.random.default_rng(stream(0, Stream.AIM, 0, 0, k)))
    return _Subject(scene, body, sensor, aims, spec, seconds)


def _run(s: _Subject, aims: list[Aim], tier: str, device: str,
         progress: Callable[[int, float], None]) -> tuple[Frames, CoupledSolver]:
    poses = np.stack([touch_bubble.mount_path(s.spec, a) for a in aims], axis=1)
    solver = CoupledSolver(s.body, s.sensor, friction=s.scene.required_sensor.friction, device=device,
                           options=touch_bubble.solver_options(tiers.options(tier), device))
    began = time.perf_counter()
    return solver.run(poses, progress=lambda t: progress(t, time.perf_counter() - began)), solver


def poke(s: _Subject, tier: str, device: str, progress: Progress) -> Poke:
    """The first two touches, the second one measured."""
    def frame_of(what: str) -> Callable[[int, float], None]:
        return lambda t, seconds: progress(f"{what}: frame {t} after {seconds:.1f} s")

    began = time.perf_counter()
    _run(s, s.aims[:1], tier, device, frame_of("first touch"))
    first = time.perf_counter() - began
    clock.start()
    busy = time.process_time()
    frames, solver = _run(s, s.aims[1:2], tier, device, frame_of("second touch"))
    busy = time.process_time() - busy
    parts = {part: spent for part, (_, spent) in clock.stop().items()}
    size = np.linalg.norm(frames.force[:, 0], axis=1)
    contact = size > 0.0
    deep, count = int(np.argmax(size)), max(int(contact.sum()), 1)
    good = frames.converged[:, 0]
    total = float(frames.seconds.sum())
    spent = float(frames.seconds[contact].sum())
    return Poke(device, tier, len(s.body.mesh.tets), len(s.body.free) + len(s.sensor.free), len(s.sensor.mesh.points),
                len(size), int(contact.sum()), float(size[deep]),
                float(solver.pressure[deep][0] - s.sensor.pressure), spent / count,
                busy * spent / max(total, 1e-9) / count, float(frames.seconds.max()),
                float(frames.iterations[contact].sum() / count), float(frames.cg_iterations[contact].sum() / count),
                float(good.mean()),
                float(frames.residual[:, 0][good & contact].max(initial=0.0)), parts, s.seconds, first)


def batch(s: _Subject, touches: int, tier: str, device: str, progress: Progress, *, compare: int = 0) -> Batch:
    """``touches`` of the object together; ``compare`` of them again on the CPU."""
    aims = s.aims[1:1 + touches]

    def each_frame(t: int, seconds: float) -> None:
        total = sum(s.spec.frames)
        progress(f"batch of {touches}: frame {t} of {total} after {seconds:.1f} s, "
                 f"{60.0 * touches * t / total / max(seconds, 1e-9):.1f} touches a minute so far")

    began = time.perf_counter()
    frames, _ = _run(s, aims, tier, device, each_frame)
    seconds = time.perf_counter() - began
    contact = np.linalg.norm(frames.force, axis=2) > 0.0
    names, counts = np.unique(frames.reason[frames.reason != Reason.NONE], return_counts=True)
    difference = None
    if compare and device != "cpu":
        host, _ = _run(s, aims[:compare], tier, "cpu", lambda t,
                       spent: progress(f"{compare} touches on the CPU: frame {t} after {spent:.1f} s"))
        both = host.converged & frames.converged[:, :compare]
        difference = float(np.abs(host.force - frames.force[:, :compare])[both].max(initial=0.0)
                           / max(np.abs(host.force[both]).max(initial=0.0), 1e-12))
    return Batch(device, tier, touches, len(frames.seconds), seconds, 60.0 * touches / seconds,
                 float(frames.iterations[contact].mean()) if contact.any() else 0.0,
                 float(frames.cg_iterations[contact].mean()) if contact.any() else 0.0, float(frames.converged.mean()),
                 {Reason(int(n)).name: int(c) for n, c in zip(names, counts, strict=True)}, difference)


def measure(*, device: str = "cpu", touches: int | None = None, frames: int = FRAMES, tier: str = TIER,
            resolution: float | None = RESOLUTION, nodes: int | None = None, compare: int = 0,
            progress: Progress = lambda _: None) -> Measurement:
    """Both measurements.

    Args:
        device: Warp device.
        touches: of the batch; None for 4 on a CPU and 800 on a GPU.
        frames: of a touch, 4 or more.
        tier: of the object.
        resolution: size of its cells [m].
        nodes: of the bubble; None for the scene's.
        compare: number of touches of a GPU's batch that also run on the CPU.
        progress: called in every frame.
    """
    count = touches or (4 if device == "cpu" else 800)
    progress("building the shoe and the bubble")
    s = prepare(count, frames=frames, tier=tier, resolution=resolution, nodes=nodes)
    progress(f"{len(s.body.mesh.tets)} tetrahedra, {len(s.sensor.mesh.points)} nodes of the bubble, built in "
             f"{s.seconds:.1f} s; compiling kernels")
    compile_kernels(coupled_kernels(elements_of([*s.body.blocks, *s.sensor.blocks])), device)
    one = poke(s, tier, device, progress)
    progress(f"one touch: {one.seconds:.3f} s a frame, {one.newton:.1f} Newton, {one.cg:.1f} CG")
    many = batch(s, count, tier, device, progress, compare=compare)
    settings = {"device": device, "touches": count, "frames": frames, "tier": tier, "resolution": resolution,
                "nodes": nodes, "compare": compare}
    return Measurement.of("bubble", settings, [
        Table(f"second touch of a shoe by a sealed bubble, tier {tier}, {device}", (
            Column("tets", "tetrahedra", "1"), Column("nodes", "nodes of the bubble", "1"),
            Column("unknowns", "unknowns", "1"), Column("frames", "frames", "1"),
            Column("seconds", "a frame in contact", "s", form=".3f"),
            Column("cpu_seconds", "a frame in contact, CPU time", "s", form=".3f"),
            Column("worst_seconds", "slowest frame", "s", form=".2f"),
            Column("newton", "Newton iterations a frame", "1", form=".1f"),
            Column("cg", "conjugate gradients a frame", "1", form=".1f"),
            Column("converged", "frames converged", "1", "%", ".0f"),
            Column("residual", "worst residual", "1", form=".0e"),
            Column("force", "force at full depth", "N", form=".2f"),
            Column("pressure", "pressure change at full depth", "Pa", form=".0f"),
            *(Column(f"parts.{part}", f"{part}, whole touch", "s", form=".2f") for part in one.parts),
            Column("build_seconds", "mesh, factor and bubble, once", "s", form=".1f"),
            Column("first_seconds", "first touch", "s", form=".1f")), [asdict(one)], name="poke", single=True),
        Table(f"touches of {many.frames} frames together, {device}", (
            Column("touches", "touches", "1"), Column("seconds", "time", "s", form=".1f"),
            Column("per_minute", "touches a minute", "1/min", form=".1f"),
            Column("newton", "Newton iterations a frame in contact", "1", form=".1f"),
            Column("cg", "conjugate gradients a frame in contact", "1", form=".1f"),
            Column("converged", "frames converged", "1", "%", ".1f"),
            *(Column(f"reasons.{reason}", f"frames marked {reason}", "1") for reason in many.reasons),
            Column("difference", "difference of forces from the CPU's", "1", form=".0e")), [asdict(many)], name="batch",
            single=True)],
        notes=[f"Targets: {TARGET_FRAME} s a frame on one CPU core, {TARGET_MINUTE:.0f} touches a minute on one H200."])
