"""A law of contact: the normal force of a contact point by its depth in the other body.

A law is one Warp function. A package adds one as an entry point of the group ``vsfsim.contact_laws``, a `ContactLaw`; a
scene names it in ``[probe] law``, as it names a material's law in ``[object] law``.

``push(module)`` is a Warp function in double precision, compiled into ``module``, of one point at a depth >= 0 [m]:

    push(w, share, soft, onset, depth, terms)     normal force [N], its derivative [N/m] and its energy [J]

w is the point's stiffness [N/m]: of the surface that the point stands for, over a small part of an element. A force
that is much smaller than w times the depth lets bodies pass into one another, which `intrusion` marks. The first part
of the depth, ``soft`` [m], stands for indentation under round bodies that the mesh is too coarse for, with ``share`` of
the stiffness: a law that leaves them out is as much too stiff there as the mesh. ``onset`` [m] is that of a sheet.
``terms`` (n,) are the numbers that the scene gives, row after row of ``settings``.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp

from vsfsim.core.scene import Scene
from vsfsim.core.shelf import CONTACT_LAW_GROUP, Registry
from vsfsim.physics.laws.catalogue import named
from vsfsim.physics.runtime import real


@dataclass(frozen=True)
class ContactLaw:
    """One law."""

    name: str
    """By which scenes and entry points name it; also part of the name of its kernels' module."""
    push: Callable[[str], Any]
    """See the head of this file."""
    settings: tuple[str, ...] = ()
    """Names of the rows of numbers that it takes, all of them."""


def _penalty(module: str) -> Any:
    """A stiff spring: share w down to the depth ``soft``; on a sheet it grows from 0 to w down to ``onset``."""

    @wp.func(module=module)
    def push(w: real, share: real, soft: real, onset: real, depth: real, terms: wp.array(dtype=real)):
        if depth < onset:
            slope = w * depth / onset
            return real(0.5) * slope * depth, slope, slope * depth * depth / real(6.0)
        if onset > real(0.0):
            more = depth - onset
            force = real(0.5) * w * onset
            return (force + w * more, w, w * onset * onset / real(6.0) + force * more + real(0.5) * w * more * more)
        if depth <= soft:
            return share * w * depth, share * w, real(0.5) * share * w * depth * depth
        more = depth - soft
        force = share * w * soft
        return (force + w * more, w, real(0.5) * force * soft + force * more + real(0.5) * w * more * more)

    return push


PENALTY = ContactLaw("penalty", _penalty)
CONTACT_LAWS: Registry[ContactLaw] = Registry(CONTACT_LAW_GROUP, {PENALTY.name: PENALTY})


def contact_law_of(scene: Scene) -> tuple[ContactLaw, np.ndarray]:
    """The law of ``[probe]`` and its terms; the penalty where the scene names none.

    Raises:
        SceneError: there is no such law, or it takes other numbers than the scene gives.
    """
    if scene.contact_law is None:
        return PENALTY, np.zeros(1)
    law, rows = named(CONTACT_LAWS, scene.contact_law, f"{scene.source} [probe]")
    return law, np.concatenate([np.zeros(0), *(rows[name] for name in law.settings)])
