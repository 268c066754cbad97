"""What has no effect is refused, unless the scene's ``allow`` says that it is meant."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from vsfsim.core.errors import SceneError
from vsfsim.core.material import Inclusion, MaterialField
from vsfsim.core.scene import Scene
from vsfsim.core.solid import Solid
from vsfsim.physics.contact.bodies import RigidBodies
from vsfsim.physics.model import Model

EARTH = 9.81  # where a scene says nothing of gravity [m/s^2]
_GRID = 9  # points along the box around a part at which it is looked for


def refuse(scene: Scene, word: str, what: str, cure: str) -> None:
    """Raises:
        SceneError: the scene does not allow ``word``.
    """
    if word not in scene.allow:
        raise SceneError(f"{scene.source}: {what}. {cure}, or say that it is "
                         f'meant: allow = ["{word}"] at the top of the scene.')


def check_body(scene: Scene, model: Model) -> None:
    """Look at what a scene's object is made of.

    Raises:
        SceneError: an inclusion lies outside the body or under later ones, or the body cannot carry its weight.
    """
    spec, solid = scene.required_object, model.solid
    field = spec.young_modulus
    for k, part in enumerate(field.inclusions):
        where = _hidden(solid, field, k, part)
        if where:
            refuse(scene, "unused-part", f"[object] young_modulus.inclusions[{k}], a {part.kind} "
                   f"{list(part.numbers)} of {part.young_modulus:.3g} Pa, {where}",
                   "Numbers are metres in the object's frame, whose origin is the middle of the base, and a later "
                   "inclusion lies over an earlier one. Move it, or take it out")
    if "gravity" in scene.given and not any(scene.gravity):
        return
    pull = float(np.linalg.norm(scene.gravity)) or EARTH
    down = np.array(scene.gravity) / pull if any(scene.gravity) else np.array([0.0, 0.0, -1.0])
    density = spec.density if solid.laws is None else max(law.density for law in solid.laws)
    high = float(np.ptp(model.mesh.points @ down))
    least, modulus = density * pull * high, model.young_modulus.mean(axis=1)
    order = np.argsort(modulus)
    share = np.cumsum(model.mesh.volume[order]) / model.mesh.volume.sum()
    half = float(modulus[order[np.searchsorted(share, 0.5)]])
    if half < least:
        refuse(scene, "own-weight",
               f"[object] young_modulus is {half:.3g} Pa or less in half of "
               f"the body, which cannot carry its own weight: {density:g} kg/m^3 at {pull:g} "
               f"m/s^2, {high:.3g} m high, take {least:.3g} Pa",
               "Moduli are in pascals, not in "
               "kPa. Give a larger one, or gravity = [0, 0, 0] for a body without weight")


def _hidden(solid: Solid, field: MaterialField, k: int, part: Inclusion) -> str:
    """Why part ``k`` does not show in the body, as the end of a sentence; empty if it does."""
    corners = solid.vertices[solid.tets]
    centre = corners.mean(axis=1)
    n = np.asarray(part.numbers)
    ends = n[:3] if part.kind == "sphere" else n[:6].reshape(2, 3)
    wide = 0.0 if part.kind == "box" else n[-1]
    low, high = np.atleast_2d(ends).min(axis=0) - wide, np.atleast_2d(ends).max(axis=0) + wide
    steps = (np.stack(np.meshgrid(*[np.arange(_GRID)] * 3, indexing="ij"), axis=-1).reshape(-1, 3) + 0.5) / _GRID
    points = np.concatenate([centre, low + steps * (high - low)])
    points = points[part.distance(points) <= 0.0]
    shows = np.ones(len(points), bool)
    for later in field.inclusions[k + 1:]:
        shows &= later.distance(points) > 0.0
    near = np.flatnonzero(part.distance(centre) <= np.linalg.norm(corners - centre[:, None], axis=2).max(axis=1))
    inside = np.zeros(len(points), bool)
    for tet in corners[near]:
        share = np.linalg.solve((tet[1:] - tet[0]).T, (points - tet[0]).T)
        inside |= (share >= 0.0).all(axis=0) & (share.sum(axis=0) <= 1.0)
        if (inside & shows).any():
            return ""
    return "lies under later ones" if inside.any() else "lies outside the body"




def check_free(scene: Scene, model: Model, bodies: RigidBodies, pose: np.ndarray) -> None:
    """Look at what bodies of a press meet at full depth, at a ``pose`` (K, 4, 4) each.

    Raises:
        SceneError: one meets only what supports hold.
    """
    faces, free = model.mesh.faces, model.free[::3] > 0.0
    for k in range(len(bodies)):
        there = (model.mesh.points - pose[k, :3, 3]) @ pose[k, :3, :3]
        met = (bodies.distance(k, there)[faces] < 0.0).any(axis=1)
        if met.any() and not free[faces[met]].any():
            raise SceneError(f"{scene.source}: [press] meets the body only where [object] fixed = "
                             f"{scene.required_object.fixed!r} holds it. What is held is rigid, and a force on it has "
                             "no meaning. Press where the body may move, or hold less of it.")


def nearest(bodies: RigidBodies, poses: np.ndarray, points: np.ndarray) -> Callable[[int], float]:
    """For body number k of some at ``poses`` (T, K, 4, 4): how near it comes to ``points`` (T, n, 3) [m]."""
    return lambda k: min(float(bodies.distance(k, (at - pose[k, :3, 3]) @ pose[k, :3, :3]).min())
                         for at, pose in zip(points, poses, strict=True))


def check_contact(scene: Scene, names: Sequence[str], force: np.ndarray,
                  gap: Callable[[int], float], moved: np.ndarray) -> None:
    """Look at which bodies of a press touched.

    Args:
        scene: with the press.
        names: of the K bodies.
        force: on each (T, K, 3) [N]; NaN where it is not known.
        gap: how near body number k comes to what deforms, in all frames [m].
        moved: displacements of what deforms (T, n, 3) [m].

    Raises:
        SceneError: nothing touches, or a body never does and stays farther away than anything moves.
    """
    met = (force != 0.0).any(axis=(0, 2))
    if not met.any():
        refuse(scene, "no-contact",
               "[press] never brings the probe, or what moves with it, into "
               f"contact: it stays {1e3 * max(0.0, min(map(gap, range(len(names))))):.3g} mm away",
               "Its points are world coordinates of the probe's or the sensor's origin in metres, "
               "from outside the body into it. Change from and to")
        return
    most = float(np.linalg.norm(moved, axis=-1).max())
    for k in np.flatnonzero(~met).tolist():
        if (away := gap(k)) > most:
            refuse(scene, "out-of-reach", f"{names[k]} never touches: it stays {1e3 * away:.3g} mm away, and nothing "
                   f"moves by more than {1e3 * most:.3g} mm", "Move it nearer, press deeper, or take it out")
