"""What the rod kernels read and write, as Warp structs: trees, touches, workspace, results. Shapes: P plants, S all
nodes of all of them, B touches, N nodes of the largest plant, K capsules, T frames, P poses on the way, C places for
contacts."""

import warp as wp

import vsfsim.physics.runtime  # noqa: F401  starts Warp quietly


@wp.struct
class Trees:
    """The plants, one after the other. A node and the segment from its parent to it share a number; node 0 of a plant
    is clamped and has none.

    first: of a plant's nodes (P + 1,). parent: within the plant (S,). rest: position (S,) [m]. frame: of the segment at
    rest, x along it (S,).
    length: (S,) [m]. kd: (S,) [N/m]. kphi: (S,) [N m]. load: dead force (S,) [N]. reach: longest way from a node to one
    below it, at rest (S,) [m].
    bound: radius around the segment that holds all its samples (S,) [m]. sample: first of a segment's samples (S + 1,).
    child: its highest child within the plant, next: the next lower one of the same parent, -1 for none (S,). rank:
    nodes of a plant by their number of segments from the root (S,);
    level: first in `rank` of each such number and the end, plant after plant; levels: first of a plant's in `level` (P
    + 1,).
    along: (Q,) in 0..1. offset: (Q,) [m]. radius: (Q,) [m]. penalty: (Q,) [N/m]. floor: what rounding leaves of the
    residual (P,) [N].
    """

    first: wp.array(dtype=wp.int32)
    parent: wp.array(dtype=wp.int32)
    rest: wp.array(dtype=wp.vec3d)
    frame: wp.array(dtype=wp.quatd)
    length: wp.array(dtype=wp.float64)
    kd: wp.array(dtype=wp.vec3d)
    kphi: wp.array(dtype=wp.vec3d)
    load: wp.array(dtype=wp.vec3d)
    reach: wp.array(dtype=wp.float64)
    bound: wp.array(dtype=wp.float64)
    sample: wp.array(dtype=wp.int32)
    child: wp.array(dtype=wp.int32)
    next: wp.array(dtype=wp.int32)
    rank: wp.array(dtype=wp.int32)
    level: wp.array(dtype=wp.int32)
    levels: wp.array(dtype=wp.int32)
    along: wp.array(dtype=wp.float64)
    offset: wp.array(dtype=wp.vec3d)
    radius: wp.array(dtype=wp.float64)
    penalty: wp.array(dtype=wp.float64)
    floor: wp.array(dtype=wp.float64)


@wp.struct
class Touches:
    """The touches. plant: of each (B,). friction: (B,) [-]. frames: of each (B,). half, radius: of the capsules (K,)
    [m]. place, turn: their poses on the way, P of them (B, P, K); last: number of the last one (B,).
    plan: where on the way each frame is meant to be, in numbers of poses (B, T). inward: frames before the planned way
    out (B,).

    force_limit: no frame is kept that is past it [N]; guarded: 0, the touch ends there, 1: the arm turns back, see
    `guard`; hold, out: frames that such a touch stands still and at least goes back.
    newton: iterations of one try at a stride, travel: with those in which something goes as far as it may, which
    `newton` does not count; work: of a frame, after which no stride is tried again in shorter ones, patience: of a
    touch, after which it is given up. tolerance: unbalanced over contact force [-]; contact forces under ``faint``
    count as that [N].
    """

    plant: wp.array(dtype=wp.int32)
    friction: wp.array(dtype=wp.float64)
    frames: wp.array(dtype=wp.int32)
    half: wp.array(dtype=wp.float64)
    radius: wp.array(dtype=wp.float64)
    place: wp.array3d(dtype=wp.vec3d)
    turn: wp.array3d(dtype=wp.quatd)
    last: wp.array(dtype=wp.int32)
    plan: wp.array2d(dtype=wp.float64)
    inward: wp.array(dtype=wp.int32)
    guarded: wp.int32
    hold: wp.int32
    out: wp.int32
    newton: wp.int32
    travel: wp.int32
    work: wp.int32
    patience: wp.int32
    force_limit: wp.float64
    tolerance: wp.float64
    faint: wp.float64


@wp.struct
class Here:
    """Which touch a thread works on. b: the touch, o: first node of its plant, n: how many, low: first of its levels in
    `Trees.level`, high: how many levels. lane, lanes: see `lanes`."""

    b: wp.int32
    o: wp.int32
    n: wp.int32
    low: wp.int32
    high: wp.int32
    lane: wp.int32
    lanes: wp.int32


@wp.struct
class Work:
    """State and scratch. "Of a segment": of that from the parent to the node of the same number.

    Nodes (B, N). x, q: now; *_start: at the step's start; *_try: in the line search; *_keep: to come back to. active,
    strained: 0 or 1; order: the active ones, level by level; level: first of each in it (B, D + 2). rider: length of
    what hangs on a node unloaded [m]; clear: of segments from capsules, room: of nodes to move in [m]. first, many:
    contacts of a segment in the list in use.
    g: gradient, elastic: that of the elastic energy; own, mixed (child, parent): blocks of its second derivative;
    diagonal, coupling (child, parent), across (parent, child), right: of the step's model;
    passed, held: what elimination leaves of coupling and right side; stale: 2 where contacts were set on or off since,
    1 below such a node; step: Newton's. *_up: the share of a segment's that belongs to its parent, *_on: of its
    contacts, for the child. mid, stretch, half_turn, rate: Rm F, D, g and D' of each segment, see `segment`; relative:
    spin over it. cap_*: capsules now and at the start (B, K).
    Contacts (2, B, C), two lists in turn: key, sample, node, body: which; stuck: 1 if `anchor` holds; anchor: place on
    the capsule, its frame [m];
    gap0: at the step's start [m]; local0: surface point there, in the capsule's frame [m]; lever: from the point to the
    surface, world at the start [m]; tau: limit of friction [N]; depth: inside the capsule [m]; on: in the step's model;
    normal; hold: anchor in the world [m]. count: contacts of each list (2, B).
    Contacts now (B, C): arm_p, arm_c: levers of the sample from its nodes, rub_p, rub_c: of its surface point [m]; fn,
    ft: gradients of normal and friction energy [N]; slid: way from the anchor [m];
    hn, ht, hc: second derivatives, and that of friction by the normal way [N/m]; out_f, out_m: wrench on the capsule.
    side: list in use (B,). next: frame that comes next (B,). ended: number of the frame past the force limit, from 1
    (B,).
    astray: 1 since something was deep in a link, until nothing touches (B,).
    A frame that a launch could not finish: part of it that is done, stride that comes next, 0 for a fresh frame (B,)
    [-]; used: its iterations so far (B,). total: of the whole touch (B,).
    The guard (B,), see `guard`: at: where the arm is on the way, good: where it last was in equilibrium under the
    limit, pace: poses a frame when it creeps, top: where it turned, low: where nothing was met yet;
    phase, turned, met, fails. What it goes back to: x_good, q_good, strained_good (B, N), contacts key_good,
    stuck_good, anchor_good (B, C), count_good (B,).
    """

    x: wp.array2d(dtype=wp.vec3d)
    x_start: wp.array2d(dtype=wp.vec3d)
    x_try: wp.array2d(dtype=wp.vec3d)
    x_keep: wp.array2d(dtype=wp.vec3d)
    q: wp.array2d(dtype=wp.quatd)
    q_start: wp.array2d(dtype=wp.quatd)
    q_try: wp.array2d(dtype=wp.quatd)
    q_keep: wp.array2d(dtype=wp.quatd)
    active: wp.array2d(dtype=wp.int32)
    strained: wp.array2d(dtype=wp.int32)
    order: wp.array2d(dtype=wp.int32)
    level: wp.array2d(dtype=wp.int32)
    first: wp.array2d(dtype=wp.int32)
    many: wp.array2d(dtype=wp.int32)
    stale: wp.array2d(dtype=wp.int32)
    rider: wp.array2d(dtype=wp.float64)
    clear: wp.array2d(dtype=wp.float64)
    room: wp.array2d(dtype=wp.float64)
    g: wp.array2d(dtype=wp.spatial_vectord)
    g_on: wp.array2d(dtype=wp.spatial_vectord)
    g_up: wp.array2d(dtype=wp.spatial_vectord)
    elastic: wp.array2d(dtype=wp.spatial_vectord)
    elastic_up: wp.array2d(dtype=wp.spatial_vectord)
    right: wp.array2d(dtype=wp.spatial_vectord)
    right_on: wp.array2d(dtype=wp.spatial_vectord)
    right_up: wp.array2d(dtype=wp.spatial_vectord)
    held: wp.array2d(dtype=wp.spatial_vectord)
    step: wp.array2d(dtype=wp.spatial_vectord)
    own: wp.array2d(dtype=wp.spatial_matrixd)
    own_up: wp.array2d(dtype=wp.spatial_matrixd)
    mixed: wp.array2d(dtype=wp.spatial_matrixd)
    diagonal: wp.array2d(dtype=wp.spatial_matrixd)
    diagonal_on: wp.array2d(dtype=wp.spatial_matrixd)
    diagonal_up: wp.array2d(dtype=wp.spatial_matrixd)
    coupling: wp.array2d(dtype=wp.spatial_matrixd)
    across: wp.array2d(dtype=wp.spatial_matrixd)
    passed: wp.array2d(dtype=wp.spatial_matrixd)
    mid: wp.array2d(dtype=wp.quatd)
    stretch: wp.array2d(dtype=wp.vec3d)
    half_turn: wp.array2d(dtype=wp.vec3d)
    rate: wp.array2d(dtype=wp.vec3d)
    relative: wp.array2d(dtype=wp.vec3d)
    cap_x: wp.array2d(dtype=wp.vec3d)
    cap_x_start: wp.array2d(dtype=wp.vec3d)
    cap_q: wp.array2d(dtype=wp.quatd)
    cap_q_start: wp.array2d(dtype=wp.quatd)
    key: wp.array3d(dtype=wp.int32)
    sample: wp.array3d(dtype=wp.int32)
    node: wp.array3d(dtype=wp.int32)
    body: wp.array3d(dtype=wp.int32)
    stuck: wp.array3d(dtype=wp.int32)
    on: wp.array3d(dtype=wp.int32)
    anchor: wp.array3d(dtype=wp.vec3d)
    local0: wp.array3d(dtype=wp.vec3d)
    lever: wp.array3d(dtype=wp.vec3d)
    normal: wp.array3d(dtype=wp.vec3d)
    hold: wp.array3d(dtype=wp.vec3d)
    gap0: wp.array3d(dtype=wp.float64)
    tau: wp.array3d(dtype=wp.float64)
    depth: wp.array3d(dtype=wp.float64)
    count: wp.array2d(dtype=wp.int32)
    arm_p: wp.array2d(dtype=wp.vec3d)
    arm_c: wp.array2d(dtype=wp.vec3d)
    rub_p: wp.array2d(dtype=wp.vec3d)
    rub_c: wp.array2d(dtype=wp.vec3d)
    fn: wp.array2d(dtype=wp.vec3d)
    ft: wp.array2d(dtype=wp.vec3d)
    slid: wp.array2d(dtype=wp.vec3d)
    out_f: wp.array2d(dtype=wp.vec3d)
    out_m: wp.array2d(dtype=wp.vec3d)
    hn: wp.array2d(dtype=wp.mat33d)
    ht: wp.array2d(dtype=wp.mat33d)
    hc: wp.array2d(dtype=wp.mat33d)
    side: wp.array(dtype=wp.int32)
    next: wp.array(dtype=wp.int32)
    ended: wp.array(dtype=wp.int32)
    astray: wp.array(dtype=wp.int32)
    part: wp.array(dtype=wp.float64)
    stride: wp.array(dtype=wp.float64)
    used: wp.array(dtype=wp.int32)
    total: wp.array(dtype=wp.int32)
    at: wp.array(dtype=wp.float64)
    good: wp.array(dtype=wp.float64)
    pace: wp.array(dtype=wp.float64)
    top: wp.array(dtype=wp.float64)
    low: wp.array(dtype=wp.float64)
    phase: wp.array(dtype=wp.int32)
    turned: wp.array(dtype=wp.int32)
    met: wp.array(dtype=wp.int32)
    fails: wp.array(dtype=wp.int32)
    x_good: wp.array2d(dtype=wp.vec3d)
    q_good: wp.array2d(dtype=wp.quatd)
    strained_good: wp.array2d(dtype=wp.int32)
    key_good: wp.array2d(dtype=wp.int32)
    stuck_good: wp.array2d(dtype=wp.int32)
    anchor_good: wp.array2d(dtype=wp.vec3d)
    count_good: wp.array(dtype=wp.int32)


@wp.struct
class Results:
    """What comes out. force, moment: on each capsule, the moment about its origin (B, T, K) [N, N m]. reaction: of the
    pot on the plant, force and moment about its node 0 (B, T). residual, energy, penetration, slipping: (B, T) [-, J,
    m, -]. where: on the way (B, T) [poses]. iterations, reason, contacts: (B, T). x, q: nodes (B, T, N), or of no
    length."""

    force: wp.array3d(dtype=wp.vec3d)
    moment: wp.array3d(dtype=wp.vec3d)
    reaction: wp.array2d(dtype=wp.spatial_vectord)
    residual: wp.array2d(dtype=wp.float64)
    energy: wp.array2d(dtype=wp.float64)
    penetration: wp.array2d(dtype=wp.float64)
    slipping: wp.array2d(dtype=wp.float64)
    where: wp.array2d(dtype=wp.float64)
    iterations: wp.array2d(dtype=wp.int32)
    reason: wp.array2d(dtype=wp.int32)
    contacts: wp.array2d(dtype=wp.int32)
    x: wp.array3d(dtype=wp.vec3d)
    q: wp.array3d(dtype=wp.quatd)
