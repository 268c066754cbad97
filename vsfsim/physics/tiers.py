"""Fidelity tiers: how finely a body is modelled, and the cheapest tier that shows what a scene needs."""

from __future__ import annotations

import dataclasses
import functools
from dataclasses import dataclass

import numpy as np

from vsfsim.core.errors import SceneError, did_you_mean
from vsfsim.core.scene import ObjectSpec, Scene
from vsfsim.core.shape import Family, MeshFile, ProbeShape, Rod, extent
from vsfsim.core.shelf import family
from vsfsim.core.solid import Solid
from vsfsim.physics.contact import sdf
from vsfsim.physics.contact.law import contact_law_of
from vsfsim.physics.laws import hyperfoam, neo_hooke
from vsfsim.physics.laws.catalogue import law_of
from vsfsim.physics.mesh.account import scan_foot
from vsfsim.physics.mesh.discretise import beside_supports, build_solid
from vsfsim.physics.mesh.edge_refine import MOST_TETS, EdgePath, refine_near
from vsfsim.physics.mesh.inclusions import held_stiffness, mixed_modulus, part_notes, snap_to_inclusions
from vsfsim.physics.mesh.quadratic import gauss_points
from vsfsim.physics.model import Model, build_model, regional_tetrahedra, tetrahedra
from vsfsim.physics.solve.frames import SolverOptions


@dataclass(frozen=True)
class Tier:
    """One fidelity tier."""

    nonlinear: bool
    """Newton's method, or the linear response of the rest state."""
    body: float
    """Element size over the body's size, the cube root of its bounding box, see `body_limit` [-]."""
    probe: float
    """Element size over the probe's radius [-]."""
    family: float
    """Element size of a procedural family [m]."""
    tolerance: float
    """Of the equilibrium, see `SolverOptions` [-]."""
    indentation_by_place: bool = False
    """See `SolverOptions`. Off where datasets have been released: their bits would change."""


TIERS: dict[str, Tier] = {
    "linear": Tier(False, 1 / 8, 1 / 2, 0.017, 1e-4),
    "fem-coarse": Tier(True, 1 / 8, 1 / 2, 0.017, 1e-3),
    "fem": Tier(True, 1 / 13, 1 / 3, 0.014, 5e-4, indentation_by_place=True),
    "fem-fine": Tier(True, 1 / 16, 1 / 4.5, 0.011, 1e-4, indentation_by_place=True),
}
THIN_CELLS = 1500
"""Most cells of a thin body: a sheet of 0.3 x 0.2 x 0.001 m would need two layers of 60,000 cubes, and has 47 cells
along its length with this many, which its bending resolves."""
# the cheapest tier that shows each need
_SHOWS = {"appearance": "linear", "contact": "linear", "coupling": "linear", "normal-force": "linear",
          "bulging": "fem-coarse", "large-deformation": "fem"}
FOLLOWS = _SHOWS["large-deformation"]
"""The tier of a scene whose elements turn further than small strain follows."""
_LAW = "fem-coarse"  # the cheapest tier with a material's law at large strain
_DEFAULT = "linear"  # of a scene that names no need: the cheapest tier with a trustworthy force


def choose(scene: Scene, asked: str | None = None) -> str:
    """The tier of a scene: the one asked for if it shows what the scene needs; for ``auto``, the cheapest that does.

    Args:
        scene: the scene, with its ``needs`` and ``[object] tier``.
        asked: a tier that overrides the scene's.

    Raises:
        SceneError: the tier asked for is unknown, or cannot show what the scene needs or is made of.
    """
    order = list(TIERS)
    own_law = law_of(scene) is not None
    contact_law_of(scene)
    enough = max((_SHOWS[need] for need in scene.needs), key=order.index, default=_DEFAULT)
    tier = asked or scene.object.tier
    if tier == "auto" and isinstance(scene.object.shape, MeshFile) and "needs" not in scene.given:
        # the default press of a scan goes past small strain
        return max("fem", enough, key=order.index)
    if tier == "auto":
        return max(_LAW, enough, key=order.index) if own_law else enough
    if tier not in TIERS:
        raise SceneError(f"{scene.source} [object]: unknown tier '{tier}'. {did_you_mean(tier, (*TIERS, 'auto'))}")
    if scene.needs and order.index(tier) < order.index(enough):
        needs = ", ".join(need for need in scene.needs if order.index(_SHOWS[need]) > order.index(tier))
        raise SceneError(f"{scene.source}: the scene needs {needs}, which tier '{tier}' cannot show; use "
                         f"'{enough}' or above.")
    return tier


def leaves(scene: Scene, asked: str | None, tier: str, past: np.ndarray) -> bool:
    """Whether a press whose frames are ``past`` small strain (T,) bool leaves a ``tier`` of small strain that neither
    the caller, who ``asked`` for one, nor the scene names."""
    free = asked in (None, "auto") and scene.object.tier == "auto"
    return free and not TIERS[tier].nonlinear and bool(past.any())


def elements(scene: Scene, tier: str) -> list[tuple[str, str]]:
    """Kinds and laws of the elements that the objects of a scene may have at a tier, as `block.elements_of`: their
    kernels are compiled before there is a model. A family names its materials' laws in ``LAWS``."""
    own, spec = TIERS[tier], scene.object
    laws = [neo_hooke.LAW.name]
    if own.nonlinear and isinstance(spec.shape, Family):
        parts = getattr(family(spec.shape.name, f"{scene.source} [object] shape"), "LAWS", ())
        laws += [hyperfoam.LAW.name] * any(law.foam is not None for law in parts)
    elif own.nonlinear:
        found = law_of(scene)
        laws = laws if found is None else [found[0].name]
    return [("tet10", law) for law in laws]


def element_size(spec: ObjectSpec, tier: str, probe: ProbeShape) -> float:
    """Target edge length [m]: the scene's own resolution, else the tier's."""
    if spec.resolution is not None:
        return spec.resolution
    own = TIERS[tier]
    if isinstance(spec.shape, Family):
        return own.family
    tip = own.probe * 1.5 * min(sdf.reach(probe), 1e3)
    if isinstance(spec.shape, Rod):
        # along a slender bar the fields change slowly: quadratic elements about as long as its radius
        return min(10.0 * own.body * spec.shape.radius, tip)
    if isinstance(spec.shape, MeshFile):
        # repair imports trimesh, which a box does not need
        from vsfsim.physics.mesh.repair import read_surface

        size = read_surface(spec.shape).extents
    else:
        size = np.array(extent(spec.shape))
    return min(body_limit(size, own.body), tip, thin_limit(size))


def body_limit(size: np.ndarray, part: float) -> float:
    """Element [m] of which ``part`` ** -3 cells fill the bounding box of edges ``size`` (3,) [m]: cubes, or two layers
    of a thin body."""
    face = np.sort(size)[1:]
    return max(part * float(np.prod(size)) ** (1 / 3), part**1.5 * float(2.0 * np.prod(face)) ** 0.5)


def thin_limit(size: np.ndarray) -> float:
    """Longest element of a thin body [m]: as long as the body is thick, unless that takes more than `THIN_CELLS` cells.

    A quadratic element holds a constant curvature exactly; what is lost is its change over an element's length. A
    clamped plate of 60 x 40 x 2 mm loses 1.2 % of its deflection at nu = 0.45 with elements as long as it is thick, 0.1
    % at nu = 0.3.

    Args:
        size: edges of the bounding box (3,) [m].
    """
    thickness, *face = np.sort(size)
    return max(float(thickness), float(np.prod(face) / THIN_CELLS) ** 0.5)


def options(tier: str) -> SolverOptions:
    """Solver limits of a tier."""
    own = TIERS[tier]
    return SolverOptions(tolerance=own.tolerance, local_indentation=True,
                         indentation_by_place=own.indentation_by_place)


def placement(spec: ObjectSpec) -> tuple[np.ndarray, np.ndarray]:
    """Rotation (3, 3) and translation (3,) [m] of the object's frame in the world."""
    c, s = np.cos(spec.yaw), np.sin(spec.yaw)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]), np.array(spec.pose)


def body(scene: Scene, tier: str, *, seed: int | np.random.SeedSequence = 0, focus: np.ndarray | None = None,
         edges: EdgePath | None = None) -> tuple[Solid, np.ndarray]:
    """The object of a scene at a tier, in its own frame, and Young's modulus at its Gauss points (m, 4) [Pa].

    Args:
        scene: the scene, without random values.
        tier: the tier, from `choose`.
        seed: of what a family draws (materials, appearance).
        focus: points near which a box is meshed finely (k, 3) [m], world.
        edges: the way of the probe's edges, world, along which elements of a solid are small, see `edge_refine`.

    Raises:
        SceneError, MeshError: the object cannot be built.
    """
    spec = scene.object
    field, (turn, shift) = spec.young_modulus, placement(spec)
    boxes = [np.sort(np.reshape(part.numbers, (2, 3)), axis=0) for part in field.inclusions if part.kind == "box"]
    size = element_size(spec, tier, scene.probe)
    made = functools.partial(build_solid, spec, resolution=size, rng=np.random.default_rng(seed),
                             focus=None if focus is None else (np.asarray(focus) - shift) @ turn)
    solid = made(parts=np.array(boxes) if boxes else None)
    if not isinstance(spec.fixed, str) and len(beside := beside_supports(spec, solid.vertices, size)):
        held = made(parts=np.array([*boxes, *beside]))
        fits = len(held.tets) <= MOST_TETS[0] * len(solid.tets) + MOST_TETS[1]
        # too many planes cost a block all of them, also those of its parts
        solid = held if fits and not len(beside_supports(spec, held.vertices, size)) else solid
    if edges is not None:
        solid = _with_edges(solid, dataclasses.replace(edges, places=(edges.places - shift) @ turn), scene, tier)
    modulus = field.of_regions(solid.young_modulus, f"{scene.source} [object]")
    if not field.inclusions:
        region = np.repeat(np.asarray(solid.region)[:, None], 4, axis=1)
        return solid, field.evaluate(gauss_points(solid), region, modulus)
    solid = snap_to_inclusions(solid, field)
    values = mixed_modulus(solid, field, modulus)
    share = held_stiffness(solid, field, modulus, values)
    solid = dataclasses.replace(solid, notes=(*solid.notes, *part_notes(field, share)),
                                parts=float(np.abs(share - 1.0).max()))
    return solid, np.repeat(values[:, None], 4, axis=1)


def _with_edges(solid: Solid, edges: EdgePath, scene: Scene, tier: str) -> Solid:
    """The solid with small elements where edges (in its own frame) meet it, as part of their body's half-width; smaller
    by as much as the scene's resolution is smaller than the tier's."""
    own = element_size(dataclasses.replace(scene.object, resolution=None), tier, scene.probe)
    finer = min(1.0, element_size(scene.object, tier, scene.probe) / own)
    divided, part = refine_near(solid, edges, TIERS[tier].probe * finer)
    if len(divided.tets) == len(solid.tets):
        return solid
    return dataclasses.replace(divided, notes=(*divided.notes, (
        f"Elements are smaller at the probe's edges and small parts, down to "
        f"{1e3 * part * float(edges.half.min()):.2g} mm.")))


def build(scene: Scene, tier: str, *, seed: int | np.random.SeedSequence = 0, focus: np.ndarray | None = None,
          edges: EdgePath | None = None) -> Model:
    """The model of a scene at a tier, in the world frame; arguments and errors as `body`."""
    return model_of(scene, tier, *body(scene, tier, seed=seed, focus=focus, edges=edges))


def model_of(scene: Scene, tier: str, solid: Solid, values: np.ndarray) -> Model:
    """The model of a body from `body`, or of one with other moduli (m, 4) [Pa] on the same tetrahedra.

    Raises:
        SceneError, MeshError: it cannot be built.
    """
    spec = scene.object
    where = f"{scene.source} [object]"
    turn, shift = placement(spec)
    tolerance = 1e-6 * float(np.ptp(solid.vertices[:, 2]))
    if isinstance(spec.shape, MeshFile) and spec.fixed == "bottom":
        tolerance, note = scan_foot(solid)
        solid = dataclasses.replace(solid, notes=(*solid.notes, note))
    elements, density = tetrahedra, spec.density
    if solid.laws is not None:
        region = np.asarray(solid.region)
        density = np.array([law.density for law in solid.laws])[region]
        elements = functools.partial(regional_tetrahedra, region=region, laws=solid.laws, foams=TIERS[tier].nonlinear)
    law = law_of(scene)
    if law is not None and TIERS[tier].nonlinear and solid.laws is None:
        elements = functools.partial(tetrahedra, law=law[0], settings=law[1])
    elif law is not None:
        solid = dataclasses.replace(solid, notes=(*solid.notes, (
            f"Tier '{tier}' takes the law at small strain, with the modulus at rest; use '{_LAW}' or above for it "
            f"whole.")))
    return build_model(solid, values, poisson_ratio=spec.poisson_ratio, fixed=spec.fixed, bottom_tolerance=tolerance,
                       where=where, density=density, gravity=scene.gravity, rotation=turn, translation=shift,
                       elements=elements)
