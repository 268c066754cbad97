"""Dyn of the VSF model: stick-slip motion of independent particles against a moving rigid probe.

SBML appendix A (eq. 5), Neural VSF section III-B. A particle resists its displacement u = p - p0 with
f = -K u, so its motion does not depend on K: it is purely geometric. Between frames the probe moves in short
substeps. In each of them a particle

- makes contact when its rest position enters the probe, and then sticks to the point of the surface that reached it;
- continues to stick while its spring force lies in the friction cone, |u_t| <= mu u.n, with n the outward normal of the
  probe;
- otherwise slides over the surface along the tangential spring force until the cone condition holds again (mu = 0: to
  the point of the surface that is locally nearest to p0);
- detaches and returns to p0 as soon as its spring force points out of the probe.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np
import warp as wp

import vsfsim.physics.runtime  # noqa: F401  starts Warp quietly
from vsfsim.core import shape as shapes
from vsfsim.core.dome import Dome
from vsfsim.core.errors import VsfError
from vsfsim.core.rotation import rotation_matrix, rotation_vector
from vsfsim.core.shape import Box, Capsule, Cylinder, Plane, ProbeShape, Sphere
from vsfsim.physics.contact import sdf
from vsfsim.vsf.stick_slip import mat33, stick_slip, vec3, vec4
from vsfsim.vsf.sticking import Displacements, stick

# Largest number of entries (frames x particles) of one launch: 3 numbers each, so at most 400 MB in float64.
_CHUNK = 16_000_000
# Largest number of entries (frames x particles) whose distances from a probe's path are measured at one time.
_SWEPT = 200_000
# Number of concurrent launches on a GPU, and of the streams that they are distributed over.
_TOGETHER, _STREAMS = 64, 16
# A friction coefficient this large is pure sticking, and mu * |u| stays finite.
_STICKING = 1e6


def simulate(particles: np.ndarray, probe: ProbeShape, poses: np.ndarray, *, friction: float,
             device: str = "cpu", max_step: float = 1e-3) -> Displacements:
    """Drag a rigid probe through a cloud of particles.

    Particles start at rest. A particle inside the probe at the first pose starts at the nearest point of the probe's
    surface (from the exact centre of a sphere: along the probe's +z). A dome moves undeformed, and particles stick to
    it regardless of the friction, because its friction is high; particles inside it at the first pose stay free.

    Args:
        particles: rest positions, world (n, 3) [m].
        probe: the rigid shape, in its own frame.
        poses: probe-to-world transforms, rigid (T, 4, 4) [m]; the probe moves straight between them.
        friction: Coulomb coefficient mu >= 0 [-]; `math.inf` is pure sticking (Neural VSF).
        device: Warp device, "cpu" or "cuda:0".
        max_step: longest path of a point of the probe in one substep [m]. It is limited further to a quarter of the
            probe's smallest half-width, so that the probe skips no particle. The time of contact is found exactly
            within a substep; sliding with 0 < mu < inf is resolved to about this length.

    Returns:
        The displaced particles of every frame (|u| > 0).

    Raises:
        VsfError: a shape does not fit, a value is not finite, the friction is negative, or a pose is not rigid.
    """
    return _launched(particles, probe, poses, friction, device, max_step)()


def simulate_each(particles: np.ndarray, moves: Sequence[tuple[ProbeShape, np.ndarray]], *, friction: float,
                  device: str = "cpu", max_step: float = 1e-3) -> list[Displacements]:
    """`simulate` of several probes and their poses, each through particles at rest.

    On a GPU many launches run concurrently, because one launch has few particles with many substeps each and leaves
    most of the GPU idle.

    Args, Raises: as `simulate`.
    """
    if not wp.get_device(device).is_cuda:
        return [simulate(particles, probe, poses, friction=friction, device=device, max_step=max_step)
                for probe, poses in moves]
    streams = [wp.Stream(device) for _ in range(min(_STREAMS, len(moves)))]
    out: list[Displacements] = []
    for first in range(0, len(moves), _TOGETHER):
        begun = []
        for k, (probe, poses) in enumerate(moves[first:first + _TOGETHER]):
            with wp.ScopedStream(streams[k % len(streams)]):
                begun.append(_launched(particles, probe, poses, friction, device, max_step))
        wp.synchronize_device(device)
        out += [collect() for collect in begun]
    return out


def _launched(particles: np.ndarray, probe: ProbeShape, poses: np.ndarray, friction: float, device: str,
              max_step: float) -> Callable[[], Displacements]:
    """Launch the kernels of `simulate`; the returned function waits for the result."""
    particles, poses = _checked(particles, probe, poses, friction, max_step)
    frames = len(poses)
    near = np.flatnonzero(_swept(particles, probe, poses))
    if frames == 0 or len(near) == 0:
        return lambda: Displacements(np.zeros(frames + 1, np.int64), np.zeros(0, np.int64), np.zeros((0, 3)))
    rotation, origin, frame_of = _substeps(probe, poses, particles[near], max_step)
    if isinstance(probe, Dome):
        return lambda: _stuck(particles, near, probe, rotation, origin, frame_of)
    # Digits are lost where the world's origin is far from the touch.
    shift = poses[0, :3, 3] if not isinstance(probe, Plane) else particles[near[0]]
    kind, size = sdf.encode(probe, fillet=0.0)
    with wp.ScopedDevice(device):
        turn_array = wp.array(rotation, dtype=mat33)
        origin_array = wp.array(origin - shift, dtype=vec3)
        frame_array = wp.array(frame_of, dtype=wp.int32)
        launched = []
        chunk = max(1, _CHUNK // frames)
        for start in range(0, len(near), chunk):
            index = near[start:start + chunk]
            rest = wp.array(particles[index] - shift, dtype=vec3)
            moved = wp.zeros((frames, len(index)), dtype=vec3)
            wp.launch(stick_slip, dim=len(index), inputs=[
                kind, vec4(*size), min(float(friction), _STICKING), turn_array, origin_array, frame_array, rest,
            ], outputs=[moved])
            # the arrays that a launch reads are kept alive until it has finished
            launched.append((moved, index, (turn_array, origin_array, frame_array, rest)))
    return lambda: _joined([_sparse(moved.numpy(), index) for moved, index, _ in launched], frames)


def _stuck(particles: np.ndarray, near: np.ndarray, dome: Dome, rotation: np.ndarray, origin: np.ndarray,
           frame_of: np.ndarray) -> Displacements:
    vertices = np.einsum("sij,nj->sni", rotation, dome.points) + origin[:, None]
    all_steps = stick(particles[near], vertices, dome.faces)
    kept = [all_steps.frame(int(s)) for s in np.flatnonzero(frame_of >= 0)]
    pointer = np.concatenate([[0], np.cumsum([len(index) for index, _ in kept])]).astype(np.int64)
    return Displacements(pointer, near[np.concatenate([index for index, _ in kept])].astype(np.int64),
                         np.concatenate([moved for _, moved in kept]))


def _sparse(moved: np.ndarray, index: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    frame, column = np.nonzero(np.any(moved != 0.0, axis=2))
    return frame, index[column], moved[frame, column]


def _joined(parts: list[tuple[np.ndarray, np.ndarray, np.ndarray]], frames: int) -> Displacements:
    frame, particle, moved = (np.concatenate(column) for column in zip(*parts))
    order = np.lexsort((particle, frame))
    pointer = np.concatenate([[0], np.cumsum(np.bincount(frame, minlength=frames))]).astype(np.int64)
    return Displacements(pointer, particle[order].astype(np.int64), moved[order])


def _reach(probe: ProbeShape) -> tuple[float, float]:
    """Radius of the sphere around the origin that holds the probe, and its thinnest half-width [m]."""
    match probe:
        case Dome():
            thin = probe.height
        case Sphere(radius) | Capsule(radius, _):
            thin = radius
        case Cylinder(radius, height):
            thin = min(radius, 0.5 * height)
        case Box(size):
            thin = 0.5 * min(size)
        case Plane():
            thin = math.inf
        case _:
            raise VsfError("the particle model moves particles with a simple probe, a bubble's dome or an arm.")
    return shapes.reach(probe), thin


def _swept(particles: np.ndarray, probe: ProbeShape, poses: np.ndarray) -> np.ndarray:
    """Which particles the probe may reach on its path (n,) bool: a conservative bound."""
    near = np.zeros(len(particles), bool)
    if isinstance(probe, Plane):
        for pose in poses:
            near |= (particles - pose[:3, 3]) @ pose[:3, 2] <= 0.0
        if not np.allclose(poses[:, :3, 2], poses[:1, :3, 2], atol=1e-12):
            # A plane that rotates may reach deeper between two poses than at either of them.
            near[:] = True
        return near
    radius = _reach(probe)[0] * (1.0 + 1e-6)
    centre = poses[:, :3, 3]
    if len(centre) == 0:
        return near
    low, high = centre.min(axis=0) - radius, centre.max(axis=0) + radius
    box = np.flatnonzero((particles[:, 0] >= low[0]) & (particles[:, 0] <= high[0]))
    points = particles[box]
    inside = np.all((points[:, 1:] >= low[1:]) & (points[:, 1:] <= high[1:]), axis=1)  # of the few that are left
    box, points = box[inside], points[inside]
    hit = np.zeros(len(box), bool)
    along = np.diff(centre, axis=0, append=centre[-1:])
    length = np.maximum((along**2).sum(axis=1), 1e-30)
    for first in range(0, len(box), part := max(1, _SWEPT // len(centre))):
        away = points[None, first:first + part] - centre[:, None]  # frames x particles
        s = np.clip(np.einsum("tpi,ti->tp", away, along) / length[:, None], 0.0, 1.0)
        away -= s[:, :, None] * along[:, None]
        hit[first:first + part] = (np.einsum("tpi,tpi->tp", away, away) <= radius**2).any(axis=0)
    near[box] = hit
    return near


def _substeps(probe: ProbeShape, poses: np.ndarray, points: np.ndarray,
              max_step: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Poses of the substeps: rotations (S, 3, 3), origins (S, 3), and the frame that each one completes or -1 (S,)."""
    reach, thin = _reach(probe)
    step = min(max_step, 0.25 * thin)
    if math.isinf(reach):
        # A plane has no size, so the lever arm is the largest distance of a particle from its origin.
        reach = max(float(np.linalg.norm(points - pose[:3, 3], axis=1).max()) for pose in poses)
    vectors = rotation_vector(poses[:-1, :3, :3].swapaxes(1, 2) @ poses[1:, :3, :3])
    shift, angle = np.diff(poses[:, :3, 3], axis=0), np.linalg.norm(vectors, axis=1)
    angle[angle < 1e-12] = 0.0  # rounding error of equal rotations
    count = np.maximum(np.ceil((np.linalg.norm(shift, axis=1) + angle * reach) / step - 1e-9), 1.0).astype(np.int64)
    last = np.cumsum(count) - 1
    frame = np.repeat(np.arange(len(count)), count)
    s = (np.arange(len(frame)) - (last - count)[frame]) / count[frame]
    way = poses[frame, :3, 3] + s[:, None] * shift[frame]
    turn, turning = poses[frame, :3, :3], np.flatnonzero(angle[frame] > 0.0)
    if len(turning):
        turn[turning] = turn[turning] @ rotation_matrix(s[turning, None] * vectors[frame[turning]])
    way[last], turn[last] = poses[1:, :3, 3], poses[1:, :3, :3]
    end = np.full(len(frame), -1, np.int32)
    end[last] = np.arange(1, len(poses))
    return (np.concatenate([poses[:1, :3, :3], turn]), np.concatenate([poses[:1, :3, 3], way]),
            np.concatenate([np.zeros(1, np.int32), end]))


def _checked(particles: np.ndarray, probe: ProbeShape, poses: np.ndarray, friction: float,
             max_step: float) -> tuple[np.ndarray, np.ndarray]:
    particles, poses = np.asarray(particles, np.float64), np.asarray(poses, np.float64)
    if particles.ndim != 2 or particles.shape[1] != 3 or not np.isfinite(particles).all():
        raise VsfError(f"vsf.simulate: particles have shape {particles.shape}; give finite world positions (n, "
                       f"3) in metres.")
    if poses.ndim != 3 or poses.shape[1:] != (4, 4) or not np.isfinite(poses).all():
        raise VsfError(f"vsf.simulate: poses have shape {poses.shape}; give finite probe-to-world "
                       f"transforms (T, 4, 4).")
    turn = poses[:, :3, :3]
    if len(poses) and (np.abs(turn @ turn.transpose(0, 2, 1) - np.eye(3)).max() > 1e-6
                       or np.linalg.det(turn).min() < 0.0):
        raise VsfError("vsf.simulate: a pose is not rigid; its upper left 3x3 block must be a rotation (no scale, "
                       "no mirror).")
    if not isinstance(probe, (Sphere, Capsule, Cylinder, Box, Plane, Dome)):
        raise VsfError(f"vsf.simulate: probe is {probe!r}; it must be a Sphere, Capsule, Cylinder, Box or Plane of "
                       f"vsfsim.core.shape, or a Dome.")
    if not float(friction) >= 0.0:
        raise VsfError(f"vsf.simulate: friction is {friction!r}; it must be 0 or greater (math.inf sticks always).")
    if not 0.0 < max_step < math.inf:
        raise VsfError(f"vsf.simulate: max_step is {max_step!r}; it must be a length in metres greater than "
                       f"0, e.g. 1e-3.")
    return particles, poses
