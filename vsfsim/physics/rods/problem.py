"""What the rod kernels are given and give back, as Warp structs: the plants, the touches and the results.

Shapes: P plants, S nodes of all plants together, Q contact fibres of all plants, B touches, N nodes of the largest
plant, K capsules, T frames, W poses on the way of a touch.
"""

import warp as wp

import vsfsim.physics.runtime  # noqa: F401  starts Warp quietly


@wp.struct
class Trees:
    """The plants, one after the other. A node and the segment from its parent to it share a number; node 0 of a plant
    is clamped and has no segment."""

    first: wp.array(dtype=wp.int32)
    """First node of each plant, and the end (P + 1,)."""
    parent: wp.array(dtype=wp.int32)
    """Parent of a node, counted within the plant (S,)."""
    rest: wp.array(dtype=wp.vec3d)
    """Position at rest (S,) [m]."""
    frame: wp.array(dtype=wp.quatd)
    """Frame of the segment at rest, its x along the segment (S,)."""
    length: wp.array(dtype=wp.float64)
    """Length of the segment (S,) [m]."""
    kd: wp.array(dtype=wp.vec3d)
    """Axial and shear stiffnesses of the segment (S,) [N/m]."""
    kphi: wp.array(dtype=wp.vec3d)
    """Torsional and bending stiffnesses of the segment (S,) [N m]."""
    wire: wp.array(dtype=wp.vec2d)
    """Bending stiffness of the segment's core and the moment at which it yields, 0 for a segment that does not (S,)
    [N m]."""
    load: wp.array(dtype=wp.vec3d)
    """Dead force on the node (S,) [N]."""
    reach: wp.array(dtype=wp.float64)
    """Longest way along segments from the node to a descendant, at rest (S,) [m]."""
    bound: wp.array(dtype=wp.float64)
    """Radius around the segment's middle line that holds all its fibres (S,) [m]."""
    fibre: wp.array(dtype=wp.int32)
    """First fibre of each segment, and the end (S + 1,)."""
    child: wp.array(dtype=wp.int32)
    """Child with the highest number, counted within the plant; -1 for none (S,)."""
    next: wp.array(dtype=wp.int32)
    """Sibling with the next lower number; -1 for none (S,)."""
    rank: wp.array(dtype=wp.int32)
    """Nodes of a plant ordered by their level, the number of segments from the root (S,)."""
    level: wp.array(dtype=wp.int32)
    """First place of each level in `rank`, and the end, plant after plant."""
    levels: wp.array(dtype=wp.int32)
    """First entry of each plant in `level`, and the end (P + 1,)."""
    offset: wp.array(dtype=wp.vec3d)
    """Offset of a fibre from the segment's middle line, at rest (Q,) [m]."""
    radius: wp.array(dtype=wp.float64)
    """Radius of the branch around a fibre (Q,) [m]."""
    tip: wp.array(dtype=wp.int32)
    """1 where a fibre is the tip of a branch, a point (Q,)."""
    softness: wp.array(dtype=wp.vec2d)
    """Inverse cube root of the contact penalty of `kernels.fibre.CONTACT_LENGTH` at the parent's end and at the child's
    (Q,) [(m/N)^(1/3)]. It is linear between them: the stiffness of a cantilever falls with the cube of its length."""
    floor: wp.array(dtype=wp.float64)
    """Bound on the rounding error of the residual of each plant (P,) [N]."""


@wp.struct
class Touches:
    """The touches: the capsules, their poses, and the limits of the solver (see `RodOptions`)."""

    plant: wp.array(dtype=wp.int32)
    """Number of the touched plant (B,)."""
    friction: wp.array(dtype=wp.float64)
    """Coefficient of friction (B,) [-]."""
    frames: wp.array(dtype=wp.int32)
    """Number of frames (B,)."""
    half: wp.array(dtype=wp.float64)
    """Half length of each capsule (K,) [m]."""
    radius: wp.array(dtype=wp.float64)
    """Radius of each capsule (K,) [m]."""
    position: wp.array3d(dtype=wp.vec3d)
    """Positions of the capsules on the way (B, W, K) [m]."""
    rotation: wp.array3d(dtype=wp.quatd)
    """Rotations of the capsules on the way (B, W, K)."""
    last_pose: wp.array(dtype=wp.int32)
    """Number of the last pose on the way (B,)."""
    plan: wp.array2d(dtype=wp.float64)
    """Where on the way each frame is planned, in numbers of poses (B, T)."""
    inward: wp.array(dtype=wp.int32)
    """Number of frames before the planned way out (B,)."""
    guarded: wp.int32
    """1: before the force limit the arm turns back, see `kernels.guard`; 0: the touch ends there."""
    hold: wp.int32
    """Frames that a guarded touch stands still after it turned."""
    out: wp.int32
    """Least number of frames that a guarded touch keeps for the way back."""
    newton: wp.int32
    """Newton iterations of one attempt at a stride, those cut short by the free space not counted."""
    travel: wp.int32
    """Newton iterations of one attempt at a stride, all counted."""
    work: wp.int32
    """Newton iterations of a frame after which strides are no longer divided."""
    patience: wp.int32
    """Newton iterations after which a touch is given up."""
    force_limit: wp.float64
    """Largest contact force of a kept frame on the way in [N]."""
    tolerance: wp.float64
    """Largest unbalanced force over contact force [-]."""
    force_floor: wp.float64
    """Contact forces below this count as this in the tolerance [N]."""


@wp.struct
class Results:
    """What comes out, a value for each frame."""

    force: wp.array3d(dtype=wp.vec3d)
    """Force on each capsule (B, T, K) [N]."""
    moment: wp.array3d(dtype=wp.vec3d)
    """Moment on each capsule about its origin (B, T, K) [N m]."""
    reaction: wp.array2d(dtype=wp.spatial_vectord)
    """Force and moment of the pot on the plant, about node 0 (B, T) [N, N m]."""
    residual: wp.array2d(dtype=wp.float64)
    """Unbalanced force over contact force (B, T) [-]."""
    energy: wp.array2d(dtype=wp.float64)
    """Elastic energy (B, T) [J]."""
    heat: wp.array2d(dtype=wp.float64)
    """Work that yielding has turned into heat since the touch began (B, T) [J]."""
    penetration: wp.array2d(dtype=wp.float64)
    """Depth of the deepest point inside a capsule (B, T) [m]."""
    slipping: wp.array2d(dtype=wp.float64)
    """Share of the Gauss points in contact that slip (B, T) [-]."""
    where: wp.array2d(dtype=wp.float64)
    """Where the arm was on its way (B, T) [poses]."""
    iterations: wp.array2d(dtype=wp.int32)
    """Newton iterations (B, T)."""
    reason: wp.array2d(dtype=wp.int32)
    """`frames.Reason` (B, T)."""
    contacts: wp.array2d(dtype=wp.int32)
    """Number of touching patches, pairs of a fibre and a capsule (B, T)."""
    x: wp.array3d(dtype=wp.vec3d)
    """Positions of the nodes (B, T, N) [m], or of no length."""
    q: wp.array3d(dtype=wp.quatd)
    """Rotations of the nodes (B, T, N), or of no length."""
