"""What the rod kernels are given, work on and give back: tables of Warp structs, their memory on a device,
the plants there, and the start of a new touch.

A row has a field's type, its shape and its meaning. The letters of a shape are sizes, "-" is a single number:

    P plants               B touches                     T frames of a touch
    S nodes of all plants  N nodes of the largest plant  W poses on the way of a touch
    Q fibres of all plants K capsules                    C places for the contacts of a touch
    L levels of all plants D levels of the deepest plant, and the end
    V frames with nodes    M nodes of the largest plant, or capsules where there are more of them
"""

import dataclasses
from collections.abc import Sequence
from enum import IntEnum
from typing import Any

import numpy as np
import warp as wp

import vsfsim.physics.runtime  # noqa: F401  starts Warp quietly
from vsfsim.physics.rods.model import RodModel, RodOptions

_KINDS: dict[str, Any] = {}
"""The structs by name, which may be types of others' fields."""


def struct(name: str, **rows: Any) -> Any:
    """A Warp struct of the fields ``rows``, "type shape  meaning" or another struct. The type is one of Warp or the
    name of a struct of this table."""
    types, shapes = dict(rows), {}
    for field, row in rows.items():
        if isinstance(row, str):
            dtype, shapes[field], _ = row.split(maxsplit=2)
            types[field] = kind = _KINDS.get(dtype) or getattr(wp, dtype)
            if shapes[field] != "-":
                types[field] = wp.array(dtype=kind, ndim=len(shapes[field]))
    out = _KINDS[name] = wp.struct(type(name, (), {"__annotations__": types, "__module__": __name__}))
    out.shapes = shapes
    return out


def allocate(kind: Any, **sizes: int) -> Any:
    """An instance of a struct with its arrays zeroed, of the ``sizes`` that its rows name."""
    out = kind()
    for field, variable in kind.vars.items():
        if isinstance(variable.type, wp.array):
            shape = tuple(int(sizes.get(letter, letter)) for letter in kind.shapes[field])
            setattr(out, field, wp.zeros(shape, dtype=variable.type.dtype))
        elif field not in kind.shapes:
            setattr(out, field, allocate(variable.type, **sizes))
    return out


def filled(kind: Any, **values: Any) -> Any:
    """An instance of a struct with the ``values`` of all its fields: arrays, and structs as they are."""
    out = kind()
    for field, variable in kind.vars.items():
        value = values[field]
        if isinstance(variable.type, wp.array):
            value = wp.array(np.ascontiguousarray(value), dtype=variable.type.dtype)
        setattr(out, field, value)
    return out


class Stick(IntEnum):
    """Whether a point of a patch may have friction: not if it did not touch at the end of the last stride; since an
    earlier stride; or since this one, which may still lose it."""

    FREE = 0
    STUCK = 1
    NEW = 2


# The plants, one after the other. A node and the segment from its parent to it share a number; node 0 of a plant is
# clamped and has no segment. Numbers of nodes are counted within a plant.
Trees = struct(
    "Trees",
    first="int32 P  first node of each plant, and the end",
    parent="int32 S  parent of a node",
    rest="vec3d S  position at rest [m]",
    frame="quatd S  frame of the segment at rest, its x along the segment",
    length="float64 S  length of the segment [m]",
    kd="vec3d S  axial and shear stiffnesses of the segment [N/m]",
    kphi="vec3d S  torsional and bending stiffnesses of the segment [N m]",
    wire="vec2d S  bending stiffness of its core and the moment at which that yields, or 0 [N m]",
    load="vec3d S  dead force on the node [N]",
    reach="float64 S  longest way along segments from the node to a descendant [m]",
    bound="float64 S  radius around the segment's middle line that holds all its fibres [m]",
    fibre="int32 S  first fibre of each segment, and the end",
    child="int32 S  child with the highest number, -1 for none",
    next="int32 S  sibling with the next lower number, -1 for none",
    rank="int32 S  nodes of a plant by their level, the number of segments from the root",
    level="int32 L  first place of each level in `rank`, and the end, plant after plant",
    levels="int32 P  first entry of each plant in `level`, and the end",
    offset="vec3d Q  offset of a fibre from the segment's middle line, at rest [m]",
    radius="float64 Q  radius of the branch around a fibre [m]",
    tip="int32 Q  1 where a fibre is the tip of a branch, a point",
    # linear between the ends: the stiffness of a cantilever falls with the cube of its length
    softness="vec2d Q  (contact penalty)^(-1/3) at the parent's and the child's end [(m/N)^(1/3)]",
    floor="float64 P  bound on the rounding error of the residual of each plant [N]")

# `RodOptions`, as the kernels have them.
Limits = wp.struct(type("Limits", (), {"__module__": __name__, "__annotations__": {
    field.name: wp.float64 if field.type == "float" else wp.int32 for field in dataclasses.fields(RodOptions)}}))

# The touches: the capsules and their poses.
Touches = struct(
    "Touches",
    limits=Limits,
    plant="int32 B  number of the touched plant",
    friction="float64 B  coefficient of friction [-]",
    half="float64 K  half length of each capsule [m]",
    radius="float64 K  radius of each capsule [m]",
    position="vec3d BWK  positions of the capsules on the way [m]",
    rotation="quatd BWK  their rotations",
    plan="int32 BT  number of the pose on the way of each frame")

# What comes out of a frame, as in `RodFrames`.
Frame = struct(
    "Frame",
    reaction="spatial_vectord -  force and moment of the pot on the plant, about node 0 [N, N m]",
    residual="float64 -  unbalanced force over contact force [-]",
    energy="float64 -  elastic energy [J]",
    heat="float64 -  work that yielding has turned into heat since the touch began [J]",
    penetration="float64 -  depth of the deepest point inside a capsule [m]",
    iterations="int32 -  Newton iterations",
    reason="int32 -  `frames.Reason`",
    contacts="int32 -  number of touching patches, pairs of a fibre and a capsule")

Results = struct(
    "Results",
    frame="Frame BT  the frames",
    force="vec3d BTK  force on each capsule [N]",
    moment="vec3d BTK  moment on each capsule about its origin [N m]",
    x="vec3d BVN  positions of the nodes [m]; V is T or 0",
    q="quatd BVN  rotations of the nodes")

# A state of the nodes of each touched plant, or of the capsules.
State = struct(
    "State",
    x="vec3d BM  positions [m]",
    q="quatd BM  rotations, of nodes since rest")

# The nodes, and which of them are solved.
Nodes = struct(
    "Nodes",
    active="int32 BN  1 where the node is an unknown, until nothing touches, 0 where it moves rigidly with its parent",
    plastic="vec3d BN  plastic bending of the core in the middle frame's axes, the first 0 [rad]",
    heat="float64 BN  work that the segment's yielding has turned into heat [J]",
    order="int32 BN  the active nodes, level by level",
    level="int32 BD  first place of each level in `order`, and the end",
    unloaded_reach="float64 BN  longest unloaded branch that the node carries rigidly [m]",
    segment_clearance="float64 BN  of the segment, and what it carries rigidly, to capsules [m]",
    node_clearance="float64 BN  least `segment_clearance` of segments that meet at the node [m]")

# Strains of a segment and what follows from them, in the notation of `kernels.segment`.
Strain = struct(
    "Strain",
    turn="quatd -  Rm F, the rotation of the middle frame",
    d="vec3d -  d, extension and shear [m]",
    phi="vec3d -  phi, torsion and bending [rad]",
    D="vec3d -  D = d + L e1 [m]",
    psi="vec3d -  psi = phi / 2 [rad]",
    g="vec3d -  g = tau psi [-]",
    angle="float64 -  |psi| [rad]",
    c="float64 -  c = |psi| / sin |psi| [-]")

# Kinematics of each segment, and its contacts in the present list.
Segments = struct(
    "Segments",
    strain="Strain BN  its strains",
    span_rate="vec3d BN  D', the derivative of the span D along the step [m]",
    first_contact="int32 BN  place of its first contact in the list",
    contact_count="int32 BN  number of its contacts; first a bit for each capsule that is near")

# The linear system of a Newton step, in 6-vectors and 6 x 6 blocks of (position, spin) at the nodes [N, N m, m, rad]. A
# segment contributes to two nodes, the child, which has its number, and that node's parent. `gradient` is first the
# segment's at its child, then the node's; `blocks` are first of the elastic energy, then with the contacts, and the
# first of them is in the end the node's, with what its children's segments add.
System = struct(
    "System",
    gradient="spatial_vectord BN  of the potential",
    gradient_parent="spatial_vectord BN  of the segment's potential at its parent",
    blocks="spatial_matrixd BN4  second derivative of the segment's potential, see `kernels.elimination.CHILD`",
    eliminated_coupling="spatial_matrixd BN  inverse diagonal block times that of child and parent, eliminated",
    eliminated_gradient="spatial_vectord BN  inverse diagonal block times minus `gradient`, eliminated",
    step="spatial_vectord BN  the Newton step: displacement and spin")

# Gap between a point of a fibre and a capsule.
Gap = struct(
    "Gap",
    value="float64 -  signed distance, negative inside [m]",
    normal="vec3d -  unit normal from the capsule to the point, in the world",
    away="float64 -  distance of the point from the capsule's axis [m]",
    axis="vec3d -  direction of the capsule's axis; 0 where the nearest point is on a cap")

# What the end of a segment has of a contact.
End = struct(
    "End",
    share="float64 -  of its node in the displacement of the point [-]",
    arm="vec3d -  from its node to the point [m]",
    surface="vec3d -  from its node to the surface point [m]")

# What a contact remembers between strides.
Memory = struct(
    "Memory",
    key="int32 -  number of the point; the lists are sorted by it",
    stuck="int32 -  `Stick`",
    stretch="vec3d -  elastic slip at the start of the stride, in the capsule's frame [m]")

# A point of a patch of a fibre and a capsule that are close, which has `kernels.fibre.POINTS` of them.
Contact = struct(
    "Contact",
    memory=Memory,
    fibre="int32 -  number of the fibre in `Trees`",
    node="int32 -  segment of the fibre, counted within the plant",
    capsule="int32 -  number of the capsule",
    place="float64 -  place of the point along the segment, 0 to 1 [-]",
    stiffness="float64 -  penalty of the point [N/m]",
    gap_start="float64 -  gap of the patch at the start of the stride, 0 where closed [m]",
    lever="vec3d -  from the fibre to the surface point at the start of the stride, world [m]",
    anchor="vec3d -  where the surface point would be without friction force, world [m]",
    friction_limit="float64 -  largest friction force, coefficient times normal force [N]",
    point="vec3d -  position of the point, world [m]",
    surface="vec3d -  position of the surface point, world [m]",
    gap="Gap -  between the point and the capsule",
    parent=End,
    child=End,
    slip="vec3d -  tangential displacement of the surface point from its anchor [m]",
    normal_gradient="vec3d -  of the normal energy by the point's position, the force on the capsule [N]",
    friction_gradient="vec3d -  of the friction energy by the surface point's position [N]",
    force="vec3d -  force on the capsule [N]",
    moment="vec3d -  moment on the capsule about its origin [N m]")

# How far each touch is. A launch ends between two frames, and the next one continues there.
Progress = struct(
    "Progress",
    list="int32 -  which of the two contact lists holds the last equilibrium",
    next="int32 -  the next frame",
    ended="int32 -  1 if the last frame exceeded the force limit and is not kept, else 0",
    # 1 from a penetration that may end on the wrong side of a capsule until nothing touches, 2 from a capsule going
    # through the plant to the end of the touch
    wrong_side="int32 -  whether a link may be inside the plant")

# State and scratch of the touches. Two lists of contacts take turns as that of the last stride and of the present one.
Work = struct(
    "Work",
    # the nodes now, at the start of the stride, at a trial of the line search, and where a rejected step returns to
    now=State, start=State, trial=State, saved=State,
    # the capsules at the end of the stride and at its start
    capsules=State, capsules_start=State,
    nodes=Nodes, segments=Segments, system=System,
    contacts="Contact 2BC  the two lists of contacts",
    count="int32 2B  their lengths",
    progress="Progress B  how far each touch is")

# Which touch a thread works on, and its share of the work.
Thread = struct(
    "Thread",
    b="int32 -  the touch",
    o="int32 -  first node of its plant in `Trees`",
    n="int32 -  number of nodes of its plant",
    low="int32 -  first level of its plant in `Trees.level`",
    high="int32 -  number of levels of its plant",
    lane="int32 -  number of the thread among those of the touch, see `kernels.lanes`",
    lanes="int32 -  number of threads of the touch")


def make_trees(m: Sequence[RodModel], device: str) -> Any:
    """The plants on a device."""
    each = {name: [x.arrays[name] for x in m] for name in m[0].arrays}
    total, fibres, levels = (np.cumsum([0, *map(len, each[name])]) for name in ("parent", "radius", "level"))
    each["fibre"] = [*(first + f for first, f in zip(each["fibre"], fibres)), fibres[-1:]]
    each["level"] = [level + o for level, o in zip(each["level"], total)]
    each["softness"] = [np.cbrt(1.0 / x.penalty) for x in m]
    with wp.ScopedDevice(device):
        return filled(Trees, first=total, levels=levels, floor=np.array([x.floor() for x in m]),
                      **{name: np.concatenate(values) for name, values in each.items()})


def started(models: Sequence[RodModel], **sizes: Any) -> Any:
    """The `Work` of touches of the plants ``models`` before their first frame: plants at rest and no contact. ``sizes``
    as of `allocate`."""
    work = allocate(Work, **sizes)
    rest = np.zeros((len(models), sizes["M"], 3))
    for row, model in zip(rest, models):
        row[:len(model.plant.nodes)] = model.plant.nodes
    work.now.x.assign(rest)
    work.now.q.assign(np.tile([0.0, 0.0, 0.0, 1.0], (*rest.shape[:2], 1)))
    return work
