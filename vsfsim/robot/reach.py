"""Joint angles that lead the tool along a straight line, or the reason why there are none."""

from __future__ import annotations

from collections.abc import Iterator
from enum import Enum

import numpy as np

from vsfsim.core.errors import VsfsimError
from vsfsim.core.system.exact import snapped
from vsfsim.robot import gen3
from vsfsim.robot.arm import Arm, Postures
from vsfsim.robot.inverse_kinematics import solve
from vsfsim.robot.path import poses_of

STRIDE = 0.005  # longest step of the tool from one solution to the next [m]
# A joint that moves further in one such step passes a singular posture [rad]; at 1 cm/s that is 0.5 rad/s, more than
# half of what the arm can do.
JUMP = 0.25
ALLOWED_NEIGHBOURS = 1  # neighbouring links share a housing, so their capsules overlap by construction
CLEARANCE = 0.005  # least gap between links that are not neighbours, and above the table [m]


class Reason(Enum):
    """Why the arm cannot make a touch; a generator then draws another one."""

    TOO_FAR = "out of the arm's reach"
    POSE = "no joint angles give this pose"
    LIMITS = "a joint is within 3 degrees of its limit"
    SELF_COLLISION = "the arm would touch itself"
    TABLE = "the arm would touch the table"
    SINGULAR = "the arm would pass a singular posture"


class Unreachable(VsfsimError):
    """A touch that the arm cannot make."""

    reason: Reason
    """Why, for the attempt that came furthest."""

    def __init__(self, message: str, reason: Reason = Reason.LIMITS):  # a process reads it back from the message alone
        super().__init__(message)
        self.reason = reason


def straight_touch(arm: Arm, start: np.ndarray, stop: np.ndarray, rotation: np.ndarray, *, frames: int,
                   table: float | None = 0.0, restarts: int = 12, seed: int = 0) -> np.ndarray:
    """Joint angles (frames, 7) [rad] that take the tool from ``start`` to ``stop`` (3,) [m], both included, with the
    orientation ``rotation`` (3, 3), in the world.

    Every pose is met to the tolerances of `inverse_kinematics.solve`. Between two frames the tool moves in steps of
    5 mm at most, so that the joints do not jump and collisions between the frames are found.

    Args:
        frames: of the line, 2 at least.
        table: height of the table in the world [m], None for no table. Base and shoulder may touch it.
        restarts: number of random postures at which the search begins again, besides a few that face the target.
        seed: of these postures.

    Raises:
        Unreachable: no posture leads along the whole line.
    """
    start, stop = np.asarray(start, float), np.asarray(stop, float)
    dense, number = _refined(start + np.linspace(0.0, 1.0, frames)[:, None] * (stop - start))
    poses = poses_of(dense, rotation)
    furthest, why = -1, (Reason.POSE, "")
    for q0 in _beginnings(arm, start, restarts, seed):
        found, reason, detail = _track(arm, poses, q0, table)
        if reason is None:
            return found[number]
        if len(found) > furthest:
            furthest, why = len(found), (reason, detail)
    shoulder = arm.postures(np.zeros((1, gen3.JOINTS))).anchors[0, 1]
    away = float(np.linalg.norm(dense[furthest] - shoulder))
    reason, detail = why if away <= arm.reach else (
        Reason.TOO_FAR, f"{away:.3f} m from joint 2, and the arm reaches {arm.reach:.3f} m")
    x, y, z = start
    raise Unreachable(f"the touch from [{x:.4f}, {y:.4f}, {z:.4f}] m cannot be made: {reason.value}, "
                      f"{100 * furthest / len(dense):.0f} % along its path ({detail}). "
                      "Choose another start, target or orientation, or move the object.", reason)


def _track(arm: Arm, poses: np.ndarray, q0: np.ndarray,
           table: float | None) -> tuple[np.ndarray, Reason | None, str]:
    """The joint angles (n, 7) up to the end of the path or the first obstacle, and what that is."""
    out: list[np.ndarray] = []
    reason, detail = None, ""
    for pose in poses:
        s = solve(arm, pose, _guess(arm, out, q0))
        if not s.found:
            reason = Reason.LIMITS if s.at_limit else Reason.POSE
            detail = f"the tool stays {s.position:.2g} m and {s.angle:.2g} rad away"
            break
        q = snapped(s.q)  # the last bits of a solution are the CPU's
        if out and (turn := np.abs(q - out[-1])).max() > JUMP:
            reason, detail = Reason.SINGULAR, f"joint {int(turn.argmax()) + 1} would jump by {turn.max():.2g} rad"
            break
        out.append(q)
    if not out:
        return np.empty((0, gen3.JOINTS)), reason, detail
    line = np.stack(out)
    blocked = _blocked(arm, line, table)
    return (line[:blocked[0]], *blocked[1:]) if blocked else (line, reason, detail)


def _guess(arm: Arm, out: list[np.ndarray], q0: np.ndarray) -> np.ndarray:
    """Where the search for the next posture begins: extrapolated from the last ones, which halves the iterations."""
    if len(out) < 3:
        return out[-1] if out else q0
    ahead = 3.0 * (out[-1] - out[-2]) + out[-3]
    # beyond a joint limit, or after a corner of the path, the last posture is the better guess
    if np.abs(ahead - out[-1]).max() > JUMP / 2 or (ahead < arm.least).any() or (ahead > arm.most).any():
        return out[-1]
    return ahead


def _blocked(arm: Arm, q: np.ndarray, table: float | None) -> tuple[int, Reason, str] | None:
    """The first of the postures ``q`` (T, 7) in which the arm is too close to itself or to the table."""
    at, hits = arm.postures(q), []
    gaps, pairs = self_gaps(arm, at)
    if (gaps < CLEARANCE).any():
        frame = int((gaps < CLEARANCE).any(axis=1).argmax())
        i, j = (arm.links[arm.capsule_links[k]] for k in pairs[gaps[frame].argmin()])
        hits.append((frame, Reason.SELF_COLLISION,
                     f"{i} and {j} are {gaps[frame].min():.3g} m apart, at least {CLEARANCE:g} is wanted"))
    if table is not None:
        gaps, moving = table_gaps(arm, at, table)
        if (gaps < CLEARANCE).any():
            frame = int((gaps < CLEARANCE).any(axis=1).argmax())
            link = arm.links[arm.capsule_links[moving[gaps[frame].argmin()]]]
            hits.append((frame, Reason.TABLE,
                         f"{link} is {gaps[frame].min():.3g} m above it, at least {CLEARANCE:g} is wanted"))
    return min(hits, key=lambda h: h[0]) if hits else None


def _beginnings(arm: Arm, target: np.ndarray, restarts: int, seed: int) -> Iterator[np.ndarray]:
    """Joint angles at which the search begins: the home posture turned towards the target (3,) [m], random ones."""
    home = np.array(gen3.HOME)
    # joint 1 turns about -z of the base, see the table
    x, y, _ = arm.base[:3, :3].T @ (target - arm.base[:3, 3])
    home[0] = -np.arctan2(y, x)
    yield home
    for flip in (1, 3, 5):  # the elbow or the wrist the other way
        other = home.copy()
        other[flip] *= -1
        yield other
    rng = np.random.default_rng(seed)
    low, high = np.where(np.isfinite(arm.lower), arm.lower, -np.pi), np.where(np.isfinite(arm.upper), arm.upper, np.pi)
    for _ in range(restarts):
        yield rng.uniform(low, high)


def _refined(line: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Positions (T, 3) [m] with others between them, `STRIDE` apart at most (N, 3), and the place of each of the given
    ones among all (T,)."""
    way = np.diff(line, axis=0)
    steps = np.maximum(1, np.ceil(np.linalg.norm(way, axis=1) / STRIDE - 1e-9)).astype(int)
    number = np.concatenate([[0], np.cumsum(steps)])
    pair = np.repeat(np.arange(len(steps)), steps)  # of each step the pair of positions that it lies between
    share = ((np.arange(len(pair)) - number[pair] + 1) / steps[pair])[:, None]
    out = np.concatenate([line[:1], line[pair] + share * way[pair]])
    out[number] = line
    return out, number


def segment_distance(a: np.ndarray, b: np.ndarray, c: np.ndarray, d: np.ndarray) -> np.ndarray:
    """Distance (...) [m] between the segments a-b and c-d, end points (..., 3) [m] (Ericson, Real-Time Collision
    Detection, 5.1.9)."""
    along, across, r = b - a, d - c, a - c
    aa, ee = _dot(along, along), _dot(across, across)
    f, g, h = _dot(across, r), _dot(along, r), _dot(along, across)
    det = aa * ee - h * h
    parallel = det <= 1e-12 * aa * ee
    s = np.where(parallel, 0.0, np.clip((h * f - g * ee) / np.where(parallel, 1.0, det), 0.0, 1.0))
    t = np.clip((h * s + f) / ee, 0.0, 1.0)
    s = np.clip((h * t - g) / aa, 0.0, 1.0)
    # the second clamp may move the first point once more; after one further pass the result is exact
    t = np.clip((h * s + f) / ee, 0.0, 1.0)
    return np.linalg.norm(r + s[..., None] * along - t[..., None] * across, axis=-1)


def _dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.einsum("...i,...i->...", a, b)


def ends(arm: Arm, at: Postures) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Ends of the capsules' axes, two arrays (T, K, 3) [m], and their radii (K,) [m]."""
    poses = arm.capsule_poses(at)
    half = np.array([s.length for s in arm.shapes])[None, :, None] / 2 * poses[..., :3, 2]
    return poses[..., :3, 3] - half, poses[..., :3, 3] + half, np.array([s.radius for s in arm.shapes])


def self_gaps(arm: Arm, at: Postures) -> tuple[np.ndarray, np.ndarray]:
    """Gaps (T, P) [m] of all pairs of capsules whose links are not neighbours, negative where they overlap, and the
    pairs (P, 2)."""
    first, last, radii = ends(arm, at)
    # the Punyo is fixed to the bracelet, so it has the bracelet's neighbours
    place = np.minimum(arm.capsule_links, arm.links.index("bracelet_link"))
    pairs = np.argwhere(np.triu(np.abs(place[:, None] - place[None, :]) > ALLOWED_NEIGHBOURS))
    i, j = pairs.T
    return segment_distance(first[:, i], last[:, i], first[:, j], last[:, j]) - radii[i] - radii[j], pairs


def table_gaps(arm: Arm, at: Postures, height: float) -> tuple[np.ndarray, np.ndarray]:
    """Gaps (T, M) [m] of the capsules of the moving links from the table at ``height`` [m], and their numbers (M,).

    The base stands on the table, and the shoulder turns above it.
    """
    first, last, radii = ends(arm, at)
    moving = np.flatnonzero(arm.capsule_links >= arm.links.index("half_arm_1_link"))
    return np.minimum(first[:, moving, 2], last[:, moving, 2]) - radii[moving] - height, moving
