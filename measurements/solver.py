"""Time and error of the solver: `vsfsim measure solver`.

Two measurements. *One touch*: the reference presses S1 and S2 at every tier. The second touch of the
object is measured, when mesh, factor and columns of the inverse exist: its force against the reference and the CPU time
of a load step with its parts. *A batch*: touches of one object that advance together, 40 frames each, touches a second.
"""

from __future__ import annotations

import time
from dataclasses import asdict, dataclass

import numpy as np

import references
from measurements.measurement import Column, Measurement, Progress, Table
from vsfsim.core.scene import Scene, TouchSpec, load_scene
from vsfsim.core.shelf import find_scene
from vsfsim.generate.presses.probe import tip
from vsfsim.generate.presses.report import direction
from vsfsim.physics import clock, tiers
from vsfsim.physics.elements.block import elements_of
from vsfsim.physics.model import Model
from vsfsim.physics.runtime import compile_kernels
from vsfsim.physics.solve.frames import Frames
from vsfsim.physics.solve.kernels import solver_kernels
from vsfsim.physics.solve.touches import Solver
from vsfsim.robot.path import press_path, touch_path

CASES = {"indent-homogeneous": "S1", "indent": "S2"}
"""Scene: name of its reference (`references/s1.json`, `s2.json`)."""

TIERS = tuple(tiers.TIERS)
"""Names that `--tier` takes."""

_SPREAD = 0.015  # the batch's touches lie in a square of this half-width about the middle of the top [m]
_TOUCH = TouchSpec(count=1, depth=0.005, approach=0.002, force_limit=1e9, frames=(4, 20, 4, 12))  # 40 frames
_SAME = 8  # touches of a GPU batch that are run on the CPU as well


@dataclass(frozen=True)
class OneTouch:
    """The second press of one object."""

    case: str
    """Reference case, "S1" or "S2"."""
    tier: str
    """Fidelity."""
    device: str
    """Warp device."""
    tets: int
    """Number of tetrahedra [-]."""
    unknowns: int
    """Number of unknowns [-]."""
    force: float
    """At full depth, along the press [N]."""
    error: float
    """Relative error of the force against the reference [-]."""
    step_seconds: float
    """CPU time of a load step [s]."""
    newton: float
    """Newton iterations a step [-]."""
    cg: float
    """Conjugate gradients a step [-]."""
    back_solves: float
    """Solutions with the factor a step [-]."""
    back_solve_ms: float
    """Time of one [ms]."""
    tangents: float
    """Assemblies of the tangent a step [-]."""
    tangent_ms: float
    """Time of one [ms]."""
    products: float
    """Products with the tangent a step [-]."""
    product_ms: float
    """Time of one [ms]."""
    residual: float
    """Worst relative residual of the press [-]."""
    balance: float
    """Worst relative force balance of the press [-]."""
    factor_seconds: float
    """Time of the factorisation, once an object [s]."""


@dataclass(frozen=True)
class Batch:
    """Many touches of one object together."""

    tier: str
    """Fidelity."""
    device: str
    """Warp device."""
    touches: int
    """Number of touches [-]."""
    frames: int
    """Frames of a touch [-]."""
    unknowns: int
    """Unknowns of the object [-]."""
    seconds: float
    """Time of the whole batch [s]."""
    per_second: float
    """Touches a second [1/s]."""
    newton: float
    """Newton iterations of a frame, mean [-]."""
    cg: float
    """Conjugate gradients of a frame, mean [-]."""
    converged: float
    """Share of the frames that converged [-]."""
    parts: dict[str, float]
    """Time in each part of the solver [s], from another run, because the clock waits for the device."""
    difference: float | None
    """Largest difference of a force from the CPU's, over the largest force [-]; None if not compared."""


def _scene(name: str) -> Scene:
    return load_scene(find_scene(name)).sample(0)


def _model(scene: Scene, tier: str) -> Model:
    return tiers.build(scene, tier, focus=tip(scene, np.array(scene.press.stop), direction(scene.press))[None])


def _solver(scene: Scene, model: Model, tier: str, device: str) -> Solver:
    return Solver(model, scene.probe, device=device, options=tiers.options(tier),
                  linear=not tiers.TIERS[tier].nonlinear)


def one_touch(name: str, tier: str, *, device: str = "cpu") -> OneTouch:
    """Press scene ``name`` twice at ``tier`` and report on the second time."""
    scene = _scene(name)
    case = CASES[name]
    reference = references.load(case.lower())["force_N"][-1]
    model = _model(scene, tier)
    poses = press_path(scene.press, scene.probe)
    compile_kernels(solver_kernels(elements_of(model.blocks)), device)
    _solver(scene, model, tier, device).run(poses[:, None])
    clock.start()
    began = time.process_time()
    frames = _solver(scene, model, tier, device).run(poses[:, None])
    spent = time.process_time() - began
    parts = clock.stop()
    steps = len(poses)
    force = abs(float(frames.force[-1, 0] @ direction(scene.press)))

    def each(part: str) -> tuple[float, float]:
        calls, seconds = parts.get(part, (0, 0.0))
        return calls / steps, 1e3 * seconds / max(calls, 1)

    solves, tangents, products = each("back-solves"), each("tangents"), each("products")
    return OneTouch(case, tier, device, len(model.mesh.tets), 3 * len(model.mesh.points), force,
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
    compile_kernels(solver_kernels(elements_of(model.blocks)), device)

    def run() -> tuple[Frames, float]:
        solver = _solver(scene, model, tier, device)
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
        host = _solver(scene, model, tier, "cpu").run(poses[:, :few])
        difference = float(np.abs(frames.force[:, :few] - host.force).max() / np.abs(host.force).max())
    return Batch(tier, device, touches, len(poses), 3 * len(model.mesh.points), seconds, touches / seconds,
                 float(frames.iterations.mean()),
                 float(frames.cg_iterations.mean()), float(frames.converged.mean()), parts, difference)


def measure(*, device: str = "cpu", tier: tuple[str, ...] | None = None, touches: int | None = None,
            compare: bool = True, progress: Progress = lambda _: None) -> Measurement:
    """Both measurements.

    Args:
        device: Warp device.
        tier: which ones; None for linear to fem-fine.
        touches: of a batch; None for 4 on a CPU and, on a GPU, 256 (nonlinear) or 4,096 (linear).
        compare: also run some touches of a GPU's batch on the CPU.
        progress: called with what is going on.
    """
    chosen = tier or ("linear", "fem-coarse", "fem", "fem-fine")
    singles, batches = [], []
    for name in CASES:
        for one in chosen:
            progress(f"{name} at {one}")
            singles.append(asdict(one_touch(name, one, device=device)))
    for one in [t for t in chosen if t in ("linear", "fem-coarse", "fem")]:
        count = touches or (4 if device == "cpu" else 256 if tiers.TIERS[one].nonlinear else 4096)
        progress(f"a batch of {count} touches at {one}")
        batches.append(asdict(batch(one, count, device=device, compare=compare)))
    parts = [{"tier": b["tier"], "part": part, "seconds": spent} for b in batches for part, spent in b["parts"].items()]
    return Measurement.of("solver", {"device": device, "tier": chosen, "touches": touches, "compare": compare}, [
        Table("second touch of an object, a load step of a tenth of 5 mm, CPU time of one process", (
            Column("case", "case"), Column("tier", "tier"), Column("tets", "tets", "1"),
            Column("unknowns", "unknowns", "1"), Column("force", "force", "N", form=".3f"),
            Column("error", "error", "1", "%", "+.1f"), Column("step_seconds", "step", "s", form=".3f"),
            Column("newton", "Newton", "1", form=".1f"), Column("cg", "CG", "1", form=".1f"),
            Column("back_solves", "solves", "1", form=".1f"), Column("back_solve_ms", "each", "ms", form=".1f"),
            Column("tangents", "tangents", "1", form=".1f"), Column("tangent_ms", "each", "ms", form=".1f"),
            Column("products", "products", "1", form=".1f"), Column("product_ms", "each", "ms", form=".1f"),
            Column("residual", "residual", "1", form=".0e"), Column("balance", "balance", "1", form=".0e"),
            Column("factor_seconds", "factor", "s", form=".2f")), singles, name="one_touch"),
        Table("touches of one object together, 40 frames each (4 free, 20 in to 5 mm, 4 hold, 12 out)", (
            Column("tier", "tier"), Column("device", "device"), Column("touches", "touches", "1"),
            Column("unknowns", "unknowns", "1"), Column("seconds", "time", "s", form=".2f"),
            Column("per_second", "touches a second", "1/s", form=".2f"), Column("newton", "Newton", "1", form=".2f"),
            Column("cg", "CG", "1", form=".1f"), Column("converged", "converged", "1", "%", ".1f"),
            Column("difference", "difference from the CPU", "1", form=".0e")), batches, name="batch"),
        Table("parts of a batch, from a run of their own", (
            Column("tier", "tier"), Column("part", "part"), Column("seconds", "time", "s", form=".2f")), parts)])
