"""A body ready for the solver: quadratic mesh, moduli, supports, loads, and the factor that all touches share."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np

from vsfsim.core.errors import SceneError
from vsfsim.core.solid import Law, Solid
from vsfsim.physics.elements import tet10
from vsfsim.physics.elements.block import Block
from vsfsim.physics.elements.tet10_shape import GAUSS, shape_values
from vsfsim.physics.laws import hyperfoam, neo_hooke
from vsfsim.physics.laws.law import Settings, SolidLaw, lame
from vsfsim.physics.linear.rest_factor import RestFactor
from vsfsim.physics.mesh.inclusions import limited
from vsfsim.physics.mesh.quadratic import QuadraticMesh, assemble, quadratic_mesh
from vsfsim.physics.mesh.validity import refuse_loose, sound

Elements = Callable[[QuadraticMesh, np.ndarray, float], tuple[Block, ...]]
MOST_NODES = 200_000
"""Of a body. The factor of a much larger one has more entries than the 32-bit indices of CHOLMOD number, which ends the
process."""



@dataclass(frozen=True)
class Model:
    """One body in the world frame."""

    mesh: QuadraticMesh
    """Quadratic tetrahedra, world frame."""
    blocks: tuple[Block, ...]
    """Its elements."""
    young_modulus: np.ndarray
    """Young's modulus at the Gauss points of the mesh (m, 4) [Pa]."""
    free: np.ndarray
    """1 where a degree of freedom may move (3 n,) [-]."""
    load: np.ndarray
    """Nodal forces of gravity (3 n,) [N]."""
    surface_modulus: np.ndarray
    """Young's modulus under each boundary triangle (f,) [Pa]."""
    solid: Solid
    """The corner tetrahedra that it was made from."""
    element_size: float
    """Cube root of the mean volume of six tetrahedra, a hexahedron's worth [m]."""
    factor: RestFactor = field(repr=False)
    """Rest-state factor, shared by all touches."""
    inside_box: np.ndarray | None = field(default=None, repr=False, kw_only=True)
    """Share of each element, in the order of the blocks, that lies in the box of `fixed` (m,) [-], whether all nodes of
    the element are held or it moves; None without a box."""
    soft_factor: RestFactor | None = field(default=None, repr=False, kw_only=True)
    """That of a nearly incompressible body with a lower bulk stiffness, see `elements.tet10.softened`."""

    @property
    def preconditioner(self) -> RestFactor:
        """The factor for predictions and preconditioning at large deformation."""
        return self.factor if self.soft_factor is None else self.soft_factor

    def least_force(self) -> float:
        """Force [N] under which a force counts as zero: a billionth of the softest modulus on one element face, or a
        millionth of the weight."""
        return max(1e-9 * float(self.young_modulus.min()) * self.element_size**2, 1e-6 * float(np.abs(self.load).sum()))


def held_nodes(points: np.ndarray, fixed: str | tuple[float, ...], tolerance: float) -> np.ndarray:
    """Mask (n,) of the nodes that the supports hold, points (n, 3) [m] in the object's frame.

    Args:
        fixed: "bottom" (within ``tolerance`` [m] of the lowest point), or a box (x0, y0, z0, x1, y1, z1).
    """
    if fixed == "bottom":
        return points[:, 2] <= points[:, 2].min() + tolerance
    low, high = np.minimum(fixed[:3], fixed[3:]), np.maximum(fixed[:3], fixed[3:])
    return ((points >= low - 1e-9) & (points <= high + 1e-9)).all(axis=1)


def tetrahedra(mesh: QuadraticMesh, young_modulus: np.ndarray, poisson_ratio: float, *,
               law: SolidLaw = neo_hooke.LAW, settings: Settings | None = None) -> tuple[Block, ...]:
    """The elements of a solid: quadratic tetrahedra.

    Args:
        mesh: the mesh in the world frame.
        young_modulus: Young's modulus at small strain at the Gauss points (m, 4) [Pa].
        poisson_ratio: nu at small strain, 0 to 0.4999 [-].
        law: of the material, with its rows of numbers ``settings``.

    Raises:
        SceneError: the law cannot be that of such a material.
    """
    mu, lam = lame(young_modulus, poisson_ratio)
    return (tet10.block(mesh.tets, mesh.gradients, mesh.weights, mu, lam, law=law, settings=settings),)


def regional_tetrahedra(mesh: QuadraticMesh, young_modulus: np.ndarray, _: float, *, region: np.ndarray,
                        laws: Sequence[Law], foams: bool) -> tuple[Block, ...]:
    """The elements of a solid whose regions are of different materials: one block of neo-Hookean tetrahedra, and one
    block for each foam.

    Args:
        mesh, young_modulus: as of `tetrahedra`; Poisson's ratio is that of each law.
        region: of each tetrahedron (m,), an index into ``laws``.
        laws: of each region.
        foams: whether foams follow their own law; otherwise they are neo-Hookean with the foam's Poisson's ratio.
    """
    ratio = np.array([law.poisson_ratio if law.foam is None else law.foam.poisson_ratio for law in laws])
    foam_of = [law.foam if foams else None for law in laws]
    blocks = []
    for foam in dict.fromkeys(foam_of):
        at = np.flatnonzero(np.isin(region, [r for r, own in enumerate(foam_of) if own == foam]))
        if len(at):
            shape, e = (mesh.tets[at], mesh.gradients[at], mesh.weights[at]), young_modulus[at]
            own = {} if foam is None else {"law": hyperfoam.LAW, "settings": hyperfoam.settings_of(foam)}
            blocks.append(tet10.block(*shape, *lame(e, ratio[region[at]][:, None]), **own))
    return tuple(blocks)


def gravity_load(mesh: QuadraticMesh, density: float | np.ndarray, gravity: np.ndarray) -> np.ndarray:
    """Consistent nodal weight (3 n,) [N]: with straight sides -1/20 of a tetrahedron's weight on each corner, 1/5 on
    each edge node.

    Args:
        mesh: the mesh.
        density: of the body, or of each tetrahedron (m,) [kg/m^3].
        gravity: (3,) [m/s^2].
    """
    nodal = np.zeros(len(mesh.points))
    np.add.at(nodal, mesh.tets, np.reshape(density, (-1, 1)) * mesh.weights @ shape_values(GAUSS))
    return (nodal[:, None] * np.asarray(gravity, float)).ravel()


def build_model(solid: Solid, young_modulus: np.ndarray, *, poisson_ratio: float, fixed: str | tuple[float, ...],
                bottom_tolerance: float, where: str, density: float | np.ndarray = 1000.0,
                gravity: tuple[float, ...] = (0.0, 0.0, 0.0),
                rotation: np.ndarray | None = None, translation: np.ndarray | None = None,
                elements: Elements = tetrahedra) -> Model:
    """Place a solid in the world and hold it. Its rest state is factorised at its first use, so that what is refused
    of a body or a press costs no factor.

    Args:
        solid: corner tetrahedra in the object's frame.
        young_modulus: E at the Gauss points of its quadratic mesh (m, 4) [Pa].
        poisson_ratio: nu [-].
        fixed, bottom_tolerance: see `held_nodes`.
        where: scene and section, for messages.
        density: of the body, or of each tetrahedron (m,) [kg/m^3].
        gravity: (3,) [m/s^2], world.
        rotation, translation: object to world (3, 3) [-] and (3,) [m].
        elements: makes the blocks of elements of the placed mesh, from (mesh, young_modulus, poisson_ratio).

    Raises:
        SceneError: the mesh has too many nodes, or the supports hold none, hold nodes on a line at most, or leave a
            part of the body loose.
        MeshError: the tetrahedra are flat, folded or not finite, see `sound`.
    """
    solid, turned = sound(solid, where)
    if turned.any():
        # an inverted tetrahedron had its first two corners swapped, and each Gauss point is near a corner
        young_modulus = np.where(turned[:, None], young_modulus[:, [1, 0, 2, 3]], young_modulus)
    mesh = quadratic_mesh(solid)
    if len(mesh.points) > MOST_NODES:
        raise SceneError(f"{where}: the mesh has {len(mesh.points):,} nodes, and {MOST_NODES:,} are the most whose "
                         f"stiffness can be factorised. Give a larger resolution, a coarser tier, or a smaller body.")
    if fixed == "none":
        raise SceneError(f"{where}: fixed = \"none\" leaves the body floating, and a quasi-static press then has no "
                         "single equilibrium; hold it with fixed = \"bottom\" or a box [x0, y0, z0, x1, y1, z1].")
    held = held_nodes(mesh.points, fixed, bottom_tolerance)
    refuse_loose(mesh.points, mesh.tets, held, f"{where}: fixed = {fixed!r}")
    turn = np.eye(3) if rotation is None else rotation
    shift = np.zeros(3) if translation is None else np.asarray(translation, float)
    placed = QuadraticMesh(mesh.points @ turn.T + shift, mesh.tets, mesh.gradients @ turn.T, mesh.weights, mesh.faces,
                           mesh.owner)
    free = np.repeat(np.where(held, 0.0, 1.0), 3)
    acting, lowered = limited(placed, young_modulus)
    if lowered > 1.0:
        solid = dataclasses.replace(solid, notes=(*solid.notes, (
            f"A part inside is so stiff that it only moves and turns. It acts with a modulus {lowered:.2g} times "
            f"smaller, which lowers the force by 0.2 % at most.")))
    try:
        blocks = elements(placed, acting, poisson_ratio)
    except SceneError as error:
        raise SceneError(f"{where}: {error}") from error
    inside = None if isinstance(fixed, str) else np.concatenate([
        np.mean([held_nodes(at @ mesh.points[block.nodes[:, :4]], fixed, 0.0) for at in GAUSS], axis=0)
        for block in blocks])
    factor = functools.partial(RestFactor.of, free=free, points=placed.points)
    softer = tuple(block.softened() for block in blocks)
    compressible = all(a is b for a, b in zip(softer, blocks, strict=True))
    soft = None if compressible else factor(assemble(len(placed.points), softer))
    size = float((6.0 * placed.volume.mean()) ** (1.0 / 3.0))
    return Model(placed, blocks, young_modulus, free, gravity_load(placed, density, np.asarray(gravity)),
                 young_modulus[placed.owner].mean(axis=1), solid, size,
                 factor(assemble(len(placed.points), blocks)), inside_box=inside, soft_factor=soft)
