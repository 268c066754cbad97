"""A plant of a procedural family in ``scenes/``, by the name that a scene gives."""

from __future__ import annotations

import numpy as np

from vsfsim.core.errors import SceneError
from vsfsim.core.plant import Plant
from vsfsim.core.shape import Family
from vsfsim.core.shelf import family


def grow(shape: Family, rng: np.random.Generator, *, where: str, number: int = 0) -> Plant:
    """The plant of a family, as object ``number`` of its dataset.

    Raises:
        SceneError: an unknown family, one that makes solid bodies, or a parameter that is wrong.
    """
    module = family(shape.name, where)
    if not hasattr(module, "grow"):
        raise SceneError(f"{where}: the family '{shape.name}' makes solid bodies; an arm touches plants so far. Use "
                         f"family = \"plant\", or take [arm] out and give a [probe].")
    return module.grow(shape.parameters, rng, where=where, number=number)
