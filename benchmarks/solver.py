"""What the solver costs and how far off it is: `vsfsim measure solver`.

Two measurements. *One touch*: the reference presses S1 and S2 at every tier and precision, the second touch of the
object (mesh, factor and columns of the inverse are there), its force against the reference and the CPU time of a load
step with its parts. *A batch*: touches of one object that advance together, 40 frames each, touches per second.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

import references
from vsfsim.core.scene import Scene, TouchSpec, load_scene
from vsfsim.core.shelf import find_scene
from vsfsim.physics import clock, tiers
from vsfsim.physics.model import Model
from vsfsim.physics.runtime import compile_kernels
from vsfsim.physics.solve.frames import Frames
from vsfsim.physics.solve.kernels import solver_kernels
from vsfsim.physics.solve.touches import Solver
from vsfsim.press.probe import direction, tip
from vsfsim.robot.path import press_path, touch_path

CASES = {"indent-homogeneous": "S1", "indent": "S2"}
"""Scene: name of its reference (`references/s1.json`, `s2.json`)."""

TIERS = tuple(tiers.TIERS)
"""Names that `--tier` takes."""

_SPREAD = 0.015  # the batch's touches lie in a square of this half-width about the middle of the top [m]
_TOUCH = TouchSpec(count=1, depth=0.005, approach=0.002, force_limit=1e9, frames=(4, 20, 4, 12))  # 40 frames
_SAME = 8  # touches of a GPU batch that are run on the CPU as well

Progress = Callable[[str], None]


@dataclass(frozen=True)
class OneTouch:
    """One press of one object, the second one.

    case, tier, precision, device: what was run. tets, unknowns: number of them [-]. force: at full depth, along the
    press [N]. error: of it against the reference [-]. step_seconds: CPU time of a load step [s]. newton, cg,
    back_solves, tangents, products: numbers a step [-].
    back_solve_ms, tangent_ms, product_ms: of one [ms]. residual, balance: the worst of the press [-]. factor_seconds:
    once an object [s].
    """

    case: str
    tier: str
    precision: str
    device: str
    tets: int
    unknowns: int
    force: float
    error: float
    step_seconds: float
    newton: float
    cg: float
    back_solves: float
    back_solve_ms: float
    tangents: float
    tangent_ms: float
    products: float
    product_ms: float
    residual: float
    balance: float
    factor_seconds: float


@dataclass(frozen=True)
class Batch:
    """Many touches of one object together.

    tier, device: what was run. touches, frames, unknowns: number of them [-]. seconds: of the whole batch [s].
    per_second: touches [1/s].
    newton, cg: iterations of a frame, on average [-]. converged: share of the frames [-]. parts: spent in each part of
    the solver [s], from another run (the clock waits for the device). difference: largest difference of a force from
    the CPU's over the largest force [-], or None.
    """

    tier: str
    device: str
    touches: int
    frames: int
    unknowns: int
    seconds: float
    per_second: float
    newton: float
    cg: float
    converged: float
    parts: dict[str, float]
    difference: float | None


def _scene(name: str) -> Scene:
    return load_scene(find_scene(name)).sample(0)


def _model(scene: Scene, tier: str) -> Model:
    return tiers.build(scene, tier, focus=tip(scene, np.array(scene.press.stop), direction(scene))[None])


def _solver(scene: Scene, model: Model, tier: str, device: str, precision: str) -> Solver:
    return Solver(model, scene.probe, device=device, precision=precision, options=tiers.options(tier),
                  linear=not tiers.TIERS[tier].nonlinear)


def one_touch(name: str, tier: str, *, device: str = "cpu", precision: str = "float64") -> OneTouch:
    """Press scene ``name`` twice at ``tier`` and report on the second time."""
    scene = _scene(name)
    case = CASES[name]
    reference = references.load(case.lower())["force_N"][-1]
    model = _model(scene, tier)
    poses = press_path(scene.press, scene.probe)
    compile_kernels(solver_kernels(precision), device)
    _solver(scene, model, tier, device, precision).run(poses[:, None])
    clock.start()
    began = time.process_time()
    frames = _solver(scene, model, tier, device, precision).run(poses[:, None])
    spent = time.process_time() - began
    parts = clock.stop()
    steps = len(poses)
    force = abs(float(frames.force[-1, 0] @ direction(scene)))

    def each(part: str) -> tuple[float, float]:
        calls, seconds = parts.get(part, (0, 0.0))
        return calls / steps, 1e3 * seconds / max(calls, 1)

    solves, tangents, products = each("back-solves"), each("tangents"), each("products")
    return OneTouch(case, tier, precision, device, len(model.mesh.tets), 3 * len(model.mesh.points), force,
                    force / reference - 1.0, spent / steps,
                    float(frames.iterations.mean()), float(frames.cg_iterations.mean()), *solves, *tangents, *products,
                    float(frames.residual.max()), float(frames.force_balance.max()), model.factor.seconds)


def batch_poses(scene: Scene, touches: int) -> np.ndarray:
    """Poses (40, touches, 4, 4): straight down on the top of the block, spread about its middle."""
    rng = np.random.default_rng(0)
    centre = np.array(scene.press.start)
    out = []
    for k in range(touches):
        at = centre + [*(rng.uniform(-_SPREAD, _SPREAD, 2) if k else (0.0, 0.0)), 0.0]
        out.append(touch_path(_TOUCH, scene.probe, at, np.array([0.0, 0.0, -1.0])))
    return np.stack(out, axis=1)


def batch(tier: str, touches: int, *, device: str = "cpu", name: str = "indent-homogeneous",
          compare: bool = True) -> Batch:
    """Many touches of one object at ``tier``, run twice: once to warm up, once for the time; then once more for its
    parts.

    ``compare``: also run the first few on the CPU, if ``device`` is another.
    """
    scene = _scene(name)
    model = _model(scene, tier)
    poses = batch_poses(scene, touches)
    compile_kernels(solver_kernels("float64"), device)

    def run() -> tuple[Frames, float]:
        solver = _solver(scene, model, tier, device, "float64")
        began = time.perf_counter()
        frames = solver.run(poses)
        return frames, time.perf_counter() - began

    run()
    frames, seconds = run()
    clock.start()
    run()
    parts = {part: spent for part, (_, spent) in clock.stop().items()}
    difference = None
    if compare and device != "cpu":
        few = min(_SAME, touches)
        host = _solver(scene, model, tier, "cpu", "float64").run(poses[:, :few])
        difference = float(np.abs(frames.force[:, :few] - host.force).max() / np.abs(host.force).max())
    return Batch(tier, device, touches, len(poses), 3 * len(model.mesh.points), seconds, touches / seconds,
                 float(frames.iterations.mean()),
                 float(frames.cg_iterations.mean()), float(frames.converged.mean()), parts, difference)


def bench(*, device: str = "cpu", tiers_asked: tuple[str, ...] | None = None, touches: int | None = None,
          compare: bool = True,
          progress: Progress = lambda _: None) -> dict[str, Any]:
    """All of it.

    Args:
        device: Warp device. tiers_asked: which, or None for linear to fem-fine. touches: of a batch; None for 4 on a
        CPU and,
            on a GPU, 256 (nonlinear) or 4,096 (linear: it has less to do for each). compare: a GPU's batch with the
            CPU's forces.

    Returns:
        Lists "one_touch" and "batch" of plain dictionaries, fields as `OneTouch` and `Batch`.
    """
    chosen = tiers_asked or ("linear", "fem-coarse", "fem", "fem-fine")
    singles, batches = [], []
    for name in CASES:
        for tier in chosen:
            for precision in ("float64", "float32") if tiers.TIERS[tier].nonlinear else ("float64",):
                progress(f"{name} at {tier}, {precision}")
                singles.append(asdict(one_touch(name, tier, device=device, precision=precision)))
    for tier in [t for t in chosen if t in ("linear", "fem-coarse", "fem")]:
        count = touches or (4 if device == "cpu" else 256 if tiers.TIERS[tier].nonlinear else 4096)
        progress(f"a batch of {count} touches at {tier}")
        batches.append(asdict(batch(tier, count, device=device, compare=compare)))
    return {"one_touch": singles, "batch": batches}


def table(result: dict[str, Any]) -> str:
    """Both lists as text."""
    out = ["second touch of an object, a load step of a tenth of 5 mm, CPU seconds of one process:",
           f"{'case':5}{'tier':11}{'precision':10}{'tets':>6}{'unknowns':>9}{'force N':>9}{'error':>8}{'s/step':>8}{'Newton':>7}{'CG':>6}"
           f"{'solves x ms':>13}{'tangents x ms':>15}{'products x ms':>15}{'residual':>10}{'balance':>9}{'factor s':>9}"]
    for r in result["one_touch"]:
        parts = "".join(f"{r[f'{p}s']:>{w}.1f} x {r[f'{p}_ms']:4.1f}" for p,
                        w in (("back_solve", 6), ("tangent", 8), ("product", 8)))
        out.append(f"{r['case']:5}{r['tier']:11}{r['precision']:10}{r['tets']:6}{r['unknowns']:9}{r['force']:9.3f}{100 * r['error']:+7.1f}%"
                   f"{r['step_seconds']:8.3f}{r['newton']:7.1f}{r['cg']:6.1f}{parts}{r['residual']:10.0e}{r['balance']:9.0e}{r['factor_seconds']:9.2f}")
    out += ["", "touches of one object together, 40 frames each (4 free, 20 in to 5 mm, 4 hold, 12 out):",
            f"{'tier':11}{'device':9}{'touches':>8}{'unknowns':>9}{'seconds':>9}{'touches/s':>11}{'Newton':>8}{'CG':>6}{'converged':>10}{'off the CPU':>12}"]
    for r in result["batch"]:
        off = "-" if r["difference"] is None else f"{r['difference']:.0e}"
        out.append(f"{r['tier']:11}{r['device']:9}{r['touches']:8}{r['unknowns']:9}{r['seconds']:9.2f}{r['per_second']:11.2f}{r['newton']:8.2f}"
                   f"{r['cg']:6.1f}{100 * r['converged']:9.1f}%{off:>12}")
        out.append("    of which (a run with the clock on) " + ", ".join(f"{k} {v:.2f} s" for k,
                                                                         v in r["parts"].items()))
    return "\n".join(out)
