"""A shoe made of the materials of shoes: the form of the family `shoe`, with a midsole on an outsole, a padded tongue,
and for each part the elastic law, the density and the look of its material.

`model` names one of 23 shoes (`vsfsim.scenes._footwear_materials.MODELS`), or is "random": then `style` is one of the
four classes and each part's material is drawn. Moduli, sheet thicknesses and looks are drawn within the material's
bounds.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal

import numpy as np

from vsfsim.core.errors import SceneError
from vsfsim.core.solid import Solid
from vsfsim.core.table import check_keys, value
from vsfsim.scenes import shoe
from vsfsim.scenes._footwear_materials import CHOICES, MATERIALS, MODELS, PARTS, WALLS, draw_look, law_of, modulus_of
from vsfsim.scenes._shoe_styles import RANGES, STYLES, read_parameters

WALL = 0.006
"""Thickness of an upper with its padding and lining [m]."""
OUTSOLE = 0.005
"""Thickness of the outsole [m]."""
LAWS = tuple(law_of(name) for name in MATERIALS)
"""Of all parts that a shoe may have."""
_OWN = ("model", "style", "side", "variation", "appearance_informative", "lined")


def build(parameters: Mapping[str, Any], rng: np.random.Generator, *, resolution: float, where: str) -> Solid:
    """A shoe that stands on z = 0 with its toe towards +x; the origin is below the centre of its bounding box.

    Args:
        parameters: `model`, the lengths of `vsfsim.scenes._shoe_styles.RANGES`, and `style`, `side`, `variation` and
            `appearance_informative` as of the family `shoe`. `style` counts for a random shoe only. The last is 1 for a
            named shoe and 0.9 for a random one where it is not given. `lined` true gives walls the bending stiffness of
            sheet and lining; false, which is the default, that of the sheet alone.
        rng: random stream of form, materials, moduli and appearance, in this order.
        resolution: size of a cell along the surface [m], limited to 3 walls; walls are one cell thick, the sole two.
        where: file and section, for error messages.

    Raises:
        SceneError: a parameter is unknown or out of its range, or the resolution is outside 4 to 30 mm.
    """
    if not 0.004 <= resolution <= 0.030:
        raise SceneError(f"{where}: resolution is {resolution!r}; a shoe is meshed with cells of 0.004 to 0.03 m.")
    check_keys(parameters, where, (*_OWN, *RANGES))
    name = value(parameters.get("model", "random"), Literal[*MODELS, "random"], f"{where}: model")
    lined = value(parameters.get("lined", False), bool, f"{where}: lined")
    if name != "random" and "style" in parameters:
        raise SceneError(f"{where}: model is {name!r}, whose style is '{MODELS[name].style}'; take "
                         "style out, or write model = \"random\".")
    own = MODELS.get(name)
    style = own.style if own else parameters.get("style", "sneaker")
    given = {key: value for key, value in parameters.items() if key not in ("model", "lined")}
    # A named shoe looks as its model says; a random one has a part in ten that looks like another material.
    usual = {"wall": WALL, "appearance_informative": 1.0 if own else 0.9, **(own.form if own else {})}
    form, options = read_parameters({**usual, **given, "style": style}, rng, where)
    # A random shoe's draws are made for a named one, too, so that both use the stream alike.
    drawn = {part: allowed[int(rng.integers(len(allowed)))] for part, allowed in CHOICES[style].items()}
    materials = dict(zip(PARTS, own.materials)) if own else {part: drawn[part] for part in PARTS}
    walls = {part: WALLS.get(part, {}).get(materials[part], form.wall) for part in PARTS}
    # Parts of one material are cut from the same sheet: the shares of the first such part count.
    shares: dict[str, np.ndarray] = {}
    for part in PARTS:
        shares.setdefault(materials[part], rng.uniform(size=2))
    modulus = np.array([modulus_of(materials[part], walls[part], shares[materials[part]],
                                   lined=lined) for part in PARTS])
    every = tuple(MATERIALS)
    looks = []
    for part in PARTS:
        honest, other = rng.uniform() < options.appearance_informative, every[int(rng.integers(len(every)))]
        looks.append((own.looks if own else {}).get(part, materials[part]) if honest else other)
    look = draw_look(looks, rng)
    thin = min(form.wall, *walls.values())
    thick = {PARTS.index(part): wall for part, wall in walls.items() if wall != form.wall}
    parts = shoe.mesh(form, min(resolution, shoe.LONGEST_CELL * thin), walls=thick,
                      outsole=2.0 * OUTSOLE / (form.sole_heel + form.sole_fore))
    vertices, hexes, region, rank = parts
    vertices, tets, owner = shoe.divide(form, options.side, vertices, hexes, rank)
    made_of = ", ".join(f"{part} {material}" for part, material in materials.items())
    return Solid(vertices, tets, region[owner], PARTS, modulus, look,
                 (f"{name} ({style}, {options.side}): {made_of}.",), tuple(law_of(materials[part]) for part in PARTS))


assert all(style in STYLES for style in CHOICES)
