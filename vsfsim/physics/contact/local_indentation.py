"""The indentation under a round body that a mesh is too coarse for, as a compliance of the contact points.

Under a contact of radius a a solid sinks in by about p a / E* more than the displacements of elements of size h can
show, where a is not far larger than h. Without it a press of 0.5 mm by a ball of 20 mm is 30 to 70 % too stiff on
elements of 10 mm, and the error depends on where in an element it touches. The part that is missing is local, so that
a compliance in series with the penalty restores it:

    u_local = c p,   c = C (1 - nu^2) h^2 / (a E) / (1 + RESOLVED (a / h)^3),   c E / h <= MOST

C is fitted once, to the compliance that a mesh of S1's block lacks against a fine one, see
`tests/verification/test_shallow.py`; with h -> 0 the compliance vanishes as the error of quadratic elements does. a is
the contact radius of the rigid geometry, (area of the rest surface inside the body / 2 pi)^(1/2), which is (R d)^(1/2)
for a ball of radius R at a depth d (Hertz). It depends on the pose alone, so that a frame has a potential and unloading
retraces loading. Past `SATURATED` of an element the contact is as stiff as elsewhere: there the mesh resolves it.

This is the mean of places in an element. Where the contact is much smaller than the element its place decides, and
what is missing is taken from the object itself (``by_place``), see `MissingCompliance`.
"""

from __future__ import annotations

import functools

import numpy as np
import torch

from vsfsim.physics.contact.bodies import RigidBodies
from vsfsim.physics.contact.patch import (
    PENALTY,
    POINTS,
    WEIGHTS,
    nodal_sums,
    poisson_ratio,
    shape_values,
    smooth_radius,
)
from vsfsim.physics.linear.rest_factor import Response
from vsfsim.physics.model import Model

FITTED = 0.044
"""C: the compliance times a E / ((1 - nu^2) h^2) where a is much smaller than h [-]."""
RESOLVED = 0.42
"""How fast the compliance falls where elements of size h resolve the contact radius a [-]: by 30 % at a = h. With 0,
the forces of S1 and S2 at 5 mm are too small by 0.8 and 2.1 %."""
MOST = 0.12
"""Largest compliance times E / h [-]: a load on a spot much smaller than an element sinks in by p a / E* alone."""
SATURATED = 0.022
"""Local indentation, over the element size, that is not exceeded [-]."""
RESOLVED_BY_PLACE, SATURATED_BY_PLACE = 0.7, 0.06
"""The same where the compliance is that of the place of the touch."""
OWN = 0.5
"""a / h up to which the place decides, and its own compliance counts more than the mean of places [-]."""

GROWN = 1.1
"""Factor on the contact radius by which the compliance is differentiated for its energy [-]."""
_SMALL = 0.1  # the same over the radius of the smallest round body
_FOOT = 0.2  # least radius of a footprint over the element size: a mesh feels no difference to a smaller one
_WIDE = 2.0  # radius, over the element size, of a footprint under which a mesh lacks nothing
_SOFTER = 0.8  # how much less than under the pressure of Hertz a mesh lacks, over (a / h)^2
# wide compliance over that of the half-space, and the part of the wide footprint that lies on the object, from and to
# which the place counts: ramps between the first two and the last two
_LIKE_HALF_SPACE, _COVERED = (0.25, 0.4, 1.6, 2.5), (0.6, 0.75, 1.2, 1.4)
# a contact with half-widths a < b is resolved as well as a circle of its area with (a / b)^(1/2) to this power of the
# radius: elements have to resolve a, but under an ellipse of Hertz the way is, at the same pressure and a, K(e) / K(0)
# times that under a circle, which is (b / a)^0.4 within 4 % up to b = 10 a (Johnson, section 4.2)
# Few points look oval by chance: 3 to 10 points of round contacts on blocks and shoes show ((b^2 - a^2) / (a^2 +
# b^2))^2 of 0.36 over their number in the mean, 0.11 to 0.56 by number. A little more is subtracted, for what scatters
# above it counts and what scatters below does not
_OVAL, _CHANCE = 0.6, 0.5
# of 25 frames under a ball of 40 mm on layers that lie on a body ten or thirty times as hard, 4 without a mark were
# further off than told with 0, none with 0.25 to 1; from 0.5 on more of them are marked
_STIFFER = 0.4
_ACROSS = 0.5  # least cosine between a face's normal and that of the contact
_CHUNK = 16  # touches whose wide footprints are made at once


class LocalIndentation:
    """The compliance of the contact points of B touches.

    Args:
        model: the object.
        parts: those of the contact points (B, f) of `patch.PART`.
        bodies: the rigid bodies (K).
        points: contact points at rest (B, 6 f, 3) [m].
        law: share of the stiffness of each (B, f, 6) [-] that acts down to a depth (B, f) [m], which are set here for
            points of faces; points of bodies have a law of their own, see `body_points`.
        on: whether there is any such compliance.
        response: of the body at rest to forces, where what the object lacks at the place of the touch is asked of it;
            None for the mean of places.
    """

    def __init__(self, model: Model, parts: np.ndarray, bodies: RigidBodies, points: torch.Tensor,
                 law: tuple[torch.Tensor, torch.Tensor], *, on: bool, response: Response | None = None):
        nu, radii, faces = poisson_ratio(model), [smooth_radius(s) for s in bodies.shapes], model.mesh.faces
        curvature = model.mesh.curvature() if faces.shape[1] == 6 else np.zeros(len(faces))
        self._round = [0.0 < r < np.inf or bool(r and curvature.any()) for r in radii]
        self._on = on and nu is not None and any(self._round)
        self._bodies, self._factor = bodies, FITTED * (1.0 - (nu or 0.0) ** 2)
        self._points = points.transpose(0, 1).contiguous()
        face = np.where(parts["key"] < len(faces), parts["key"], -1)
        edge = np.append(np.sqrt(2.0 * model.mesh.face_area()), 0.0)[face]
        # area, curvature and E of each point; edge of the elements at each part, 0 at padding and points of bodies
        self._cover, self._bent, self._modulus, self._edge, self._of_body = (
            torch.as_tensor(a, device=points.device) for a in (
                (parts["area"][:, :, None] * WEIGHTS).reshape(len(face), -1),
                np.append(curvature, 0.0)[face].repeat(6, axis=1),
                model.surface_modulus[face].repeat(6, axis=1), edge, parts["host"] >= 0))
        self._curved = torch.tensor([1.0 / max(r, 1e-15) for r in radii], dtype=torch.float64, device=points.device)
        self._deepest = _SMALL * min((r for r in radii if r > 0.0), default=0.0)
        self._share, self._soft = law
        self._set(torch.ones_like(self._share), (SATURATED * self._edge).clamp(max=self._deepest))
        # work done on it over its energy, of each point; None for 2/3
        self._work: torch.Tensor | None = None
        self._missing = None if response is None else MissingCompliance(
            model, response, parts, face, self._cover, self._edge, self._modulus, points)

    def _set(self, share: torch.Tensor, soft: torch.Tensor) -> None:
        """Set the share of the stiffness (B, f, 6) [-] of points of faces that acts down to the depth ``soft`` (B, f)
        [m]."""
        self._share.copy_(torch.where(self._of_body[:, :, None], self._share, share))
        self._soft.copy_(torch.where(self._of_body, self._soft, soft))

    def move(self, pose: np.ndarray) -> None:
        """Set the compliance for the bodies at poses (B, K, 4, 4)."""
        if not self._on:
            return
        least, radius = torch.full_like(self._cover.T, torch.inf), torch.full_like(self._cover.T, torch.inf)
        # compliance and weight, at two radii
        own_place = self._cover.new_zeros((2, 2, *self._cover.shape))
        for k, is_round in enumerate(self._round):
            gap = self._bodies.nearest(pose[None], self._points, body=k)
            nearer = gap < least
            inside = (self._cover.T * (gap < 0.0)).sum(dim=0)
            own = (inside / (2.0 * np.pi)).sqrt() if is_round else torch.full_like(inside, torch.inf)
            radius = torch.where(nearer, own, radius)
            if self._missing is not None:
                of_body = self._missing.under(gap.T) if is_round else own_place.new_zeros((2, 2, len(self._cover)))
                own_place = torch.where(nearer.T, of_body[..., None], own_place)
            least = torch.minimum(gap, least)
        # c E / h; a padded face has no edge and no stiffness
        radius, edge = radius.T.reshape(self._share.shape).clamp(min=1e-12), self._edge[:, :, None].clamp(min=1e-12)
        compliance, soft = self._mean(radius / edge), self._soft
        if self._missing is not None:
            found, weight = own_place.view(2, 2, *self._share.shape)
            mean = torch.stack([compliance, self._mean(GROWN * radius / edge)])
            compliance, larger = mean + weight * (found / edge - mean)
            power = ((larger / compliance.clamp(min=1e-9)).clamp(min=1e-9).log() / np.log(GROWN)).clamp(-1.0, 2.0)
            deep = SATURATED + (SATURATED_BY_PLACE - SATURATED) * weight[0].amax(dim=2)
            soft = (deep * self._edge).clamp(max=self._deepest)
            self._work = torch.where(compliance > 1e-9, (4.0 + 2.0 * power) / (4.0 + power), 1.0)
        # w_q = PENALTY E area / (h / sqrt(2)), in series with area / c
        self._set(1.0 / (1.0 + np.sqrt(2.0) * PENALTY * compliance), soft)

    def _mean(self, wide: torch.Tensor) -> torch.Tensor:
        """The compliance times E / h, the mean of places, where the contact radius over h is ``wide``."""
        resolved = RESOLVED if self._missing is None else RESOLVED_BY_PLACE
        return (self._factor / wide / (1.0 + resolved * wide**3)).clamp(max=MOST)

    def energy(self, gap: torch.Tensor, stiffness: torch.Tensor, columns: torch.Tensor) -> torch.Tensor:
        """Elastic energy of the local indentation of the touches ``columns`` (k,) [J], from the gaps (k, 6 f) [m] and
        the stiffness without it (k, f, 6) [N/m] of their points.

        In a press the compliance falls as d^(-1/2) while the energy at fixed compliance rises as d^(3/2), so that 2/3
        of the latter is the work that was done on it. Where the compliance is that of the place and goes as a^n, that
        is (4 + 2 n) / (4 + n); where it falls faster than as 1 / a the mesh takes over, and 2/3 stay. Parts with a law
        of their own are not counted.
        """
        share, soft = self._share[columns], self._soft[columns][:, :, None]
        depth = torch.minimum((-gap).clamp(min=0.0).view_as(share), soft)
        force = share * stiffness * depth
        round_ = (self._edge[columns] > 0.0)[:, :, None]
        work = 2.0 / 3.0 if self._work is None else self._work[columns]
        return (work * (0.5 * force * depth * (1.0 - share) * round_)).flatten(1).sum(dim=1)

    def resolution(self, gap: torch.Tensor, gone: torch.Tensor, held: torch.Tensor,
                   force: torch.Tensor, columns: torch.Tensor) -> tuple[torch.Tensor, ...]:
        """How well the contact of the touches ``columns`` (k,) is resolved, and how much of it is local.

        The local share is that of twice Hertz's a^2 / R, of the contact's radius a, in how far the surface went with
        the body, 1 / R being the sum of the curvatures of body and object. A half-space gives way locally alone. A wall
        that bends goes with the body, and its local indentation, which a coarse mesh has wrong, is a small part of the
        way. The share is 1 where neither is round.

        On a body that is stiffer below, a layer on a harder one say, the same way takes more pressure, and what the
        compliance is off by weighs more: the share grows with the power `_STIFFER` of the force over that of a flat
        punch of the contact's radius on a half-space of the modulus at the surface, 2 E* a way, where it is larger.

        Args:
            gap: of the points (k, 6 f) [m].
            gone: how far each went along the body's normal (k, 6 f) [m].
            held: 1 at the points that are nearest to each body, 0 elsewhere (k, 6 f, K).
            force: on each body (k, K, 3) [N].
            columns: see above.

        Returns:
            Number of the points that touch (k,); the radius of a circle of their area over the edge of the elements
            there (k,) [-]; that of the circle that is resolved as well as the contact with each body (k, K) [-], see
            `_OVAL`; and the share of each body's way into the object that is local indentation (k, K) [-], above 1
            where the object is stiffer below.
        """
        touching = gap < 0.0
        held = held * touching[:, :, None]
        area = self._cover[columns][:, :, None] * torch.cat([touching[:, :, None], held], dim=2)
        whole = area.sum(dim=1)
        edge = (area * self._edge[columns].repeat_interleave(6, dim=1)[:, :, None]).sum(dim=1)
        # edge is the sum of area x edge: sqrt(A / pi) / (edge / A)
        radius = whole.sqrt() * whole / (np.sqrt(np.pi) * edge.clamp(min=1e-300))
        # an ellipse of the contact's area and largest second moment: tanh(log(b / a)) is (b^2 - a^2) / (a^2 + b^2)
        part, x = area / whole.clamp(min=1e-300)[:, None], self._points.transpose(0, 1)[columns]
        away = x[:, :, None] - (part.mT @ x)[:, None]
        long = torch.linalg.eigvalsh(torch.einsum("kpb,kpbi,kpbj->kbij", part, away, away))[..., 2]
        flat = (whole / (4.0 * np.pi * long).clamp(min=1e-300)).clamp(max=1.0).log().tanh()
        sure = (flat**2 - _CHANCE * (part**2).sum(dim=1)).clamp(min=0.0).sqrt()
        oval = (-0.5 * _OVAL * sure.atanh()).exp()
        oval[:, 1:][:, [not r for r in self._round]] = 1.0
        way = ((gone - gap)[:, :, None] * held).amax(dim=1).clamp(min=1e-15)
        bent, modulus = ((part[:, :, 1:] * own[columns][:, :, None]).sum(dim=1)
                         for own in (self._bent, self._modulus))
        bent, whole = self._curved + bent, whole[:, 1:]
        share = torch.where(bent > 0.0, (2.0 / np.pi * whole * bent / way).clamp(max=1.0), 1.0)
        punch = 2.0 * FITTED / self._factor * modulus * (whole / np.pi).sqrt() * way
        if self._on:
            share = share * (force.norm(dim=2) / punch.clamp(min=1e-300)).clamp(min=1.0) ** _STIFFER
        return touching.sum(dim=1), radius[:, 0], (radius * oval)[:, 1:], share

    def acts(self) -> np.ndarray:
        """Whether the contact with each body has this compliance (K,) bool."""
        return np.array(self._round) & self._on


def lacks_something(model: Model, bodies: RigidBodies) -> bool:
    """Whether an object of these elements lacks anything under these bodies."""
    return poisson_ratio(model) is not None and any(0.0 < smooth_radius(s) < np.inf for s in bodies.shapes)


class MissingCompliance:
    """What the mesh of an object lacks under a small contact, by its own compliance at rest.

    Under the pressure of Hertz with unit resultant and radius a, the mean indentation of a half-space, weighted by the
    pressure, is 0.6 / (E* a), see Johnson, Contact Mechanics (1985), section 4.2: 2/5 F d is the work of a press to
    the force F. The displacements of the elements give k(a) = n . K^-1 n instead, n being the nodal forces of that
    pressure. Both lack or have the same of the rest of the body, which a wide footprint of radius R0 = 2 h shows, so

        lack = (0.6 / E*) (1 / a - 1 / R0) - (k(a) - k(R0))

    is missing, and a compliance c = (8 pi / 9) a^2 lack of the contact points has the energy of it. From a = h / 2 on
    the pressure on a mesh is no longer that of Hertz and the place matters less than it says; there the mean of places
    takes over. It does, too, where the object is no half-space there: where k(R0) is far from its value, as in a wall
    that bends or is as thin as an element, or where a rim cuts the wide footprint.

    Args:
        model: the object, of quadratic tetrahedra.
        response: of the body at rest to forces.
        parts: those of the contact points (B, f) of `patch.PART`.
        face: boundary triangle of each part (B, f), -1 for none.
        cover: area (B, 6 f) [m^2] of their points.
        edge: of their elements (B, f) [m], 0 for none.
        modulus: Young's, at their points (B, 6 f) [Pa].
        points: rest places of their points (B, 6 f, 3) [m].
    """

    def __init__(self, model: Model, response: Response, parts: np.ndarray, face: np.ndarray, cover: torch.Tensor,
                 edge: torch.Tensor, modulus: torch.Tensor, points: torch.Tensor):
        tensor = functools.partial(torch.as_tensor, device=points.device)
        self._response, self._width, self._cover, self._places = response, 1 + int(parts["local"].max()), cover, points
        self._parts = tuple(tensor(parts[name].copy()) for name in ("local", "shape"))
        self._nu, mesh = poisson_ratio(model) or 0.0, model.mesh
        a, b, c = (mesh.points[mesh.faces[:, k]] for k in range(3))
        across = np.cross(b - a, c - a)
        normals = across / np.linalg.norm(across, axis=1)[:, None]
        self._outward, table = tensor(normals), shape_values(POINTS)
        self._boundary = tensor(np.einsum("qa,fac->fqc", table, mesh.points[mesh.faces]))  # (F, 6, 3)
        self._area, self._table = tensor(mesh.face_area()[:, None] * WEIGHTS), tensor(table)
        self._faces, self._free = tensor(mesh.faces.astype(np.int64)).flatten(), tensor(model.free)[:, None]
        self._modulus, self._normal = modulus, tensor(normals[face]).repeat_interleave(6, dim=1)
        self._edge = edge.repeat_interleave(6, dim=1)

    def under(self, gap: torch.Tensor) -> torch.Tensor:
        """The compliance c E [m] of each touch under a round body whose distances from the contact points at rest are
        ``gap`` (B, 6 f) [m], and how much it counts against the mean of places [-], both at the radius of the contact
        and at one that is larger by `GROWN` (2, 2, B)."""
        out = gap.new_zeros((2, 2, len(gap)))
        gap = torch.where(self._cover > 0.0, gap, torch.inf)
        depth = -gap.amin(dim=1)
        # the mean of the depth over the area inside, whose radius is 2^(1/2) a, is half the largest
        radius = ((self._cover * (-gap).clamp(min=0.0)).sum(dim=1) / (np.pi * depth.clamp(min=1e-300))).sqrt()
        size = self._edge.gather(1, gap.argmin(dim=1, keepdim=True))[:, 0]
        at = ((depth > 0.0) & (radius > 0.0) & (radius < size)).nonzero()[:, 0]
        if len(at):
            out[:, :, at] = self._of(at, gap[at], depth[at], radius[at], size[at])
        return out

    def _of(self, at: torch.Tensor, gap: torch.Tensor, depth: torch.Tensor, radius: torch.Tensor,
            size: torch.Tensor) -> torch.Tensor:
        weight, *more = (self._pressure(at, gap, depth, radius, torch.maximum(larger * radius, _FOOT * size))
                         for larger in (1.0, GROWN))
        softness, size = ((weight * t[at]).sum(dim=1) for t in (1.0 / self._modulus, self._edge))
        place = (weight[:, :, None] * self._places[at]).sum(dim=1)
        normal = torch.nn.functional.normalize((weight[:, :, None] * self._normal[at]).sum(dim=1), dim=1)
        sharp = torch.stack([self._sharp(at, w, normal) for w in (weight, *more)])
        wide, covered = torch.cat([self._wide(*some) for some in zip(
            place.split(_CHUNK), normal.split(_CHUNK), (_WIDE * size).split(_CHUNK), strict=True)], dim=1)
        unit = 0.6 * (1.0 - self._nu**2) * softness
        radius = torch.stack([radius, GROWN * radius])
        ratio = radius / size
        lack = unit * (1.0 / radius - 1.0 / (_WIDE * size)) - (sharp - wide)
        lack = torch.minimum(lack.clamp(min=0.0) / (1.0 + _SOFTER * ratio**2), unit / radius)
        trusted = _within(wide / (unit / (_WIDE * size)), _LIKE_HALF_SPACE) * _within(covered, _COVERED)
        last = 1.0 / (1.0 + OWN**-6)  # of the weight, at a = h: there it ends
        count = ((1.0 / (1.0 + (ratio / OWN) ** 6) - last) / (1.0 - last)).clamp(min=0.0)
        return torch.stack([8.0 / 9.0 * np.pi * radius**2 * lack / softness, trusted * count])

    def _pressure(self, at: torch.Tensor, gap: torch.Tensor, depth: torch.Tensor,
                  radius: torch.Tensor, foot: torch.Tensor) -> torch.Tensor:
        """Share of each contact point (k, 6 f) in the force of the pressure of Hertz over a radius ``foot`` (k,)."""
        inside = 1.0 - 2.0 * (gap + depth[:, None]) / (depth * (foot / radius) ** 2)[:, None]  # 1 - (r / foot)^2
        weight = self._cover[at] * inside.clamp(min=0.0).sqrt()
        return weight / weight.sum(dim=1, keepdim=True)

    def _sharp(self, at: torch.Tensor, weight: torch.Tensor, normal: torch.Tensor) -> torch.Tensor:
        """Work [m/N] of the touches ``at`` (k,) under forces along ``normal`` (k, 3), which its contact points share by
        their ``weight`` (k, 6 f), twice it."""
        out = []
        shares = nodal_sums(*(part[at] for part in self._parts), weight[:, :, None], self._width)
        for b, nodes, n in zip(at.split(1), shares[:, :, 0], normal, strict=True):
            some = nodes.nonzero()[:, 0]
            force = (nodes[some, None] * n).flatten()
            dof = (3 * some[:, None] + torch.arange(3, device=some.device)).flatten()
            out.append(force @ self._response.between(b, dof[None])[0] @ force)
        return torch.stack(out)

    def _wide(self, place: torch.Tensor, normal: torch.Tensor, radius: torch.Tensor) -> torch.Tensor:
        """The same under the pressure of Hertz about a ``place`` (k, 3) [m] of the boundary, of a ``radius`` (k,) [m],
        and the part of its footprint that lies on the boundary (2, k)."""
        far = ((self._boundary - place[:, None, None]) ** 2).sum(dim=3) / radius[:, None, None] ** 2
        across = self._outward @ normal.T > _ACROSS  # (F, k)
        weight = self._area * (1.0 - far).clamp(min=0.0).sqrt() * across.T[:, :, None]
        whole = weight.sum(dim=(1, 2))
        nodal = ((weight / whole[:, None, None].clamp(min=1e-300)) @ self._table).flatten(1)
        share = torch.zeros((len(place), len(self._free) // 3), dtype=place.dtype, device=place.device)
        share.scatter_add_(1, self._faces.expand(len(place), -1), nodal)
        force = (share[:, :, None] * normal[:, None]).flatten(1).T * self._free
        work = (force * self._response.solve(force.contiguous())).sum(dim=0)
        return torch.stack([work, whole / (2.0 / 3.0 * np.pi * radius**2)])


def _within(value: torch.Tensor, limits: tuple[float, float, float, float]) -> torch.Tensor:
    """1 between the inner two ``limits``, 0 beyond the outer ones, linear between."""
    a, b, c, d = limits
    return ((value - a) / (b - a)).clamp(0.0, 1.0) * ((d - value) / (d - c)).clamp(0.0, 1.0)
