"""Quadratic tetrahedron of a solid under any law of `vsfsim.physics.laws`. At a high Poisson's ratio most of the bulk
stiffness acts on the element's mean volume; under the neo-Hookean law

    Psi(F) = mu/2 (|F|^2 - 3) - mu f(J) + lambda_p/2 (J - 1)^2 + lambda_m/2 (Jbar - 1)^2,      J = det F
    f(J) = ln J for J >= 0.1, and below it the Taylor polynomial of second order of ln J about 0.1.

At a high Poisson's ratio an element with J at four Gauss points has nearly as many constraints as degrees of freedom,
and locks. With the element's mean Jbar alone (Nagtegaal, Parks and Rice 1974; Simo, Taylor and Pister 1985: one
pressure per element) it is too soft. Lambda is therefore divided: lambda_p = min(lambda, `POINTWISE` mu) acts at the
Gauss points, and lambda_m, the harmonic mean of the remainder, acts on Jbar. The division has no threshold in nu, and
up to nu = 0.4 lambda_m is zero. The table gives the normal force on the block of scenes/indent-homogeneous.toml at 5 mm
depth (tier `fem`, 5,040 tetrahedra) against 384 hexahedra with 27 nodes and linear pressure, both under the law of
Smith, de Goes and Kim (2018), from which this one differs by less than 1 % there. The hexahedra measure 3.5 mm at the
contact of a quarter block; at nu 0.45 their force is within 0.1 % of the extrapolated 9.67 N of references/s1.json, and
at nu 0.499 they were not refined further.

    all at the points / divided / all on the mean:   nu 0.45   9.72 / 9.68 / 9.52 N   against  9.68 N
                                                     nu 0.499  10.31 / 10.18 / 10.02 N  against 10.17 N

lambda_m adds a pressure to c of the law (see `laws/neo_hooke.py`), and one term of rank one per element to the tangent.
F is recomputed for every product. What the law stores at the Gauss points and the gradient of Jbar are stored.

The element has ten nodes (corners 0-3, then the edges of `tet10_shape.EDGES`) and four Gauss points, each with moduli
and, where sides are curved, a Jacobian of its own. Vectors are (3 n, B), degree of freedom by touch; node i has rows
3 i, 3 i + 1, 3 i + 2.
"""

import functools
from dataclasses import replace
from typing import Any

import numpy as np
import warp as wp

from vsfsim.physics.elements import deformation, tet10_shape
from vsfsim.physics.elements.block import Block, element_kernels, struct_of
from vsfsim.physics.elements.tet10_shape import shape_gradients
from vsfsim.physics.laws import neo_hooke
from vsfsim.physics.laws.catalogue import LAWS
from vsfsim.physics.laws.law import Settings, SolidLaw
from vsfsim.physics.runtime import mat33, real

POINTWISE = 4.0
"""Largest lambda at the Gauss points, in units of mu; 4 is all of lambda up to nu = 0.4."""
# lambda_m over mu from which `softened` lowers it, to this share of it and this multiple of mu at most
_NEARLY_INCOMPRESSIBLE, _SOFT_SHARE, _SOFT_BULK = 60.0, 0.5, 120.0


def block(nodes: np.ndarray, gradients: np.ndarray, weights: np.ndarray, mu: np.ndarray, lam: np.ndarray, *,
          law: SolidLaw = neo_hooke.LAW, settings: Settings | None = None, pointwise: float = POINTWISE) -> Block:
    """A block of quadratic tetrahedra.

    Args:
        nodes: (m, 10), corners then edges.
        gradients: of the last three barycentric coordinates at the Gauss points (m, 4, 3, 3) [1/m].
        weights: volume of each Gauss point (m, 4) [m^3].
        mu: Lamé's second constant at small strain at the Gauss points (m, 4) [Pa].
        lam: Lamé's first constant there (m, 4) [Pa].
        law: of the material.
        settings: its rows of numbers.
        pointwise: largest lambda that acts at the Gauss points, in units of mu, of a law that takes a pressure.

    Raises:
        SceneError: the law cannot be that of such a material.
    """
    local = np.minimum(lam, pointwise * mu) if law.pressed else lam
    over = np.where(lam - local > 1e-9 * lam, lam - local, 0.0)  # below 1e-9 it is rounding error
    mean = np.where((over > 0.0).all(axis=1), 4.0 / (1.0 / np.maximum(over, 1e-300)).sum(axis=1), 0.0)
    own, terms = law.parameters(mu, local, settings or {})
    return Block("tet10", np.asarray(nodes, np.int32), {
        "gradients": gradients, "weights": weights, "mu": mu, "lam": local, "mean_lam": mean, "own": own,
        "terms": terms}, law=law.name)


def state_size(block: Block) -> int:
    """A tangent stores what the law does at the four Gauss points and, where lambda_m acts, the gradient of Jbar
    (30)."""
    return 4 * LAWS[block.law].stored + (30 if block.parameters["mean_lam"].any() else 0)


def softened(block: Block) -> Block:
    """The block with a lower bulk stiffness where it is nearly incompressible (nu above 0.492), to precondition with.

    In a body that is strained by e, which volumes change under a displacement differs from that at rest by the order of
    e. A preconditioner with the whole lambda is then wrong by a factor of 1 + (lambda/mu) e^2, both ways. With a lower
    lambda it is too soft for volumes, which costs fewer iterations: without other factors S1 at nu = 0.499 takes 128
    conjugate gradients in its last frame with the whole of it and 45 with 30 mu, at nu = 0.4999 more than 1,500 and 83.
    """
    p = block.parameters
    mu = p["mu"].mean(axis=1)
    lower = np.minimum(_SOFT_SHARE * p["mean_lam"], _SOFT_BULK * mu)
    soft = np.where(p["mean_lam"] > _NEARLY_INCOMPRESSIBLE * mu, lower, p["mean_lam"])
    return block if np.array_equal(soft, p["mean_lam"]) else replace(block, parameters={**p, "mean_lam": soft})


def rest_stiffness(block: Block) -> np.ndarray:
    """Element stiffness at rest, that of linear elasticity (m, 30, 30) [N/m], rows node by node."""
    p, size = block.parameters, (len(block), 10, 3, 10, 3)
    weight = p["weights"]
    each = shape_gradients(p["gradients"]).reshape(len(block), 4, 30)
    lam, mu = (np.matmul(((weight * p[name])[:, :, None] * each).mT, each).reshape(size) for name in ("lam", "mu"))
    out = lam + mu.transpose(0, 1, 4, 3, 2)
    dots = np.trace(mu, axis1=2, axis2=4)
    for c in range(3):
        out[:, :, c, :, c] += dots
    if p["mean_lam"].any():
        mean = np.einsum("mq,mqk->mk", weight, each)
        stiff = (p["mean_lam"] / weight.sum(axis=1))[:, None] * mean
        out += (stiff[:, :, None] * mean[:, None]).reshape(size)
    return out.reshape(len(block), 30, 30)


@functools.cache
def kernels(law: str) -> Any:
    """The kernels of this element under the law of this name."""
    mat43 = wp.types.matrix(shape=(4, 3), dtype=real)
    mat103 = wp.types.matrix(shape=(10, 3), dtype=real)
    module = f"vsfsim_tet10_{law}"

    shape = tet10_shape.functions(module)
    edge_sums, gradient, stresses, spread, finish = (
        shape.edge_sums, shape.gradient, shape.stresses, shape.spread, shape.finish)
    kinematics = deformation.functions(module)
    deform, cofactor, volume_change = kinematics.gradient, kinematics.cofactor, kinematics.volume_change
    point = LAWS[law].functions(module)
    respond_at, linearise_at, product = point.respond, point.linearise, point.multiply
    mean_at = wp.constant(4 * LAWS[law].stored)  # first row of the gradient of Jbar
    arguments = struct_of(module, gradients=wp.array2d(dtype=mat33), weights=wp.array2d(dtype=real),
                          mean_lam=wp.array(dtype=real), own=wp.array3d(dtype=real), terms=wp.array2d(dtype=real))

    @wp.func(module=module)
    def pressure(of: arguments, x: mat103, s: mat43, t: int):
        # lambda_m (Jbar - 1), and the volume
        total = real(0.0)
        volume = real(0.0)
        for q in range(4):
            trace, rest = volume_change(gradient(x, s, of.gradients[t, q], q))
            total += of.weights[t, q] * (trace + rest)
            volume += of.weights[t, q]
        return of.mean_lam[t] * total / volume, volume

    @wp.func(module=module)
    def respond(of: arguments, x: mat103, t: int):
        s = edge_sums(x)
        push = real(0.0)
        energy = real(0.0)
        if of.mean_lam[t] > real(0.0):
            mean, volume = pressure(of, x, s, t)
            push = mean
            energy = real(0.5) * volume * push * push / of.mean_lam[t]
        lowest = real(1e30)
        force = mat103()
        total = mat43()
        for q in range(4):
            g = of.gradients[t, q]
            weight = of.weights[t, q]
            value, det, p = respond_at(gradient(x, s, g, q), of.own, of.terms, t, q, push)
            energy += weight * value
            lowest = wp.min(lowest, det)
            stress = stresses(weight * p, g)
            total += stress
            force = spread(force, stress, q)
        return finish(force, total), energy, lowest

    @wp.func(module=module)
    def linearise(of: arguments, x: mat103, t: int, b: int, projected: int, state_out: wp.array3d(dtype=real)):
        # what the law stores at each Gauss point, then the gradient of Jbar times the volume
        s = edge_sums(x)
        push = real(0.0)
        mean = of.mean_lam[t] > real(0.0)
        if mean:
            value, _ = pressure(of, x, s, t)
            push = value
        force = mat103()
        total = mat43()
        for q in range(4):
            g = of.gradients[t, q]
            d = gradient(x, s, g, q)
            linearise_at(d, of.own, of.terms, t, q, b, push, projected, state_out)
            if mean:
                stress = stresses(of.weights[t, q] * cofactor(deform(d)), g)
                total += stress
                force = spread(force, stress, q)
        if mean:
            force = finish(force, total)
            for a in range(10):
                for i in range(3):
                    state_out[t, mean_at + 3 * a + i, b] = force[a, i]

    @wp.func(module=module)
    def multiply(of: arguments, u: mat103, x: mat103, t: int, b: int, state_in: wp.array3d(dtype=real)):
        us = edge_sums(u)
        xs = edge_sums(x)
        force = mat103()
        total = mat43()
        volume = real(0.0)
        for q in range(4):
            g = of.gradients[t, q]
            weight = of.weights[t, q]
            volume += weight
            p = weight * product(gradient(u, us, g, q), gradient(x, xs, g, q), of.own, t, q, b, state_in)
            stress = stresses(p, g)
            total += stress
            force = spread(force, stress, q)
        force = finish(force, total)
        if of.mean_lam[t] > real(0.0):
            along = real(0.0)
            for a in range(10):
                for c in range(3):
                    along += state_in[t, mean_at + 3 * a + c, b] * x[a, c]
            along = along * of.mean_lam[t] / volume
            for a in range(10):
                for c in range(3):
                    force[a, c] += along * state_in[t, mean_at + 3 * a + c, b]
        return force

    return element_kernels(module, arguments, 10, respond=respond, multiply=multiply, linearise=linearise)
