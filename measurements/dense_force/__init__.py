"""Error of estimated contact forces of the bubble: `vsfsim measure dense-force`.

The bubble is pressed on rigid balls with the simulator's mesh. An estimator reads the nodes of the coarser read-out
mesh with white noise, and the pressure with the real sensor's 5.4 Pa. The truth is the simulator's contact forces,
moved to the read-out mesh so that net force and moment are kept. E h and the force scale of `paper` and `taut` are
calibrated by the net force of other presses with the smallest noise, as their owner would with a force-torque sensor.
`released` is taken as published. `membrane` knows the simulated skin, but on the coarser mesh, and also runs with an E
h that is 10 % too large.
"""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from measurements.dense_force.calibration import PressRecord, calibrate, noisy, score
from measurements.measurement import Column, Measurement, Progress, Table
from vsfsim.core.bubble import Bubble
from vsfsim.core.shape import Sphere
from vsfsim.physics.bubble.sensor import BubbleModel, build_bubble
from vsfsim.physics.solve.frames import SolverOptions
from vsfsim.physics.solve.touches import Solver
from vsfsim.sensing.bubble import gauge_pressure, readout_of
from vsfsim.sensing.dense_force import BubbleCalibration, DenseForceEstimator, EstimatorOptions
from vsfsim.sensing.membrane_fe import SensorError, nodal_normals

NOISE = (0.0, 5e-5, 1e-4, 2e-4)
"""White noise of each coordinate of a node [m]; a real camera's depth has 5e-5 a pixel."""
PRESSURE_STD = 5.4
DEPTHS = (0.0, 3e-3, 6e-3, 1.1e-2)
"""Edges of the bins of depth [m]."""

_FRAMES = (-0.001, 0.0015, 0.003, 0.005, 0.0075, 0.010)  # way past first contact [m]
_FRICTION = 2.0  # the bubble hardly slips, as the paper says of the real one
_PATIENCE = 3600.0  # for a frame [s]: which frames there are should not depend on how busy the machine is
BALL, TIP, OTHER = Sphere(0.020), Sphere(0.005), Sphere(0.012)


@dataclass(frozen=True)
class Spot:
    """One press of a ball."""

    name: str
    """For tables."""
    x: float
    """Place on the dome, mount frame [m]."""
    y: float
    """Place on the dome, mount frame [m]."""
    slant: float = 0.0
    """Angle of the path from the normal there, towards +x [rad]."""


Plan = Sequence[tuple[Sphere, Sequence[Spot]]]

PRESSES: Plan = (
    (BALL, (Spot("ball, middle", 0.0, 0.0), Spot("ball, aside", 0.025, 0.010),
            Spot("ball, slanted", -0.010, 0.0, math.radians(30.0)))),
    (TIP, (Spot("tip, middle", 0.0, 0.0), Spot("tip, aside", -0.020, 0.012))),
)
"""Balls of 20 and 5 mm radius."""
CALIBRATION: Plan = ((OTHER, (Spot("12 mm, a", 0.012, -0.008), Spot("12 mm, b", -0.022, 0.0))),)
"""The presses that calibrate."""


def simulate(model: BubbleModel, plan: Plan, *, device: str = "cpu",
             progress: Progress = lambda _: None) -> list[PressRecord]:
    """Press a bubble on rigid balls and read it out; frames that found no equilibrium are left out."""
    readout = readout_of(model)
    out = []
    normals = nodal_normals(model.mesh.points, model.mesh.faces)
    for shape, spots in plan:
        progress(f"pressing on {', '.join(spot.name for spot in spots)}")
        columns = []
        for spot in spots:
            node = int(np.linalg.norm(model.mesh.points[:, :2] - (spot.x, spot.y), axis=1).argmin())
            normal = normals[node]
            across = np.array([1.0, 0.0, 0.0]) - normal[0] * normal
            way = math.sin(spot.slant) * across / np.linalg.norm(across) - math.cos(spot.slant) * normal
            poses = np.tile(np.eye(4), (len(_FRAMES), 1, 1))
            poses[:, :3, 3] = model.mesh.points[node] + shape.radius * normal + np.array(_FRAMES)[:, None] * way
            columns.append(poses)
        solver = Solver(model, shape, friction=_FRICTION, device=device,
                        options=SolverOptions(seconds=_PATIENCE, cg_frame=4000))
        frames = solver.run(np.stack(columns, axis=1), keep=True)
        for k, spot in enumerate(spots):
            good = frames.converged[:, k]
            points = model.mesh.points + np.stack([u[:, k].reshape(-1, 3) for u in solver.history])[good]
            # what the solver keeps is the force on the body, which is the bubble
            force = np.stack([f[..., k] for f in solver.surface_force])[good]
            measured = readout.frames(points, force, gauge_pressure(model, points), rest_pressure=model.pressure)
            out.append(PressRecord(spot.name, np.maximum(np.array(_FRAMES)[good], 0.0), measured.node_position,
                                   measured.pressure_change + model.pressure, measured.node_force))
    return out


def calibration_of(model: BubbleModel) -> BubbleCalibration:
    """What a perfectly informed owner of this bubble knows, on the read-out mesh."""
    readout = readout_of(model)
    rest = readout.positions(model.mesh.points[None])[0]
    return BubbleCalibration(rest, readout.readout.triangles, readout.readout.rim, model.spec.modulus, model.pressure,
                             reference=readout.readout.points / model.spec.pre_stretch)


def presses_on_balls(*, nodes: int | None = None, device: str = "cpu",
                     progress: Progress = lambda _: None) -> tuple[list[Contender], list[PressRecord]]:
    """Calibrated estimators and noise-free presses of a Punyo; ``nodes`` of the simulator's mesh, None for the default.

    Raises:
        SensorError: no press found an equilibrium.
    """
    model = build_bubble(Bubble() if nodes is None else Bubble(nodes=nodes))
    training = simulate(model, CALIBRATION, device=device, progress=progress)
    presses = simulate(model, PRESSES, device=device, progress=progress)
    if not any(len(p.depth) for p in presses) or not any(len(p.depth) for p in training):
        raise SensorError(f"measure dense-force: no frame of the presses converged on the mesh of "
                          f"{len(model.mesh.points)} nodes; take another number of nodes.")
    return contenders(calibration_of(model), training, progress=progress), presses


@dataclass(frozen=True)
class Contender:
    """One estimator with its calibration."""

    label: str
    """For the table."""
    method: str
    """Of `DenseForceEstimator`."""
    calibration: BubbleCalibration
    """What it knows of the bubble."""
    options: EstimatorOptions
    """Its weights."""
    calibrated: float | None = None
    """Error of the net force on the presses that calibrated it [N]; None if it was not calibrated."""


@dataclass(frozen=True)
class Row:
    """Errors of one contender at one noise level and depth bin, over the frames of all presses."""

    label: str
    """The contender."""
    noise: float
    """Standard deviation of a node's coordinate [m]."""
    low: float
    """Depths from here [m]."""
    high: float
    """Depths up to here [m]."""
    frames: int
    """Number of frames [-]."""
    node_rms: float
    """Error of a node's force, RMS over nodes and frames [N]."""
    node_size: float
    """True force of a node, RMS [N]."""
    net: float
    """Error of the net force, RMS [N]."""
    net_size: float
    """True net force, RMS [N]."""
    iou: float
    """Intersection over union of the contact regions, mean [-]."""
    converged: float
    """Share of the frames whose program was solved [-]."""
    seconds: float
    """CPU time of a frame [s]."""
    images: str = "in time"
    """Whether the images are of the frame, late, or late and aligned."""


def contenders(calibration: BubbleCalibration, presses: Sequence[PressRecord], *,
               progress: Progress = lambda _: None) -> list[Contender]:
    """All estimators, calibrated on the noise-free ``presses``; ``calibration`` holds the true skin."""
    options = EstimatorOptions()
    rng = np.random.default_rng(1)
    measured = [noisy(p, rng, displacement_std=options.displacement_std, pressure_std=PRESSURE_STD) for p in presses]
    fitted = {}
    for method in ("paper", "taut"):
        progress(f"calibrating {method}")
        fitted[method] = calibrate(calibration, measured, method=method, options=replace(options, tolerance=1e-3))
    out = [Contender("residual", "residual", fitted["paper"][0], options),
           Contender("released", "released", calibration, options)]
    out += [Contender(m, m, given, replace(how, tolerance=options.tolerance), error) for m,
            (given, how, error) in fitted.items()]
    if calibration.reference is not None:
        out.append(Contender("membrane", "membrane", calibration, options))
        out.append(Contender("membrane, E h +10 %", "membrane",
                             replace(calibration, stiffness=1.1 * calibration.stiffness), options))
    return out


def compare(field: Sequence[Contender], presses: Sequence[PressRecord], *, noise: Sequence[float] = NOISE,
            progress: Progress = lambda _: None) -> list[Row]:
    """Every contender on every press at every noise level.

    Args:
        field: estimators. presses: noise-free. noise: standard deviations of a node's coordinate [m].
    """
    rows = []
    for level in noise:
        rng = np.random.default_rng(7)  # the same draws for every level and contender
        measured = [noisy(p, rng, displacement_std=level, pressure_std=PRESSURE_STD if level else 0.0) for p in presses]
        for one in field:
            progress(f"{one.label} at {1e3 * level:g} mm")
            rows += errors_of(one, measured, presses, level)
    return rows


def errors_of(one: Contender, measured: Sequence[PressRecord], presses: Sequence[PressRecord], level: float, *,
              images: str = "in time") -> list[Row]:
    """One contender's rows, from what it reads (``measured``) and the true forces (``presses``) of the same frames.

    Args:
        level: standard deviation of a node's coordinate [m]. images: for the rows.
    """
    options = replace(one.options, displacement_std=max(level, 1e-5))
    estimator = DenseForceEstimator(one.calibration, method=one.method, options=options)
    began = time.process_time()
    found = [estimator.estimate(p.position, p.pressure) for p in measured]
    spent = (time.process_time() - began) / sum(len(p.depth) for p in measured)
    scores = [score(f.force, p.force) for f, p in zip(found, presses, strict=True)]
    return [replace(row, images=images) for row in
            _bins(one.label, level, spent, presses, scores, [f.converged for f in found])]


def _bins(label: str, level: float, spent: float, presses: Sequence[PressRecord], scores: list[Any],
          converged: list[np.ndarray]) -> list[Row]:
    columns = {name: np.concatenate([getattr(s, name) for s in scores])
               for name in ("node_rms", "node_size", "net", "net_size", "iou")}
    depth, good = np.concatenate([p.depth for p in presses]), np.concatenate(converged)
    out = []
    for low, high in zip(DEPTHS[:-1], DEPTHS[1:], strict=True):  # noqa: RUF007  two bins are meant
        inside = (depth > low) & (depth <= high) & (columns["net_size"] > 0.0)
        if inside.any():
            rms = {name: float(np.sqrt(np.mean(columns[name][inside] ** 2)))
                   for name in ("node_rms", "node_size", "net", "net_size")}
            out.append(Row(label, level, low, high, int(inside.sum()), **rms, iou=float(columns["iou"][inside].mean()),
                           converged=float(good[inside].mean()), seconds=spent))
    return out


def report(settings: dict[str, Any], rows: Sequence[Row], field: Sequence[Contender], presses: Sequence[PressRecord],
           notes: Sequence[str] = (), *, recipe: Sequence[Row] = ()) -> Measurement:
    """Errors of all contenders, one table a noise level, and one of the ``recipe`` with a real sensor's noise."""
    calibrated = {c.label: {"stiffness": c.calibration.stiffness, "force_scale": c.options.force_scale,
                            "net_error": c.calibrated} for c in field if c.calibrated is not None}
    stored, stored_recipe = [asdict(row) for row in rows], [asdict(row) for row in recipe]

    def printed(some: list[dict[str, Any]]) -> list[dict[str, Any]]:
        return [{**row, "bin": f"{1e3 * row['low']:.0f} to {1e3 * row['high']:.0f} mm",
                 "node_share": row["node_rms"] / row["node_size"], "net_share": row["net"] / row["net_size"]}
                for row in some]

    columns = (Column("label", "estimator"), Column("bin", "depth"), Column("frames", "frames", "1"),
               Column("node_rms", "node RMS", "N", form=".4f"), Column("node_share", "of true", "1", "%", ".0f"),
               Column("net", "net force", "N", form=".3f"), Column("net_share", "of true", "1", "%", ".0f"),
               Column("iou", "IoU", "1", form=".2f"), Column("converged", "solved", "1", "%", ".0f"),
               Column("seconds", "a frame", "s", form=".3f"))
    tables = [Table("calibrated by the net force of other presses", (
        Column("label", "estimator"), Column("stiffness", "E h", "N/m", form=".0f"),
        Column("force_scale", "force scale", "N", form="g"), Column("net_error", "net force error", "N", form=".3f")),
        [{"label": label, **row} for label, row in calibrated.items()])] if calibrated else []
    for level in sorted({row.noise for row in rows}):
        tables.append(Table(
            f"noise {1e3 * level:g} mm on each coordinate of a node" + (f", {PRESSURE_STD} Pa on the pressure" if level
                                                                        else ""), columns,
            printed([row for row in stored if row["noise"] == level])))
    if recipe:
        tables.append(Table("the noise of a real Punyo; its images are late against the pressure",
                            (columns[0], Column("images", "images"), *columns[1:]), printed(stored_recipe)))
    names = ", ".join(p.name for p in presses[:8]) + (", ..." if len(presses) > 8 else "")
    return Measurement.of("dense-force", settings, tables, numbers={"rows": stored, "recipe": stored_recipe,
                                                                   "calibrated": calibrated}, notes=[
        *notes, f"{len(presses)} presses ({names}), {sum(len(p.depth) for p in presses)} frames."])


def measure(*, nodes: int | None = None, device: str = "cpu", noise: Sequence[float] = NOISE,
            progress: Progress = lambda _: None) -> Measurement:
    """Every estimator on presses of a Punyo on rigid balls.

    Args:
        nodes: of the simulator's mesh; None for the default.
        device: Warp device.
        noise: standard deviations of a node's coordinate [m].
        progress: called with what is going on.

    Raises:
        SensorError: no press found an equilibrium.
    """
    field, presses = presses_on_balls(nodes=nodes, device=device, progress=progress)
    rows = compare(field, presses, noise=noise, progress=progress)
    return report({"nodes": nodes, "device": device, "noise": list(noise)}, rows, field, presses)
