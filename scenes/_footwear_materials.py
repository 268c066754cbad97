"""The materials of the family `footwear`, what each part of a shoe is made of and how it looks, and its 23 named shoes.

An upper is not one sheet. Leather, knit or nylon carries the load and is 0.3 to 2.4 mm thick; lining and padding make
the wall 4 to 6 mm thick and carry little. The wall is meshed as one solid layer, so it has an equivalent modulus. A
curved wall under a local load has the stiffness 4 E t^2 / (R sqrt(3 (1 - nu^2))) (Reissner 1946, shallow spherical
shell), so the wall of thickness w has the modulus E t^2 / w^2 of a load-bearing sheet (E, t). Its stiffness under small
indentations is then that of the sheet; its membrane stiffness E t is too small by the factor t / w, which shows where a
wall is indented by more than its thickness.

A lined wall bends less than its sheet alone, because a lining of E_l t_l = 3 kN/m (cotton or polyester of 0.3 mm) lies
at a distance h behind it, with padding between them. Its bending stiffness is that of a sandwich,
D = E t^3 / 12 + s h^2 / (1 / (E t) + 1 / (E_l t_l)), where s = 0.7 is left of the second term by the shear of the
padding (G h of 0.1 kN/m, panels of 60 mm). By the formula for a curved wall, which is 8 sqrt(D E t) / R, the modulus of
the wall is then sqrt(12 D E t) / w^2.

The tables are `tables/footwear_materials.toml`, `footwear_models.toml` and `footwear_choices.toml`. Moduli, thicknesses
and densities marked [S] there have a source that states them. The others are estimates for the kind of material; no
public measurement of them was found.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from vsfsim.core.material import FOAMS, Foam
from vsfsim.core.solid import Appearance, Law
from vsfsim.core.table import shipped_rows

Colour = tuple[float, float, float]

# of the tongue an estimate for polyurethane foam of 30 to 60 kg/m^3: mu 15 to 40 kPa, alpha 10 to 20
_LAWS = {**FOAMS, "": None, "tongue": Foam((27e3,), (10.0,), (0.0,))}


@dataclass(frozen=True)
class Material:
    """One material of a part."""

    young_modulus: tuple[float, float]
    """Bounds of Young's modulus of the load-bearing sheet, whose distribution is log-uniform [Pa]."""
    poisson_ratio: float
    """[-]."""
    density: float
    """[kg/m^3]."""
    colours: tuple[Colour, ...]
    """Usual colours in linear RGB, 0 to 1."""
    texture: str
    """One of `vsfsim.core.solid.TEXTURES`."""
    scale: tuple[float, float]
    """Bounds of the texture's wavelength [m]."""
    contrast: tuple[float, float]
    """Bounds of the texture's relative amplitude [-]."""
    sheet: tuple[float, float] | None = None
    """Bounds of the thickness of that sheet [m]; None for a material that fills the wall."""
    foam: str = ""
    """The law of a foam, scaled to the modulus, by its name in `_LAWS`; "" for the neo-Hookean law."""
    lining: float = 0.0
    """Distance h of the lining behind the sheet [m]; 0 for none."""


MATERIALS: dict[str, Material] = shipped_rows(__file__, "tables/footwear_materials.toml", Material)
"""Materials by name."""


LINING = 3e3
"""Young's modulus times thickness of a lining [N/m]; an estimate, as are the distances."""
SANDWICH = 0.7
"""Fraction of a sandwich's bending stiffness that the shear of the padding leaves [-]."""


def modulus_of(name: str, wall: float, share: Sequence[float] | np.ndarray, *, lined: bool = False) -> float:
    """Modulus [Pa] of a wall of thickness ``wall`` [m] of material ``name``, see the head of this file.

    Args:
        name: key of `MATERIALS`.
        wall: thickness of the wall [m].
        share: where modulus and sheet thickness lie within their bounds (2,), 0 to 1.
        lined: with the lining that the material has; False: the sheet alone.
    """
    own = MATERIALS[name]
    low, high = np.log(own.young_modulus)
    modulus = float(np.exp(low + share[0] * (high - low)))
    if own.sheet is None:
        return modulus
    sheet = own.sheet[0] + share[1] * (own.sheet[1] - own.sheet[0])
    if not lined or not own.lining:
        return modulus * float(sheet / wall)**2
    tension = modulus * sheet
    bending = tension * sheet**2 / 12.0 + SANDWICH * own.lining**2 / (1.0 / tension + 1.0 / LINING)
    return float(np.sqrt(12.0 * bending * tension)) / wall**2


def law_of(name: str) -> Law:
    """Poisson's ratio, density and foam law of material ``name``."""
    own = MATERIALS[name]
    return Law(own.poisson_ratio, own.density, _LAWS[own.foam])


def draw_look(looks: Sequence[str], rng: np.random.Generator) -> Appearance:
    """The appearance of parts that look like the materials ``looks`` (R,).

    Equal materials of one shoe have one colour, varied by some percent from part to part.
    """
    albedo, scale, contrast = [], [], []
    colour: dict[str, np.ndarray] = {}
    for name in looks:
        own = MATERIALS[name]
        drawn = np.array(own.colours[int(rng.integers(len(own.colours)))]) * np.exp(rng.normal(0.0, 0.08, 3))
        base = colour.setdefault(name, drawn)
        albedo.append(np.clip(base * np.exp(rng.normal(0.0, 0.04)), 0.01, 0.95))
        scale.append(rng.uniform(*own.scale))
        contrast.append(rng.uniform(*own.contrast))
    return Appearance(np.array(albedo), tuple(MATERIALS[name].texture for name in looks),
                      np.array(scale), np.array(contrast))


# ------------------------------------------------------------------------------------------ the named shoes


PARTS = ("sole", "toe_cap", "upper", "tongue", "heel_counter", "outsole")
"""Parts of a shoe; the sole is the midsole between upper and outsole."""


@dataclass(frozen=True)
class Model:
    """One named shoe."""

    style: str
    """Key of `vsfsim.scenes._shoe_styles.STYLES`, whose form it varies."""
    materials: tuple[str, ...]
    """Material of each of `PARTS`."""
    form: Mapping[str, float] = field(default_factory=dict)
    """Fields of `ShoeForm` that are not the style's."""
    looks: Mapping[str, str] = field(default_factory=dict)
    """Parts that look like another material than their own."""


MODELS: dict[str, Model] = shipped_rows(__file__, "tables/footwear_models.toml", Model)
"""The named shoes."""

CHOICES: dict[str, dict[str, tuple[str, ...]]] = shipped_rows(
    __file__, "tables/footwear_choices.toml", dict[str, tuple[str, ...]])
"""Materials that the parts of a random shoe of each style are drawn from."""
WALLS = {"tongue": {"padding": 0.010, "fleece": 0.009}}
"""Thickness of a padded part [m]; the other parts are as thick as the form's wall."""
