"""Where the arm touches a plant: straight lines of the tool past points that the camera sees, as far as the arm can
go."""

from __future__ import annotations

import contextlib
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial

import numpy as np

from vsfsim.core.errors import SceneError
from vsfsim.core.plant import Plant
from vsfsim.core.scene import TouchSpec
from vsfsim.core.scene_tables.dataset import ArmSpec
from vsfsim.core.system.exact import length, snapped
from vsfsim.robot import reach
from vsfsim.robot.arm import Arm
from vsfsim.robot.reach import Unreachable, straight_touch

# targets that are tried for one touch: an arm that reaches a sixtieth of the points misses all with probability 5e-8
DRAWS = 1000
ON_BRANCH = 100  # the same for each touch of one branch, before another branch is drawn
APART = 0.02  # least distance of touches along one branch [m]
SPAN = 0.06  # least visible length of a branch that is touched at several places [m]
TURN = 0.6  # largest angle about +z between the tool's axis and the line from shoulder to target [rad]
LIFT = 0.35  # largest angle by which the tool's axis is raised or lowered from that line [rad]
SHORTEST = 0.4  # the depth of a touch is drawn between this share of the scene's depth and all of it [-]
PLANT, POT = "the arm would start in the plant", "the arm would touch the pot"


class NothingReached(SceneError):
    """No target of a touch can be reached."""

    reasons: str
    """What was in the way, and how often."""

    def __init__(self, message: str, reasons: str = ""):  # a process reads it back from the message alone
        super().__init__(message)
        self.reasons = reasons


@dataclass(frozen=True)
class ArmAim:
    """One touch before it is made: P postures along the way in, T frames."""

    target: np.ndarray
    """Point of the visible cloud (3,) [m]."""
    axis: np.ndarray
    """Unit direction of motion (3,) [-]."""
    line: np.ndarray
    """Joint angles along the way in (P, 7) [rad]."""
    plan: np.ndarray
    """Row of ``line`` of each frame (T,) int."""
    draws: int
    """Number of targets drawn until one could be reached."""

    @classmethod
    def along(cls, q: np.ndarray, axis: np.ndarray) -> ArmAim:
        """A touch along joint angles (T, 7) [rad], whose target nobody knows."""
        return cls(np.full(3, np.nan), axis, np.asarray(q, float), np.arange(len(q)), 1)


def load(spec: ArmSpec) -> Arm:
    """The arm of a scene, standing where it says."""
    base = np.eye(4)
    c, s = np.cos(spec.yaw), np.sin(spec.yaw)
    base[:3, :3] = [[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]
    base[:3, 3] = spec.base
    return Arm(punyo=spec.punyo, base=base)


def aim_arm(arm: Arm, spec: ArmSpec, touches: TouchSpec, plant: Plant, cloud: np.ndarray,
            stream: Callable[[int], np.random.Generator], *, numbers: range, where: str) -> list[ArmAim]:
    """Draw touches of a view: targets uniform on the visible cloud, and lines that the arm can follow. A target whose
    line it cannot follow is drawn again. With ``stations`` in ``[touches]`` so many touches in turn share a branch.

    Args:
        arm: the arm.
        spec: the table ``[arm]``.
        touches: the table ``[touches]``.
        plant: the plant.
        cloud: visible cloud of the view (n, 3) [m].
        stream: random stream of touch k.
        numbers: which touches to draw; each (with ``stations``, those of each branch) has its own stream, so any of
            them may be drawn alone.
        where: the scene, for messages.

    Raises:
        SceneError: nothing is visible.
        NothingReached: none of `DRAWS` targets of a touch can be reached; with what was in the way.
    """
    if not len(cloud):
        raise SceneError(f"{where}: the camera sees no plant; check [camera] distance, azimuth, elevation and fov.")
    draw, count = partial(_draw, arm, spec, touches, plant, where=where), touches.stations
    if count == 1:
        return [draw(cloud, stream(k)) for k in numbers]
    branches = visible_branches(plant, cloud)
    found = {number: [*_on_branch(draw, branches, count, stream(count * number), where)]
             for number in sorted({k // count for k in numbers})}
    return [found[k // count][k % count] for k in numbers]


def visible_branches(plant: Plant, cloud: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
    """The visible points (n, 3) [m] of each stem or branch of which the cloud shows `SPAN` or more, and their places
    along it (n,) [m]."""
    first, along = plant.nodes[plant.parent[1:]], plant.nodes[1:] - plant.nodes[plant.parent[1:]]
    gap, segment, place = np.full(len(cloud), np.inf), np.zeros(len(cloud), int), np.zeros(len(cloud))
    for i, (a, d) in enumerate(zip(first, along, strict=True), start=1):
        share = np.clip((cloud - a) @ d / (d @ d), 0.0, 1.0)
        away = np.linalg.norm(cloud - a - share[:, None] * d, axis=1) - max(plant.radius[i], plant.half_width[i])
        closer = away < gap
        gap[closer], segment[closer], place[closer] = away[closer], i, share[closer]
    look = plant.region if plant.look is None else plant.look
    arc, size = np.zeros(len(plant.nodes)), plant.lengths()
    for i, parent in enumerate(plant.parent[1:], start=1):
        arc[i] = size[i] + (arc[parent] if look[parent] == look[i] else 0.0)
    at, out = arc[segment] - (1.0 - place) * size[segment], []
    for axis in np.unique(look[1:][plant.half_width[1:] == 0.0]):
        mine = look[segment] == axis
        if mine.any() and np.ptp(at[mine]) >= SPAN:
            out.append((cloud[mine], at[mine]))
    return out


def _on_branch(draw: Callable[..., ArmAim], branches: list[tuple[np.ndarray, np.ndarray]], count: int,
               rng: np.random.Generator, where: str) -> Iterator[ArmAim]:
    """So many touches of one branch, `APART` from each other along it; a branch is drawn by the number of its visible
    points."""
    size = np.array([len(points) for points, _ in branches], float)
    for _ in range(DRAWS // 10 if len(size) else 0):
        points, at = branches[rng.choice(len(size), p=size / size.sum())]
        found: list[ArmAim] = []
        with contextlib.suppress(NothingReached):
            while len(found) < count and len(points):
                found.append(draw(points, rng, draws=ON_BRANCH))
                away = np.abs(at - at[(points == found[-1].target).all(axis=1)][0]) >= APART
                points, at = points[away], at[away]
        if len(found) == count:
            yield from found
            return
    why = f"no stem or branch of the {len(size)} that the camera sees {100 * SPAN:g} cm of can be touched {count} times"
    raise NothingReached(f"{where} [touches] stations: {why}. Move [arm] base, [camera] or the object.", why)


def _draw(arm: Arm, spec: ArmSpec, touches: TouchSpec, plant: Plant, cloud: np.ndarray,
          rng: np.random.Generator, *, where: str, draws: int = 0) -> ArmAim:
    shoulder = arm.postures(np.zeros((1, 7))).anchors[0, 1]
    refused: Counter = Counter()
    free, inward, hold, out = touches.frames
    draws = draws or DRAWS
    for draw in range(1, draws + 1):
        target = cloud[rng.integers(len(cloud))]
        seed = int(rng.integers(2**31))
        axis = _turned(target - shoulder, rng.uniform(-TURN, TURN), rng.uniform(-LIFT, LIFT))
        sideways = rng.uniform() < 0.5
        axis = snapped(axis)
        way = _turned(axis, *(rng.uniform(-spec.sweep, spec.sweep, 2) * [1.0, 0.4] if sideways else (0.0, 0.0)))
        roll, depth = rng.uniform(-np.pi, np.pi), touches.depth * rng.uniform(SHORTEST, 1.0)
        way = snapped(way)
        start, stop = target - touches.approach * way, target + depth * way
        try:
            line = straight_touch(arm, start, stop, _frame(axis, roll), frames=inward + 1,
                                  restarts=1, seed=seed, table=0.0)
        except Unreachable as error:
            refused[error.reason.value] += 1
            continue
        first, last, radii = reach.ends(arm, arm.postures(line[:1]))
        if plant_gap(plant, first[0], last[0], radii) < spec.clearance:
            refused[PLANT] += 1
            continue
        some = line[:: max(1, len(line) // 40)]
        if plant.pot is not None and pot_gap(plant, arm, some) < min(spec.clearance, 0.005):
            refused[POT] += 1
            continue
        back = np.rint(np.linspace(inward, 0, out + 1)).astype(int)[1:] if out else np.zeros(0, int)
        plan = np.concatenate([np.zeros(free, int), np.arange(1, inward + 1), np.full(hold, inward), back])
        return ArmAim(target, way, line, plan, draw)
    reasons = ", ".join(f"{text} ({n})" for text, n in refused.most_common())
    why = f"none of {draws} targets can be reached: {reasons}"
    raise NothingReached(f"{where} [touches]: {why}. Move [arm] base or the object, or use a "
                         "smaller approach or depth.", why)


def plant_gap(plant: Plant, first: np.ndarray, last: np.ndarray, radii: np.ndarray) -> float:
    """Least gap [m] between capsules and a plant at rest; a blade counts as a round segment of half its width.

    Args:
        plant: the plant.
        first, last: ends of the capsules' middle lines (K, 3) [m].
        radii: of the capsules (K,) [m].
    """
    a, b = plant.nodes[plant.parent[1:]], plant.nodes[1:]
    thick = np.maximum(plant.radius, plant.half_width)[1:]
    gaps = reach.segment_distance(first[:, None], last[:, None], a[None], b[None]) - radii[:, None] - thick[None]
    return float(gaps.min())


def pot_gap(plant: Plant, arm: Arm, q: np.ndarray) -> float:
    """Least gap [m] between the moving capsules and the pot, at postures ``q`` (T, 7) [rad]. The pot counts as a
    capsule of its top radius."""
    assert plant.pot is not None
    first, last, radii = reach.ends(arm, arm.postures(q))
    moving = arm.capsule_links >= arm.links.index("half_arm_1_link")
    r = plant.pot.radius_top
    low, high = np.array([0.0, 0.0, 0.0]), np.array([0.0, 0.0, max(plant.pot.height - r, 1e-3)])
    return float((reach.segment_distance(first[:, moving], last[:, moving], low, high) - radii[moving] - r).min())


def _turned(way: np.ndarray, yaw: float, pitch: float) -> np.ndarray:
    """The unit vector along ``way`` (3,), turned by ``yaw`` about +z and raised by ``pitch`` [rad]."""
    way = way / length(way)
    azimuth, lift = np.arctan2(way[1], way[0]) + yaw, np.clip(np.arcsin(np.clip(way[2], -1.0, 1.0)) + pitch, -1.2, 1.2)
    return np.array([np.cos(lift) * np.cos(azimuth), np.cos(lift) * np.sin(azimuth), np.sin(lift)])


def _frame(axis: np.ndarray, roll: float) -> np.ndarray:
    """A rotation (3, 3) whose z is ``axis``."""
    x = np.cross([0.0, 0.0, 1.0], axis)
    x /= length(x)
    y = np.cross(axis, x)
    return np.stack([np.cos(roll) * x + np.sin(roll) * y, np.cos(roll) * y - np.sin(roll) * x, axis], axis=1)
