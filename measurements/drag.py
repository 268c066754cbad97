"""A bubble that is dragged and twisted on a soft block with friction: `vsfsim measure drag`.

The bubble is pressed into the block, and then moved sideways by 10 mm or twisted by 45 degrees about the axis of its
mount. Coulomb's law bounds what friction can give: the force along the block by mu N, the torque by mu sum(N_i r_i)
over the nodes in contact, r_i their distances from the axis, if all friction goes around it.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from measurements.measurement import Column, Measurement, Progress, Table
from vsfsim.core.scene import parse_scene
from vsfsim.generate.press_result import PressRequest
from vsfsim.generate.presses.bubble_solve import Solved, solve

FRICTION = 0.5
HEIGHT = 0.05  # of the block [m]
SCENE = """
name = "drag"
gravity = [0.0, 0.0, 0.0]
[object]
shape = {{ box = [0.1, 0.1, {height}] }}
resolution = 0.012
poisson_ratio = 0.45
young_modulus = {young}
[sensor]
kind = "bubble"
nodes = {nodes}
friction = {friction}
[press]
path = [[0.0, 0.0, {start}], [0.0, 0.0, {low}], [{aside}, 0.0, {low}]]
rotation = [[3.141592653589793, 0.0, 0.0], [3.141592653589793, 0.0, 0.0], {turn}]
frames = [{inward}, {frames}]
"""
APEX = 0.0305  # of the free dome, about [m]; first contact is found by the press


def moved(move: str, *, young: float, depth: float, frames: int, nodes: int = 390, limit: float | None = None,
          friction: float = FRICTION) -> Solved:
    """The frames of one press.

    Args:
        move: "drag" by 10 mm, or "twist" by 45 degrees.
        young: modulus of the block [Pa].
        depth: way past the first contact before the move, to about 1 mm [m].
        frames: of the move.
        nodes: of the membrane.
        limit: processor time of a frame, see `PressRequest.seconds` [s].
        friction: Coulomb's coefficient.
    """
    half = np.radians(22.5) if move == "twist" else 0.0
    turn = [float(np.pi * np.cos(half)), float(np.pi * np.sin(half)), 0.0]
    text = SCENE.format(height=HEIGHT, young=young, nodes=nodes, friction=friction, start=HEIGHT + APEX + 0.001,
                        low=HEIGHT + APEX - depth, aside=0.01 if move == "drag" else 0.0, turn=turn, inward=4,
                        frames=frames)
    scene = parse_scene(text, Path("drag.toml")).sample(0)
    return solve(scene, PressRequest(seconds=limit))


def rows_of(move: str, s: Solved, frames: int, friction: float = FRICTION) -> list[dict[str, object]]:
    """One row for each frame of the move, and one for the frame before it."""
    out: list[dict[str, object]] = []
    first = len(s.mount) - frames - 1
    for t in range(first, len(s.mount)):
        good = bool(s.frames.converged[t, 0])
        force, torque = np.full(3, np.nan), np.nan
        bound = np.nan
        if good:
            turn = s.mount[t, :3, :3]
            force, torque = turn @ s.wrench[t, :3], float(s.wrench[t, 5])
            # friction of the nodes can go around the mount's axis only as far as each is pressed
            pressed = np.maximum(s.push[t] @ turn.T @ [0.0, 0.0, 1.0], 0.0)
            bound = friction * float(pressed @ np.linalg.norm(s.position[t][:, :2], axis=1))
        part = (t - first) / frames
        along = float(np.hypot(force[0], force[1]))
        out.append({"move": move, "frame": t - first, "way": 0.01 * part if move == "drag" else None,
                    "angle": float(np.radians(45.0)) * part if move == "twist" else None,
                    "normal": float(force[2]), "along": along, "share": along / (friction * float(force[2])),
                    "torque": abs(torque), "torque_share": abs(torque) / bound if bound else np.nan,
                    "slipping": float(s.frames.slipping[t, 0]), "converged": float(good),
                    "seconds": float(s.frames.seconds[t])})
    return out


def measure(*, young: float = 3e4, depth: float = 0.006, frames: int = 10, limit: float | None = None,
            progress: Progress = lambda said: None) -> Measurement:
    """Drag and twist on a block of modulus ``young`` [Pa], ``depth`` [m] deep."""
    rows: list[dict[str, object]] = []
    for move in ("drag", "twist"):
        progress(f"{move} ...")
        rows += rows_of(move, moved(move, young=young, depth=depth, frames=frames, limit=limit), frames)
    columns = [Column("move", "move"), Column("way", "sideways", "m", "mm", ".1f"),
               Column("angle", "twist", "rad", "deg", ".1f"), Column("normal", "normal force", "N", "", ".3f"),
               Column("along", "force along the block", "N", "", ".3f"),
               Column("share", "over mu times normal", "1", "", ".3f"),
               Column("torque", "torque", "N m", "", ".5f"),
               Column("torque_share", "over Coulomb's bound", "1", "", ".3f"),
               Column("slipping", "points that slip", "1", "%", ".0f"),
               Column("converged", "converged", "1", "%", ".0f"), Column("seconds", "time", "s", "", ".1f")]
    return Measurement.of("drag", {"young": young, "depth": depth, "friction": FRICTION, "frames": frames}, [
        Table(f"a bubble {1e3 * depth:g} mm deep in a block of {1e-3 * young:g} kPa, dragged and twisted with friction "
              f"{FRICTION:g}", columns, rows, name="drag")])
