"""The laws by name: those of this package, and the entry points of the group ``vsfsim.laws``."""

from __future__ import annotations

from typing import Any

from vsfsim.core.errors import SceneError, one_of
from vsfsim.core.scene import Scene
from vsfsim.core.shelf import LAW_GROUP, Registry
from vsfsim.physics.laws import fung, hyperfoam, neo_hooke
from vsfsim.physics.laws.law import MOST_POISSON_RATIO, Settings, SolidLaw

LAWS: Registry[SolidLaw] = Registry(LAW_GROUP, {law.name: law for law in (neo_hooke.LAW, hyperfoam.LAW, fung.LAW)})
"""Laws of solid materials."""


def law_of(scene: Scene) -> tuple[SolidLaw, Settings] | None:
    """The law of ``[object]``, which ``material`` or ``law`` says, with its rows of numbers; None where neither does.

    Raises:
        SceneError: there is no such law, it takes other numbers than the scene gives, or it cannot be that of a body
            with this Poisson's ratio.
    """
    if scene.object.law is None:
        return None
    where = f"{scene.source} [object]"
    law, rows = named(LAWS, scene.object.law, where)
    if not law.pressed and scene.object.poisson_ratio > MOST_POISSON_RATIO:
        raise SceneError(f"{where}: law '{law.name}' acts at points alone, where a nearly incompressible element "
                         f"locks: poisson_ratio = {scene.object.poisson_ratio:g} is more than {MOST_POISSON_RATIO:g}. "
                         f"Give less, or leave law out.")
    return law, rows


def named(laws: Registry[Any], given: tuple[str, Settings], where: str) -> tuple[Any, Settings]:
    """The row of a table of laws that a scene names, with its rows of numbers; ``where`` begins messages.

    Raises:
        SceneError: there is no such law, or it takes other numbers.
    """
    name, rows = given
    law = laws[one_of(name, laws, f"{where}: the law", SceneError)]
    if set(rows) != set(law.settings):
        raise SceneError(f"{where}: law '{name}' takes {', '.join(law.settings) or 'no numbers'} beside its name; the "
                         f"scene gives {', '.join(rows) or 'none'}.")
    return law, rows
