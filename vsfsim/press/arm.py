"""`vsfsim press` of a plant: one touch of the scene's arm, the first that `vsfsim generate` would make of this seed,
with its joint torques."""

from __future__ import annotations

import dataclasses
import io
import json
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from vsfsim.core.scene import SceneFile
from vsfsim.data.disk import write_atomic
from vsfsim.generate.job import jobs_of
from vsfsim.generate.plants.prepare import Subject, prepare_job
from vsfsim.generate.plants.touches import finish_touches, solve
from vsfsim.generate.recipe import make_recipe
from vsfsim.generate.run import kernels_of
from vsfsim.generate.table import plain
from vsfsim.physics.rods.solver import Ended
from vsfsim.physics.runtime import compile_kernels

UNITS = {
    "node_position": "of the plant (T, n, 3) [m]", "node_rotation": "quaternions x y z w since rest (T, n, 4)",
         "node_rest": "(n, 3) [m]", "parent": "of each node (n,)",
    "radius": "of the segment to each node (n,) [m]", "young_modulus": "of the segment (n,) [Pa]",
         "capsule_pose": "of the arm's capsules (T, K, 4, 4) [m]", "body_force": "on each capsule (T, K, 3) [N]",
         "body_moment": "about its origin (T, K, 3) [N m]",
    "q": "joint angles (T, 7) [rad]", "torque": "joint torques due to the contact (T, 7) [N m]",
         "depth": "of the tool past its target (T,) [m]", "force": "on the arm, world (T, 3) [N]",
    "reaction": "of the pot on the plant, world (T, 3) [N]", "converged": "(T,)", "residual": "(T,) [-]",
         "iterations": "(T,)", "force_balance": "(T,) [-]", "energy": "(T,) [J]", "penetration": "(T,) [m]",
}
"""Arrays of the file, with shape and unit; stored in it as ``units``, a JSON object."""


@dataclass(frozen=True)
class PlantPress:
    """One touch of a plant by the arm, T frames.

    depth: way of the tool past its target, negative before it (T,) [m]. force: on the arm (T, 3) [N]. torque: at the
    joints, due to the contact (T, 7) [N m]. q: joint angles (T, 7) [rad]. reaction: of the pot on the plant (T, 3) [N].
    target: on the visible cloud (3,) [m]. axis: of the tool's way (3,). draws: targets drawn until one could be
    reached. contacts: samples of the plant on the arm (T,).
    converged: (T,) bool. reason: why not (T,), words. residual: (T,) [-]. iterations: Newton (T,). audit: force_balance
    [-], energy [J], penetration [m], each (T,).
    segments: of the plant. deepest: number of the frame of full depth. build_seconds, seconds: of aiming and picture,
    and of the touch [s]. tier, device, precision: of the model. notes: what was decided.
    state: nodes (T, n, 3) [m], turns (T, n, 4) [-], poses (T, K, 4, 4), forces (T, K, 3) [N] and moments (T, K, 3) [N
    m] of the capsules in every frame, if asked for; not part of `table`.
    """

    depth: np.ndarray
    force: np.ndarray
    torque: np.ndarray
    q: np.ndarray
    reaction: np.ndarray
    target: np.ndarray
    axis: np.ndarray
    draws: int
    contacts: np.ndarray
    converged: np.ndarray
    reason: tuple[str, ...]
    residual: np.ndarray
    iterations: np.ndarray
    audit: dict[str, np.ndarray]
    segments: int
    deepest: int
    build_seconds: float
    seconds: float
    tier: str
    device: str
    precision: str
    notes: tuple[str, ...]
    state: tuple[Subject, dict[str, np.ndarray]] | None = field(default=None, repr=False)

    def table(self) -> dict[str, Any]:
        """The result as plain lists and numbers, for JSON."""
        return plain(dataclasses.replace(self, state=None))


def press(loaded: SceneFile, *, tier: str | None, device: str, precision: str, seed: int, keep: bool,
          progress: Callable[[int, int, str], None] | None = None) -> PlantPress:
    """Make the touch.

    Args:
        loaded: a scene with [arm]. tier, precision: as asked for; beams have one of each. device: Warp device. seed: of
        plant and touch. keep: also keep every frame's state.

    Raises:
        SceneError: the scene has no [touches], a tier or precision that beams do not have, or nothing that the arm can
        reach.
    """
    began = time.perf_counter()
    recipe = make_recipe(loaded, seed=seed, objects=1, views=1, touches=1, tier=tier, device=device,
                         precision=precision, renderer="warp")
    job = jobs_of(recipe, loaded.path, Path("."), None)[0]
    compile_kernels(kernels_of(loaded.sample(seed), precision), device, progress=progress)
    subject = prepare_job(job, device=device)
    built = time.perf_counter() - began
    began = time.perf_counter()
    (aim,) = subject.aims

    def done(frames: int, _going: int) -> None:
        so_far[0] += frames
        if progress is not None:
            progress(so_far[0], len(aim.plan), "frames")

    so_far = [0]
    (frames,) = solve([subject], device=device, progress=done, keep_nodes=keep)
    (touch,) = finish_touches(subject, frames)
    n = len(touch.time)
    depth = (touch.mount_pose[:, :3, 3] - aim.target) @ aim.axis
    limit = subject.scene.touches
    assert limit is not None and touch.q is not None and touch.torque is not None and subject.arm is not None
    notes = [*subject.plant.notes,
             f"target {aim.draws} of those drawn was within reach: ({', '.join(f'{v:.3f}' for v in aim.target)}) m, "
             f"the tool goes along ({', '.join(f'{v:.3f}' for v in aim.axis)})"]
    if touch.ended == Ended.FORCE:
        notes.append(f"the arm comes to its protective stop at frame {n} of {len(aim.plan)}: on the way back the "
                     f"contact force would be more than a quarter past force_limit = {limit.force_limit:g} N")
    elif n < len(aim.plan):
        notes.append(f"the touch ends at frame {n} of {len(aim.plan)}: in the next the contact force would pass "
                     f"force_limit = {limit.force_limit:g} N")
    elif not np.array_equal(frames.where[:n, 0], aim.plan):
        notes.append(f"the arm turns back "
                     f"{1e3 * (aim.plan.max() - frames.where[:n, 0].max()) / aim.plan.max() * np.linalg.norm(aim.stop - aim.start):.1f} mm before the end of its way: further in the contact force would pass "
                     f"force_limit = {limit.force_limit:g} N, or no equilibrium is found")
    elif not touch.touched:
        notes.append("the arm met nothing on its way; take another --seed")
    state = None
    if keep:
        assert frames.nodes is not None and frames.turns is not None
        state = (subject, {"node_position": frames.nodes[:n, 0], "node_rotation": frames.turns[:n, 0],
                           "capsule_pose": subject.arm.body_poses(touch.q), "body_force": frames.force[:n, 0],
                           "body_moment": frames.moment[:n, 0]})
    return PlantPress(
        depth=depth, force=touch.force, torque=touch.torque, q=touch.q, reaction=touch.reaction, target=aim.target,
                      axis=aim.axis, draws=aim.draws, contacts=frames.contacts[:n, 0],
        converged=touch.converged, reason=tuple(("", *touch.reason_names)[k] for k in touch.reason),
                      residual=touch.residual, iterations=touch.iterations,
        audit={name: touch.audit[name] for name in ("force_balance", "energy", "penetration")},
                      segments=len(subject.plant.nodes) - 1, deepest=int(np.argmax(depth)), build_seconds=built,
        seconds=time.perf_counter() - began, tier=recipe.tier, device=device, precision=precision, notes=tuple(notes),
                      state=state)


def text(result: PlantPress) -> str:
    """The result as a table for people."""
    rows = ["  tool mm past target    force N " + "".join(f"  joint {j + 1}" for j in range(7))
            + " N m   balance  penetr. mm  contacts  residual  iterations"]
    for t in range(len(result.depth)):
        mark = "" if result.converged[t] else "  NOT CONVERGED"
        rows.append(f"{1e3 * result.depth[t]:21.2f} {np.linalg.norm(result.force[t]):10.4f} "
                    + "".join(f"{v + 0.0:9.4f}" for v in result.torque[t])
                    + f"       {result.audit['force_balance'][t]:8.1e} {1e3 * result.audit['penetration'][t]:10.3f} "
                      f"{result.contacts[t]:9d}  {result.residual[t]:8.1e} {result.iterations[t]:11d}{mark}")
    bad = np.flatnonzero(~result.converged)
    if len(bad):
        why = sorted({result.reason[t] for t in bad})
        rows.append(f"{len(bad)} of {len(result.depth)} frames did NOT converge ({'; '.join(why)}). Their forces are "
                    f"not those of an equilibrium.")
    else:
        rows.append(f"All {len(result.depth)} frames converged.")
    rows.append(f"Force on the arm and reaction of the pot agree to {np.nanmax(result.audit['force_balance']):.1e}; "
                f"deepest penetration {1e3 * np.nanmax(result.audit['penetration']):.2g} mm. Torques are those of "
                f"the contact; "
                "weight is taken off.")
    rows.append(f"{result.segments} segments, tier {result.tier}, {result.precision} on {result.device}; plant, "
                f"picture and path in {result.build_seconds:.1f} s, solved in {result.seconds:.1f} s.")
    rows.extend(f"note: {sentence}" for sentence in result.notes)
    return "\n".join(rows)


def save(result: PlantPress, path: Path) -> None:
    """Write ``path`` (.npz); the result must have kept its state.

    Raises:
        DatasetError: it cannot be written.
    """
    assert result.state is not None
    subject, states = result.state
    plant = subject.plant
    arrays = {**states, "node_rest": plant.nodes, "parent": plant.parent, "radius": plant.radius,
              "young_modulus": plant.young_modulus, **result.audit,
              **{key: getattr(result, key) for key in ("q", "torque", "depth", "force", "reaction", "converged",
                                                       "residual", "iterations")}}
    assert set(arrays) == set(UNITS)
    buffer = io.BytesIO()
    np.savez_compressed(buffer, units=np.array(json.dumps(UNITS)), **arrays)
    write_atomic(path, buffer.getvalue())


def plot(result: PlantPress, title: str, path: Path) -> None:
    """Draw force and joint torques against the tool's way into ``path`` (PNG); frames that failed are crossed out."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, (upper, lower) = plt.subplots(2, 1, figsize=(6.4, 6.4), dpi=130, sharex=True)
    depth, force = 1e3 * result.depth, np.linalg.norm(result.force, axis=1)
    bad = ~result.converged
    upper.plot(depth, force, ".-", color="tab:blue", label="force on the arm")
    if bad.any():
        upper.plot(depth[bad], force[bad], "x", ms=9, color="tab:red", label="not converged")
    upper.set_ylabel("force [N]")
    upper.legend(frameon=False, fontsize=9)
    for j in range(7):
        lower.plot(depth, result.torque[:, j], "-", label=f"joint {j + 1}")
    lower.set_ylabel("joint torque of the contact [N m]")
    lower.set_xlabel("tool past its target [mm]")
    lower.legend(frameon=False, fontsize=8, ncols=4)
    upper.set_title(f"{title}: plant of {result.segments} segments", fontsize=10)
    for axes in (upper, lower):
        axes.grid(alpha=0.3)
    figure.tight_layout()
    figure.savefig(path)
    plt.close(figure)


def picture(result: PlantPress, title: str, path: Path, *, device: str) -> None:
    """Draw plant and arm at full depth, from where the scene's camera stands, into ``path`` (PNG)."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    from vsfsim.generate.plants.surface import plant_surface
    from vsfsim.press.picture import tessellate, with_bodies
    from vsfsim.sensing.camera import look_at, render

    assert result.state is not None
    subject, states = result.state
    assert subject.arm is not None
    t, camera = result.deepest, subject.scene.camera
    body = plant_surface(subject.plant, pot=True, nodes=states["node_position"][t],
                         turns=matrices(states["node_rotation"][t]))
    rigid = [tessellate(shape, 1.0) for shape in subject.arm.shapes]
    placed = [v @ pose[:3, :3].T + pose[:3, 3] for (v, _), pose in zip(rigid, states["capsule_pose"][t], strict=True)]
    middle = 0.5 * (subject.plant.nodes.min(axis=0) + subject.plant.nodes.max(axis=0))
    intrinsics, pose = look_at(camera, np.array([0.0, 0.0, middle[2]]))
    image = render(with_bodies(body, placed, [f for _, f in rigid]), intrinsics, pose, camera.width, camera.height,
                   device=device, background=(255, 255, 255)).rgb
    figure = Figure(figsize=(camera.width / 100, camera.height / 100 + 0.4), dpi=100, facecolor="white")
    FigureCanvasAgg(figure)
    axes = figure.add_axes((0.0, 0.0, 1.0, camera.height / 100 / (camera.height / 100 + 0.4)))
    axes.imshow(image)
    axes.set_axis_off()
    mark = "" if result.converged[t] else "   NOT CONVERGED"
    figure.suptitle(f"{title}: tool {1e3 * result.depth[t]:.0f} mm past its target, force "
                    f"{np.linalg.norm(result.force[t]):.3g} N{mark}", fontsize=11)
    figure.savefig(path, dpi=100)


def matrices(turn: np.ndarray) -> np.ndarray:
    """Rotations (n, 3, 3) of unit quaternions x y z w (n, 4)."""
    v, w = turn[:, :3], turn[:, 3]
    cross = np.zeros((len(turn), 3, 3))
    cross[:, 0, 1], cross[:, 0, 2], cross[:, 1, 2] = -v[:, 2], v[:, 1], -v[:, 0]
    cross = cross - np.swapaxes(cross, 1, 2)
    return np.eye(3) + 2.0 * w[:, None, None] * cross + 2.0 * cross @ cross
