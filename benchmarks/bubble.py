"""What a bubble on a soft object costs: `vsfsim measure bubble`.

Two measurements on a shoe of `shoes-punyo-mini`, at tier `fem` with cells small enough for 5,000 tetrahedra. *One
touch*: a sealed poke, after another touch of the same object (mesh, factor, inflation and kernels are there), CPU
seconds and iterations of a frame with their parts. *A batch*: touches of that object that advance together, touches a
minute. Progress is told frame by frame, so that a run that is cut off has shown something.
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from vsfsim.core.scene import Scene, TouchSpec, load_scene
from vsfsim.core.shelf import find_scene
from vsfsim.generate.aim import Aim
from vsfsim.generate.effectors import bubble as touch_bubble
from vsfsim.generate.job import Stream, stream
from vsfsim.generate.solid import surface_of
from vsfsim.physics import clock, tiers
from vsfsim.physics.bubble.sensor import BubbleModel, build_bubble
from vsfsim.physics.model import Model
from vsfsim.physics.runtime import compile_kernels
from vsfsim.physics.solve.coupled import CoupledSolver
from vsfsim.physics.solve.frames import Frames, Reason
from vsfsim.physics.solve.kernels import coupled_kernels

SCENE = "shoes-punyo-mini"
TIER, RESOLUTION = "fem", 0.0095  # m: 5,256 tetrahedra
FRAMES = 15
TARGET_FRAME, TARGET_MINUTE = 0.5, 200.0
"""What is aimed at: seconds a frame on one CPU core; touches a minute on one H200."""
_PICTURE = (160, 120)  # pixels of the view that targets are drawn on

Progress = Callable[[str], None]


@dataclass(frozen=True)
class Poke:
    """One touch, the second of its object.

    tets, unknowns, nodes: of the object, of both bodies together, of the bubble [-]. frames: how many, in_contact of
    them with a force. force, pressure: at full depth [N], change [Pa]. seconds: of a frame in contact, on the clock
    [s]; cpu_seconds: of the process [s]; worst_seconds: of the slowest frame [s].
    newton, cg: iterations of a frame in contact [-]. converged: share of all frames [-]. residual: worst of a converged
    one [-]. parts: seconds of the whole touch [s].
    build_seconds: of mesh, factor and bubble, once an object [s]; first_seconds: of the first touch [s].
    """

    device: str
    tier: str
    tets: int
    unknowns: int
    nodes: int
    frames: int
    in_contact: int
    force: float
    pressure: float
    seconds: float
    cpu_seconds: float
    worst_seconds: float
    newton: float
    cg: float
    converged: float
    residual: float
    parts: dict[str, float]
    build_seconds: float
    first_seconds: float


@dataclass(frozen=True)
class Batch:
    """Many touches of one object together.

    touches, frames: how many. seconds: of all [s]. per_minute: touches a minute [1/min]. newton, cg: iterations of a
    frame in contact, on average [-]. converged: share of the frames [-]. reasons: number of frames by why not.
    difference: largest difference of a force from the CPU's over the largest force [-], or None.
    """

    device: str
    tier: str
    touches: int
    frames: int
    seconds: float
    per_minute: float
    newton: float
    cg: float
    converged: float
    reasons: dict[str, int]
    difference: float | None


@dataclass(frozen=True)
class _Subject:
    """What is pressed. scene: concrete. body, sensor: the object and the bubble. aims: of the touches. spec: their
    frames. seconds: to build body and sensor [s]."""

    scene: Scene
    body: Model
    sensor: BubbleModel
    aims: list[Aim]
    spec: TouchSpec
    seconds: float


def schedule(frames: int) -> tuple[int, int, int, int]:
    """Free, in, hold and out readings of a touch of so many ``frames``, at least 4."""
    out = max(1, (frames - 2) // 4)
    return 1, frames - 2 - out, 1, out


def prepare(touches: int, *, frames: int = FRAMES, tier: str = TIER, resolution: float | None = RESOLUTION,
            nodes: int | None = None) -> _Subject:
    """The shoe, the bubble and ``touches`` + 1 aims, as `vsfsim generate` draws them."""
    from vsfsim.sensing.camera import look_at, render

    began = time.perf_counter()
    scene = load_scene(find_scene(SCENE)).sample(stream(0, Stream.SCENE, 0))
    assert scene.sensor is not None and scene.touches is not None and scene.object is not None
    scene = dataclasses.replace(scene, object=dataclasses.replace(scene.object, resolution=resolution),
                                sensor=dataclasses.replace(scene.sensor, nodes=nodes or scene.sensor.nodes))
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
         told: Callable[[int, float], None]) -> tuple[Frames, CoupledSolver]:
    assert s.scene.sensor is not None
    poses = np.stack([touch_bubble.mount_path(s.spec, a) for a in aims], axis=1)
    solver = CoupledSolver(s.body, s.sensor, friction=s.scene.sensor.friction, device=device,
                           options=touch_bubble.solver_options(tier, device))
    began = time.perf_counter()
    return solver.run(poses, progress=lambda t: told(t, time.perf_counter() - began)), solver


def poke(s: _Subject, tier: str, device: str, progress: Progress) -> Poke:
    """The first two touches, the second one measured."""
    def tell(what: str) -> Callable[[int, float], None]:
        return lambda t, seconds: progress(f"{what}: frame {t} after {seconds:.1f} s")

    began = time.perf_counter()
    _run(s, s.aims[:1], tier, device, tell("first touch"))
    first = time.perf_counter() - began
    clock.start()
    busy = time.process_time()
    frames, solver = _run(s, s.aims[1:2], tier, device, tell("second touch"))
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

    def told(t: int, seconds: float) -> None:
        total = sum(s.spec.frames)
        progress(f"batch of {touches}: frame {t} of {total} after {seconds:.1f} s, "
                 f"{60.0 * touches * t / total / max(seconds, 1e-9):.1f} touches a minute so far")

    began = time.perf_counter()
    frames, _ = _run(s, aims, tier, device, told)
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


def bench(*, device: str = "cpu", touches: int | None = None, frames: int = FRAMES, tier: str = TIER,
          resolution: float | None = RESOLUTION, nodes: int | None = None,
          compare: int = 0, progress: Progress = lambda _: None) -> dict[str, Any]:
    """Both measurements.

    Args:
        device: Warp device. touches: of the batch; None for 4 on a CPU and 800 on a GPU. frames: of a touch, 4 or more.
        tier, resolution: of the object, the latter [m]. nodes: of
            the bubble, None for the scene's. compare: so many touches of a GPU's batch also on the CPU. progress: told
            every frame.

    Returns:
        "poke" and "batch", fields as `Poke` and `Batch`.
    """
    count = touches or (4 if device == "cpu" else 800)
    progress("building the shoe and the bubble")
    s = prepare(count, frames=frames, tier=tier, resolution=resolution, nodes=nodes)
    progress(f"{len(s.body.mesh.tets)} tetrahedra, {len(s.sensor.mesh.points)} nodes of the bubble, built in "
             f"{s.seconds:.1f} s; compiling kernels")
    compile_kernels(coupled_kernels("float64", touch_bubble.KINDS), device)
    one = poke(s, tier, device, progress)
    progress(f"one touch: {one.seconds:.3f} s a frame, {one.newton:.1f} Newton, {one.cg:.1f} CG")
    return {"poke": asdict(one), "batch": asdict(batch(s, count, tier, device, progress, compare=compare))}


def table(result: dict[str, Any]) -> str:
    """Both as text."""
    p, b = result["poke"], result["batch"]
    parts = ", ".join(f"{k} {v:.2f} s" for k, v in p["parts"].items())
    reasons = ", ".join(f"{n} {c}" for n, c in b["reasons"].items())
    off = "" if b["difference"] is None else f"; forces off the CPU's by {b['difference']:.0e} of the largest"
    return "\n".join([
        f"one sealed poke of a shoe, tier {p['tier']}, {p['tets']} tetrahedra and a bubble of {p['nodes']} nodes "
        f"({p['unknowns']} unknowns), {p['device']}; the second touch of the object:",
        f"  {p['seconds']:.3f} s a frame in contact ({p['cpu_seconds']:.3f} s of CPU; aim on one CPU core "
        f"{TARGET_FRAME} s), slowest frame {p['worst_seconds']:.2f} s",
        f"  {p['newton']:.1f} Newton and {p['cg']:.1f} conjugate gradients a frame; {100 * p['converged']:.0f} % of "
        f"{p['frames']} frames converged, worst residual {p['residual']:.0e}; "
        f"{p['force']:.2f} N, {p['pressure']:.0f} Pa at full depth",
        f"  of which, over the touch: {parts}",
        f"  once an object: {p['build_seconds']:.1f} s for mesh, factor and bubble, {p['first_seconds']:.1f} s for its "
        f"first touch",
        f"{b['touches']} touches of {b['frames']} frames together, {b['device']}: {b['seconds']:.1f} s, "
        f"{b['per_minute']:.1f} touches a minute (aim on one H200 {TARGET_MINUTE:.0f})",
        f"  {b['newton']:.1f} Newton and {b['cg']:.1f} conjugate gradients a frame in contact; "
        f"{100 * b['converged']:.1f} % of the frames converged" + (f" (not: {reasons})" if reasons else "") + off])
