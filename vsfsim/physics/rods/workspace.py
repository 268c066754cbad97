"""The workspace of the rod kernels, as Warp structs by purpose, and the codes that stand in it.

Shapes: B touches, N nodes of the largest plant, D levels of the deepest plant, K capsules, C places for contacts.
"""

from enum import IntEnum

import warp as wp

import vsfsim.physics.runtime  # noqa: F401  starts Warp quietly


class Phase(IntEnum):
    """What a guarded arm does, see `kernels.guard`."""

    AS_PLANNED = 0
    CREEPING = 1
    BACK = 2


class Stick(IntEnum):
    """Whether a point of a patch may have friction."""

    FREE = 0
    """No: it did not touch at the end of the last stride."""
    STUCK = 1
    """Yes, since an earlier stride."""
    NEW = 2
    """Yes, since this stride, which may still lose it."""


class Stale(IntEnum):
    """What elimination has to do again at a node."""

    NO = 0
    """Nothing: the last elimination holds."""
    BELOW = 1
    """A node further from the root has changed."""
    CONTACTS = 2
    """A contact of the node's own segment entered or left the model of the step."""


@wp.struct
class Nodes:
    """The nodes of each touched plant, and which of them are solved."""

    x: wp.array2d(dtype=wp.vec3d)
    """Present position (B, N) [m]."""
    x_start: wp.array2d(dtype=wp.vec3d)
    """Position at the start of the stride (B, N) [m]."""
    x_trial: wp.array2d(dtype=wp.vec3d)
    """Position at a trial of the line search (B, N) [m]."""
    x_saved: wp.array2d(dtype=wp.vec3d)
    """Position to return to when a step is rejected (B, N) [m]."""
    q: wp.array2d(dtype=wp.quatd)
    """Present rotation since rest (B, N)."""
    q_start: wp.array2d(dtype=wp.quatd)
    """Rotation at the start of the stride (B, N)."""
    q_trial: wp.array2d(dtype=wp.quatd)
    """Rotation at a trial of the line search (B, N)."""
    q_saved: wp.array2d(dtype=wp.quatd)
    """Rotation to return to when a step is rejected (B, N)."""
    active: wp.array2d(dtype=wp.int32)
    """1 where the node is an unknown, 0 where it moves rigidly with its parent (B, N)."""
    strained: wp.array2d(dtype=wp.int32)
    """1 where the segment was strained at the last equilibrium (B, N)."""
    plastic: wp.array2d(dtype=wp.vec3d)
    """Plastic bending of the segment's core, in the axes of the middle frame, the first 0 (B, N) [rad]."""
    heat: wp.array2d(dtype=wp.float64)
    """Work that the segment's yielding has turned into heat (B, N) [J]."""
    order: wp.array2d(dtype=wp.int32)
    """The active nodes, level by level (B, N)."""
    level: wp.array2d(dtype=wp.int32)
    """First place of each level in `order`, and the end (B, D + 1)."""
    unloaded_reach: wp.array2d(dtype=wp.float64)
    """Length of the longest unloaded branch that the node carries rigidly (B, N) [m]."""
    segment_clearance: wp.array2d(dtype=wp.float64)
    """Lower bound on the distance from the segment, and what it carries rigidly, to the capsules (B, N) [m]."""
    node_clearance: wp.array2d(dtype=wp.float64)
    """The least `segment_clearance` of the segments that meet at the node (B, N) [m]."""


@wp.struct
class Segments:
    """Kinematics of each segment, in the notation of `kernels.segment`, and its contacts in the present list."""

    frame: wp.array2d(dtype=wp.quatd)
    """Rm F, the frame in the middle of the segment (B, N)."""
    span: wp.array2d(dtype=wp.vec3d)
    """D, the vector from parent to child in the middle frame (B, N) [m]."""
    half_rotation: wp.array2d(dtype=wp.vec3d)
    """g, along half the rotation over the segment (B, N) [-]."""
    span_rate: wp.array2d(dtype=wp.vec3d)
    """D', its derivative along the step (B, N) [m]."""
    relative_spin: wp.array2d(dtype=wp.vec3d)
    """Spin of the child less that of the parent along the step, in the world (B, N) [rad]."""
    first_contact: wp.array2d(dtype=wp.int32)
    """Place of its first contact in the list (B, N)."""
    contact_count: wp.array2d(dtype=wp.int32)
    """Number of its contacts in the list (B, N); while the list is made, a bit for each capsule that is near."""


@wp.struct
class System:
    """The linear system of a Newton step, in 6-vectors and 6 x 6 blocks of (position, spin) at the nodes.

    A segment contributes to two nodes: what ends in `_child` belongs to the node of its own number, what ends in
    `_parent` to that node's parent.
    """

    gradient: wp.array2d(dtype=wp.spatial_vectord)
    """Gradient of the potential (B, N) [N, N m]."""
    contact_gradient_child: wp.array2d(dtype=wp.spatial_vectord)
    """Gradient of the segment's contact energy at the child (B, N) [N, N m]."""
    contact_gradient_parent: wp.array2d(dtype=wp.spatial_vectord)
    """The same at the parent (B, N) [N, N m]."""
    elastic_gradient: wp.array2d(dtype=wp.spatial_vectord)
    """Gradient of the elastic energy less the dead load, first of the segment at its child, then of the node (B, N)
    [N, N m]."""
    elastic_gradient_parent: wp.array2d(dtype=wp.spatial_vectord)
    """Gradient of the segment's elastic energy at its parent (B, N) [N, N m]."""
    elastic_block: wp.array2d(dtype=wp.spatial_matrixd)
    """Second derivative of the elastic energy, first of the segment at its child, then of the node (B, N)."""
    elastic_block_parent: wp.array2d(dtype=wp.spatial_matrixd)
    """Second derivative of the segment's elastic energy at its parent (B, N)."""
    elastic_coupling: wp.array2d(dtype=wp.spatial_matrixd)
    """Its mixed second derivative, rows of the child and columns of the parent (B, N)."""
    contact_block_child: wp.array2d(dtype=wp.spatial_matrixd)
    """Second derivative of the segment's contact energy at the child (B, N)."""
    contact_block_parent: wp.array2d(dtype=wp.spatial_matrixd)
    """The same at the parent (B, N)."""
    contact_rhs_child: wp.array2d(dtype=wp.spatial_vectord)
    """Minus the gradient of the contacts in the step's model at the child (B, N) [N, N m]."""
    contact_rhs_parent: wp.array2d(dtype=wp.spatial_vectord)
    """The same at the parent (B, N) [N, N m]."""
    diagonal: wp.array2d(dtype=wp.spatial_matrixd)
    """Diagonal block of the system (B, N)."""
    child_parent: wp.array2d(dtype=wp.spatial_matrixd)
    """Block of the system with the rows of the node and the columns of its parent (B, N)."""
    parent_child: wp.array2d(dtype=wp.spatial_matrixd)
    """Block with the rows of the parent and the columns of the node; used by the unsymmetric system only (B, N)."""
    rhs: wp.array2d(dtype=wp.spatial_vectord)
    """Right-hand side (B, N) [N, N m]."""
    eliminated_coupling: wp.array2d(dtype=wp.spatial_matrixd)
    """`child_parent` after elimination, times the inverse of the diagonal block (B, N)."""
    eliminated_rhs: wp.array2d(dtype=wp.spatial_vectord)
    """`rhs` after elimination, times the inverse of the diagonal block (B, N)."""
    stale: wp.array2d(dtype=wp.int32)
    """`Stale` (B, N)."""
    step: wp.array2d(dtype=wp.spatial_vectord)
    """The Newton step: displacement and spin (B, N) [m, rad]."""


@wp.struct
class Capsules:
    """Poses of the capsules in the present stride."""

    x: wp.array2d(dtype=wp.vec3d)
    """Position at its end (B, K) [m]."""
    x_start: wp.array2d(dtype=wp.vec3d)
    """Position at its start (B, K) [m]."""
    q: wp.array2d(dtype=wp.quatd)
    """Rotation at its end (B, K)."""
    q_start: wp.array2d(dtype=wp.quatd)
    """Rotation at its start (B, K)."""


@wp.struct
class Contacts:
    """The points of the patches of fibres and capsules that are close, `kernels.fibre.POINTS` of each. Arrays (2, B, C)
    hold two lists, which take turns as the list of the last stride and that of the present one; arrays (B, C) belong to
    the present one."""

    count: wp.array2d(dtype=wp.int32)
    """Length of each list (2, B)."""
    key: wp.array3d(dtype=wp.int32)
    """Number of the point; the lists are sorted by it (2, B, C)."""
    fibre: wp.array3d(dtype=wp.int32)
    """Number of the fibre in `Trees` (2, B, C)."""
    node: wp.array3d(dtype=wp.int32)
    """Segment of the fibre, counted within the plant (2, B, C)."""
    capsule: wp.array3d(dtype=wp.int32)
    """Number of the capsule (2, B, C)."""
    place: wp.array3d(dtype=wp.float64)
    """Place of the point along the segment, 0 to 1 (2, B, C) [-]."""
    stiffness: wp.array3d(dtype=wp.float64)
    """Penalty of the point (2, B, C) [N/m]."""
    stuck: wp.array3d(dtype=wp.int32)
    """`Stick` (2, B, C)."""
    in_step: wp.array3d(dtype=wp.int32)
    """1 where the contact takes part in the model of the step (2, B, C)."""
    stretch: wp.array3d(dtype=wp.vec3d)
    """Elastic part of the tangential displacement of the surface point at the start of the stride, in the capsule's
    frame (2, B, C) [m]."""
    anchor: wp.array3d(dtype=wp.vec3d)
    """Where the surface point would be without friction force, in the world (2, B, C) [m]."""
    gap_start: wp.array3d(dtype=wp.float64)
    """Gap of the patch at the start of the stride, 0 where it was closed (2, B, C) [m]."""
    lever: wp.array3d(dtype=wp.vec3d)
    """From the fibre to the surface point, in the world at the start of the stride (2, B, C) [m]."""
    normal: wp.array3d(dtype=wp.vec3d)
    """Unit normal, from the capsule to the fibre (2, B, C)."""
    depth: wp.array3d(dtype=wp.float64)
    """Penetration, negative for a gap (2, B, C) [m]."""
    friction_limit: wp.array3d(dtype=wp.float64)
    """Largest friction force, the coefficient times the normal force (2, B, C) [N]."""
    child_share: wp.array2d(dtype=wp.float64)
    """Share of the child's node in the displacement of the point (B, C) [-]."""
    arm_parent: wp.array2d(dtype=wp.vec3d)
    """Lever of the point from the parent's node (B, C) [m]."""
    arm_child: wp.array2d(dtype=wp.vec3d)
    """Lever of the point from the child's node (B, C) [m]."""
    surface_arm_parent: wp.array2d(dtype=wp.vec3d)
    """Lever of the surface point from the parent's node (B, C) [m]."""
    surface_arm_child: wp.array2d(dtype=wp.vec3d)
    """Lever of the surface point from the child's node (B, C) [m]."""
    normal_gradient: wp.array2d(dtype=wp.vec3d)
    """Gradient of the normal energy by the point's position (B, C) [N]."""
    friction_gradient: wp.array2d(dtype=wp.vec3d)
    """Gradient of the friction energy by the surface point's position (B, C) [N]."""
    slip: wp.array2d(dtype=wp.vec3d)
    """Tangential displacement of the surface point from its anchor (B, C) [m]."""
    normal_hessian: wp.array2d(dtype=wp.mat33d)
    """Second derivative of the normal energy (B, C) [N/m]."""
    friction_hessian: wp.array2d(dtype=wp.mat33d)
    """Second derivative of the friction energy (B, C) [N/m]."""
    coulomb_hessian: wp.array2d(dtype=wp.mat33d)
    """Derivative of the friction force by the point's position through the friction limit (B, C) [N/m]."""
    force: wp.array2d(dtype=wp.vec3d)
    """Force on the capsule (B, C) [N]."""
    moment: wp.array2d(dtype=wp.vec3d)
    """Moment on the capsule about its origin (B, C) [N m]."""


@wp.struct
class Progress:
    """How far each touch is. A launch may end in the middle of a frame; the next one continues there."""

    list: wp.array(dtype=wp.int32)
    """Which of the two contact lists holds the last equilibrium (B,)."""
    next: wp.array(dtype=wp.int32)
    """The next frame (B,)."""
    ended: wp.array(dtype=wp.int32)
    """1 + the number of the first frame that is not kept, 0 while the touch goes on (B,)."""
    wrong_side: wp.array(dtype=wp.int32)
    """1 from a penetration that may end on the wrong side of a capsule until nothing touches, 2 from a capsule going
    through the plant to the end of the touch (B,)."""
    part: wp.array(dtype=wp.float64)
    """Finished part of the present frame (B,) [-]."""
    stride: wp.array(dtype=wp.float64)
    """Next stride as a part of the frame, 0 for a new frame (B,) [-]."""
    used: wp.array(dtype=wp.int32)
    """Newton iterations of the present frame (B,)."""
    broken: wp.array(dtype=wp.int32)
    """1 if a stride of the present frame ended without an equilibrium (B,)."""
    total: wp.array(dtype=wp.int32)
    """Newton iterations of the frames before it (B,)."""


@wp.struct
class Guard:
    """State of the guard, see `kernels.guard`, and the equilibrium that it returns to."""

    position: wp.array(dtype=wp.float64)
    """Where the arm is on its way (B,) [poses]."""
    good_position: wp.array(dtype=wp.float64)
    """Where it was last in equilibrium below the force limit (B,) [poses]."""
    turning_position: wp.array(dtype=wp.float64)
    """Where it turned (B,) [poses]."""
    clear_position: wp.array(dtype=wp.float64)
    """The last position before it first touched (B,) [poses]."""
    pace: wp.array(dtype=wp.float64)
    """Advance per frame while it creeps (B,) [poses]."""
    phase: wp.array(dtype=wp.int32)
    """`Phase` (B,)."""
    turning_frame: wp.array(dtype=wp.int32)
    """Frame in which it turned (B,)."""
    touched: wp.array(dtype=wp.int32)
    """1 since the first contact (B,)."""
    failures: wp.array(dtype=wp.int32)
    """Consecutive frames without an equilibrium (B,)."""
    x: wp.array2d(dtype=wp.vec3d)
    """Positions of the nodes in that equilibrium (B, N) [m]."""
    q: wp.array2d(dtype=wp.quatd)
    """Their rotations (B, N)."""
    strained: wp.array2d(dtype=wp.int32)
    """`Nodes.strained` (B, N)."""
    plastic: wp.array2d(dtype=wp.vec3d)
    """`Nodes.plastic` (B, N) [rad]."""
    heat: wp.array2d(dtype=wp.float64)
    """`Nodes.heat` (B, N) [J]."""
    count: wp.array(dtype=wp.int32)
    """Number of its contacts (B,)."""
    key: wp.array2d(dtype=wp.int32)
    """`Contacts.key` (B, C)."""
    stuck: wp.array2d(dtype=wp.int32)
    """`Contacts.stuck` (B, C)."""
    stretch: wp.array2d(dtype=wp.vec3d)
    """`Contacts.stretch` (B, C) [m]."""


@wp.struct
class Work:
    """State and scratch of the touches."""

    nodes: Nodes
    """Positions and rotations."""
    segments: Segments
    """Kinematics between two nodes."""
    system: System
    """The Newton step."""
    capsules: Capsules
    """Where the arm is."""
    contacts: Contacts
    """What touches."""
    progress: Progress
    """How far each touch is."""
    guard: Guard
    """When the arm turns back."""


@wp.struct
class Thread:
    """Which touch a thread works on, and its share of the work."""

    b: wp.int32
    """The touch."""
    o: wp.int32
    """First node of its plant in `Trees`."""
    n: wp.int32
    """Number of nodes of its plant."""
    low: wp.int32
    """First level of its plant in `Trees.level`."""
    high: wp.int32
    """Number of levels of its plant."""
    lane: wp.int32
    """Number of the thread among those of the touch, see `kernels.lanes`."""
    lanes: wp.int32
    """Number of threads of the touch."""
