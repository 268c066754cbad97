"""The press of a plant: one touch by the scene's arm, the first that `vsfsim generate` would make of this seed."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from vsfsim.core.errors import SceneError
from vsfsim.core.scene import SceneFile
from vsfsim.data.records import Touch
from vsfsim.generate.job import jobs_of
from vsfsim.generate.plants.aim import ArmAim
from vsfsim.generate.plants.prepare import Subject, prepare_job
from vsfsim.generate.plants.surface import plant_surface
from vsfsim.generate.plants.touches import finish_touches, solve
from vsfsim.generate.press_result import (
    BodyPanel,
    Camera,
    Column,
    Curves,
    MeshSeries,
    PressRequest,
    PressResult,
)
from vsfsim.generate.presses.verdict import series
from vsfsim.generate.recipe import make_recipe
from vsfsim.generate.run import kernels_of
from vsfsim.physics.rods.solver import Ended, RodFrames
from vsfsim.physics.runtime import compile_kernels
from vsfsim.sensing.camera import look_at
from vsfsim.sensing.tessellate import tessellate


def refine(loaded: SceneFile, request: PressRequest, meshes: int) -> MeshSeries:
    """Raises:
        SceneError: always; a plant has the segments of its family.
    """
    raise SceneError(f"--refine {meshes}: a plant has the segments that its family gave it, and no finer mesh; leave "
                     f"--refine out, or make segment in [object.shape] smaller.")


def press(loaded: SceneFile, request: PressRequest) -> PressResult:
    """Make the touch.

    Raises:
        SceneError: the scene has no [touches], a tier that beams do not have, or nothing that the arm can reach.
    """
    began = time.perf_counter()
    recipe = make_recipe(loaded, seed=request.seed, objects=1, views=1, touches=1, tier=request.tier,
                         device=request.device)
    job = jobs_of(recipe, loaded.path, Path("."), None)[0]
    compile_kernels(kernels_of(loaded.sample(request.seed)), request.device, progress=request.progress)
    subject = prepare_job(job, device=request.device)
    built = time.perf_counter() - began
    began = time.perf_counter()
    (aim,) = subject.aims
    so_far = [0]

    def done(frames: int, _going: int) -> None:
        so_far[0] += frames
        if request.progress is not None:
            request.progress(so_far[0], len(aim.plan), "frames")

    (frames,) = solve([subject], device=request.device, progress=done, keep_nodes=request.keep)
    (touch,) = finish_touches(subject, frames)
    seconds = time.perf_counter() - began
    n = len(touch.time)
    depth = (touch.mount_pose[:, :3, 3] - aim.target) @ aim.axis
    assert touch.q is not None and touch.torque is not None and touch.audit is not None
    q, full, segments = touch.q, int(np.argmax(depth)), len(subject.plant.nodes) - 1
    reason = tuple(("", *touch.reason_names)[k] for k in touch.reason)
    audit = {name: touch.audit[name] for name in ("force_balance", "energy", "penetration")}
    fields: dict[str, Any] = {"converged": touch.converged, "residual": touch.residual, "iterations": touch.iterations,
                              "audit": audit}
    contacts, size = frames.contacts[:n, 0], np.linalg.norm(touch.force, axis=1)
    return PressResult(
        depth=depth, force=touch.force, axis=aim.axis, reaction=touch.reaction, **fields, deepest=full,
        more={"torque": touch.torque, "q": touch.q, "target": aim.target, "draws": aim.draws,
              "contacts": contacts, "reason": reason, "segments": segments, "deepest": full, "build_seconds": built,
              "seconds": seconds, "tier": recipe.tier, "device": request.device, "precision": "float64"},
        columns=(Column("tool mm past target", 1e3 * depth, ".2f"), Column("|force| N", size, ".4f"),
                 *(Column(f"joint {j + 1}{' N m' * (j == 6)}", touch.torque[:, j], ".4f") for j in range(7)),
                 Column("balance", audit["force_balance"], ".1e"),
                 Column("penetr. mm", 1e3 * audit["penetration"], ".3f"), Column("contacts", contacts, "d"),
                 Column("residual", touch.residual, ".1e"), Column("iterations", touch.iterations, "d")),
        words=(_verdict(touch.converged, reason),
               f"Force on the arm and reaction of the pot agree to {np.nanmax(audit['force_balance']):.1e}; deepest "
               f"penetration {1e3 * np.nanmax(audit['penetration']):.2g} mm. Torques are those of the contact; the "
               f"weight of the arm is taken off.",
               f"{segments} segments, tier {recipe.tier} on {request.device}; plant, picture and "
               f"path in {built:.1f} s, solved in {seconds:.1f} s."),
        notes=tuple(_notes(subject, aim, touch, frames)),
        plot=(Curves("size of the force [N]", {"force on the arm": size}),
              Curves("joint torque of the contact [N m]",
                     {f"joint {j + 1}": touch.torque[:, j] for j in range(7)})),
        abscissa="tool past its target [mm]", model=f"plant of {segments} segments",
        headline=f"tool {1e3 * depth[full]:.0f} mm past its target, |force| {size[full]:.3g} N",
        panels=(lambda t: (_panel(subject, q, frames, t),)) if request.keep else None,
        arrays={**_arrays(subject, touch, frames),
                **series(depth, touch.force, touch.reaction, fields, "of the pot on the plant, world")}
        if request.keep else {})


def _verdict(converged: np.ndarray, reason: tuple[str, ...]) -> str:
    bad = np.flatnonzero(~converged)
    if not len(bad):
        return f"All {len(converged)} frames converged."
    return (f"{len(bad)} of {len(converged)} frames did NOT converge ({'; '.join(sorted({reason[t] for t in bad}))}). "
            f"Their forces are not those of an equilibrium.")


def _notes(subject: Subject, aim: ArmAim, touch: Touch, frames: RodFrames) -> list[str]:
    """What was decided, and why the touch ended."""
    limit = subject.scene.touches
    assert limit is not None
    n, planned = len(touch.time), len(aim.plan)
    out = [*subject.plant.notes,
           f"target {aim.draws} of those drawn was within reach: ({', '.join(f'{v:.3f}' for v in aim.target)}) m, "
           f"the tool goes along ({', '.join(f'{v:.3f}' for v in aim.axis)})"]
    if touch.ended == Ended.FORCE:
        out.append(f"the arm comes to its protective stop at frame {n} of {planned}: on the way back the contact force "
                   f"would be more than a quarter past force_limit = {limit.force_limit:g} N")
    elif n < planned:
        out.append(f"the touch ends at frame {n} of {planned}: in the next the contact force would pass force_limit = "
                   f"{limit.force_limit:g} N")
    elif not np.array_equal(frames.where[:n, 0], aim.plan):
        share = (aim.plan.max() - frames.where[:n, 0].max()) / aim.plan.max()
        out.append(f"the arm turns back {1e3 * share * np.linalg.norm(aim.stop - aim.start):.1f} mm before the end of "
                   f"its way: further in the contact force would pass force_limit = {limit.force_limit:g} N, or no "
                   f"equilibrium is found")
    elif not touch.touched:
        out.append("the arm touched nothing on its way; take another --seed")
    return out


def _arrays(subject: Subject, touch: Touch, frames: RodFrames) -> dict[str, tuple[np.ndarray, str]]:
    assert subject.arm is not None and touch.q is not None and touch.torque is not None
    assert frames.nodes is not None and frames.turns is not None
    n, plant = len(touch.time), subject.plant
    return {
        "node_position": (frames.nodes[:n, 0], "of the plant (T, n, 3) [m]"),
        "node_rotation": (frames.turns[:n, 0], "quaternions x y z w since rest (T, n, 4)"),
        "node_rest": (plant.nodes, "(n, 3) [m]"), "parent": (plant.parent, "of each node (n,)"),
        "radius": (plant.radius, "of the segment to each node (n,) [m]"),
        "young_modulus": (plant.young_modulus, "of the segment (n,) [Pa]"),
        "capsule_pose": (subject.arm.body_poses(touch.q), "of the arm's capsules (T, K, 4, 4) [m]"),
        "body_force": (frames.force[:n, 0], "on each capsule (T, K, 3) [N]"),
        "body_moment": (frames.moment[:n, 0], "about its origin (T, K, 3) [N m]"),
        "q": (touch.q, "joint angles (T, 7) [rad]"),
        "torque": (touch.torque, "joint torques due to the contact (T, 7) [N m]")}


def _panel(subject: Subject, q: np.ndarray, frames: RodFrames, t: int) -> BodyPanel:
    """Plant and arm in frame ``t``, from the scene's camera; ``q``: joint angles (T, 7) [rad]."""
    arm, camera, plant = subject.arm, subject.scene.camera, subject.plant
    assert arm is not None and frames.nodes is not None and frames.turns is not None
    body = plant_surface(plant, pot=True, nodes=frames.nodes[t, 0],
                         turns=Rotation.from_quat(frames.turns[t, 0]).as_matrix())
    rigid = tuple((v @ pose[:3, :3].T + pose[:3, 3], f)
                  for (v, f), pose in zip((tessellate(shape, 1.0) for shape in arm.shapes), arm.body_poses(q)[t],
                                          strict=True))
    middle = 0.5 * (plant.nodes.min(axis=0) + plant.nodes.max(axis=0))
    return BodyPanel(body, Camera(*look_at(camera, np.array([0.0, 0.0, middle[2]])), camera.width, camera.height),
                     rigid)
