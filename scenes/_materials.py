"""The materials of shoes: the stiffness and the usual appearance of each class.

The moduli are effective moduli of the parts of a shoe pressed by a body of fingertip size; a sheet of leather in
tension is far stiffer. They are chosen to span 1e4 to 1e7 Pa, the range that SBML reports for its shoes.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from vsfsim.core.solid import Appearance
from vsfsim.core.table import shipped_rows

_BRIGHTNESS_CORRELATION = 0.6
"""Correlation of a region's log brightness with its stiffness within the class [-]."""
_BRIGHTNESS_SPREAD = 0.35
"""Scale of the variation of the log brightness [-]."""


@dataclass(frozen=True)
class MaterialClass:
    """One class of material."""

    young_modulus: tuple[float, float]
    """Bounds of Young's modulus, whose distribution is log-uniform [Pa]."""
    colours: tuple[tuple[float, float, float], ...]
    """Typical colours in linear RGB, 0 to 1; one of them is drawn and varied."""
    texture: str
    """One of `vsfsim.core.solid.TEXTURES`."""
    texture_scale: tuple[float, float]
    """Bounds of the texture's wavelength [m]."""
    texture_contrast: tuple[float, float]
    """Bounds of the texture's relative amplitude, 0 to 1."""


CLASSES: dict[str, MaterialClass] = shipped_rows(__file__, "tables/shoe_classes.toml", MaterialClass)
"""Classes whose typical colours and textures both depend on the material."""

COLOURWAYS = ((0.16, 0.16, 0.17), (0.70, 0.69, 0.66), (0.55, 0.10, 0.09), (0.12, 0.22, 0.55),
              (0.14, 0.40, 0.20), (0.74, 0.60, 0.14), (0.38, 0.23, 0.12), (0.48, 0.46, 0.44),
              (0.45, 0.16, 0.42), (0.80, 0.44, 0.32))
"""Colours of whole shoes, linear RGB, 0 to 1."""
SOLE_MATERIAL = "ribbed-rubber"
"""Class of the sole in `TEXTURED`."""
TEXTURED: dict[str, MaterialClass] = {
    "knit": MaterialClass((4e4, 1.2e5), COLOURWAYS, "weave", (0.008, 0.013), (0.80, 0.95)),
    "fleece": MaterialClass((1.2e5, 4e5), COLOURWAYS, "noise", (0.009, 0.014), (0.65, 0.85)),
    "felt": MaterialClass((4e5, 1.2e6), COLOURWAYS, "noise", (0.009, 0.014), (0.25, 0.35)),
    "leather": MaterialClass((1.2e6, 4e6), COLOURWAYS, "grain", (0.008, 0.014), (0.10, 0.18)),
    "plastic": MaterialClass((4e6, 1e7), COLOURWAYS, "plain", (0.010, 0.020), (0.00, 0.02)),
    SOLE_MATERIAL: MaterialClass((2e6, 1e7), COLOURWAYS, "stripes", (0.016, 0.024), (0.20, 0.30)),
}
"""Classes whose colour does not depend on the material: all parts of a shoe share one colour of `COLOURWAYS`. The
texture does: a softer material has a coarser relief, from a loose knit to moulded plastic."""


def draw_modulus(name: str, rng: np.random.Generator, *, table: Mapping[str, MaterialClass] = CLASSES) -> float:
    """A random Young's modulus [Pa] of class ``name`` of ``table``."""
    low, high = table[name].young_modulus
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))


def draw_appearance(names: Sequence[str], young_modulus: np.ndarray, informative: float, rng: np.random.Generator, *,
                    table: Mapping[str, MaterialClass] = CLASSES) -> Appearance:
    """The appearance of each region. With the table `CLASSES` it is usually that of the region's class, and stiffer
    regions are darker on average; for the other tables see `_one_colour`.

    Args:
        names: material class of each region, R of them.
        young_modulus: of each region (R,) [Pa].
        informative: probability that a region has the appearance of its own class rather than of a random class [-].
        rng: random stream; the number of draws does not depend on the outcome.
        table: the classes.
    """
    if table is not CLASSES:
        return _one_colour(names, informative, rng, table)
    every, rho = tuple(table), _BRIGHTNESS_CORRELATION
    albedo, texture, scale, contrast = [], [], [], []
    for name, modulus in zip(names, young_modulus):
        keeps, other = rng.uniform() < informative, every[int(rng.integers(len(every)))]
        look = table[name if keeps else other]
        base = np.array(look.colours[int(rng.integers(len(look.colours)))])
        low, high = np.log(table[name].young_modulus)
        # stiffness within the class, from -1 (softest) to +1 (stiffest)
        place = np.clip(2.0 * (np.log(modulus) - low) / (high - low) - 1.0, -1.0, 1.0)
        chance = rng.uniform(-1.0, 1.0)
        brightness = np.exp(-_BRIGHTNESS_SPREAD * (rho * place + np.sqrt(1.0 - rho**2) * chance))
        albedo.append(np.clip(base * brightness * np.exp(rng.normal(0.0, 0.08, 3)), 0.01, 0.95))
        texture.append(look.texture)
        scale.append(rng.uniform(*look.texture_scale))
        contrast.append(rng.uniform(*look.texture_contrast))
    return Appearance(np.array(albedo), tuple(texture), np.array(scale), np.array(contrast))


def _one_colour(names: Sequence[str], informative: float, rng: np.random.Generator,
                table: Mapping[str, MaterialClass]) -> Appearance:
    """One colour for all regions, varied by about a tenth; each region usually has the texture of its own class."""
    every, colour = tuple(table), np.array(COLOURWAYS[int(rng.integers(len(COLOURWAYS)))])
    albedo, texture, scale, contrast = [], [], [], []
    for name in names:
        keeps, other = rng.uniform() < informative, every[int(rng.integers(len(every)))]
        look = table[name if keeps else other]
        albedo.append(np.clip(colour * np.exp(rng.normal(0.0, 0.1)), 0.01, 0.95))
        texture.append(look.texture)
        scale.append(rng.uniform(*look.texture_scale))
        contrast.append(rng.uniform(*look.texture_contrast))
    return Appearance(np.array(albedo), tuple(texture), np.array(scale), np.array(contrast))
