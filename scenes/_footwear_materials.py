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

Moduli, thicknesses and densities marked [S] have a source that states them. The others are estimates for the kind of
material; no public measurement of them was found.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from vsfsim.core.material import FOAMS, Foam
from vsfsim.core.solid import Appearance, Law

Colour = tuple[float, float, float]

# an estimate for polyurethane foam of 30 to 60 kg/m^3: mu 15 to 40 kPa, alpha 10 to 20
_TONGUE = Foam((27e3,), (10.0,), (0.0,))


@dataclass(frozen=True)
class Material:
    """One material of a part."""

    young_modulus: tuple[float, float]
    """Bounds of Young's modulus of the load-bearing sheet, whose distribution is log-uniform [Pa]."""
    sheet: tuple[float, float] | None
    """Bounds of the thickness of that sheet [m]; None for a material that fills the wall."""
    poisson_ratio: float
    """[-]."""
    density: float
    """[kg/m^3]."""
    foam: Foam | None
    """The law of a foam, scaled to the modulus; None for the neo-Hookean law."""
    colours: tuple[Colour, ...]
    """Usual colours in linear RGB, 0 to 1."""
    texture: str
    """One of `vsfsim.core.solid.TEXTURES`."""
    scale: tuple[float, float]
    """Bounds of the texture's wavelength [m]."""
    contrast: tuple[float, float]
    """Bounds of the texture's relative amplitude [-]."""
    lining: float = 0.0
    """Distance h of the lining behind the sheet [m]; 0 for none."""


_BROWNS = ((0.24, 0.09, 0.03), (0.34, 0.16, 0.06), (0.12, 0.05, 0.03), (0.05, 0.04, 0.04))
_GREYS = ((0.30, 0.31, 0.33), (0.14, 0.15, 0.17), (0.45, 0.46, 0.47))
_BRIGHT = ((0.62, 0.10, 0.12), (0.10, 0.28, 0.62), (0.72, 0.60, 0.10), (0.12, 0.46, 0.24), (0.70, 0.32, 0.08))
_WHITES = ((0.75, 0.74, 0.70), (0.68, 0.66, 0.60))
_BLACKS = ((0.035, 0.035, 0.04), (0.07, 0.065, 0.06))

MATERIALS: dict[str, Material] = {
    # knits of 1.0 to 1.8 mm
    "knit": Material((2e6, 6e6), (0.0010, 0.0018), 0.30, 350.0, None, _BRIGHT, "weave", (0.007, 0.011), (0.55, 0.85),
                     lining=0.003),
    # a sandwich mesh of 2 to 4 mm, of which 0.6 to 1 mm bears load
    "mesh": Material((15e6, 30e6), (0.0007, 0.0010), 0.30, 400.0, None, _GREYS, "weave", (0.004, 0.006), (0.40, 0.65),
                     lining=0.0025),
    "nylon": Material((150e6, 350e6), (0.0003, 0.0005), 0.35, 600.0, None, _GREYS, "stripes", (0.005, 0.009),
                      (0.15, 0.30), lining=0.002),
    "felt": Material((1e6, 4e6), (0.0020, 0.0030), 0.20, 250.0, None, _GREYS, "noise", (0.006, 0.012), (0.30, 0.50),
                     lining=0.003),
    "suede": Material((12e6, 35e6), (0.0012, 0.0016), 0.40, 700.0, None, ((0.36, 0.24, 0.13), *_GREYS), "noise",
                      (0.014, 0.024), (0.15, 0.30), lining=0.0025),
    # the low modulus of the first strains, 5 to 20 MPa, is documented (Upstone and Ward) [S]; 30 to 100 MPa after them
    "leather": Material((30e6, 80e6), (0.0012, 0.0016), 0.40, 850.0, None, (*_WHITES, *_BLACKS), "grain",
                        (0.006, 0.010), (0.12, 0.25), lining=0.0025),
    "boot-leather": Material((40e6, 90e6), (0.0018, 0.0024), 0.40, 900.0, None, _BROWNS, "grain", (0.009, 0.014),
                             (0.25, 0.45), lining=0.002),
    # toe puff and heel counter: thermoplastic of 0.8 to 1.8 mm
    "thermoplastic": Material((150e6, 500e6), (0.0010, 0.0016), 0.40, 1000.0, None, (*_BLACKS, *_GREYS), "seams",
                              (0.012, 0.018), (0.35, 0.60)),
    # TPU of Shore 85A to 95A: 20 to 80 MPa [S]
    "tpu": Material((20e6, 80e6), (0.0015, 0.0022), 0.45, 1150.0, None, _BRIGHT, "plain", (0.01, 0.02), (0.0, 0.03)),
    # outsoles and toe bumpers of Shore A 55 to 70: 3 to 8 MPa, nu 0.49
    "rubber": Material((3e6, 8e6), None, 0.49, 1150.0, None, (*_BLACKS, (0.45, 0.28, 0.12), *_WHITES), "tread",
                       (0.010, 0.016), (0.50, 0.80)),
    "rubber-cap": Material((3e6, 8e6), (0.0025, 0.0040), 0.49, 1150.0, None, (*_WHITES, *_BLACKS), "plain",
                           (0.01, 0.02), (0.0, 0.05)),
    # Verdejo and Mills 2004 and 2002 [S]
    "eva": Material((1.6e6, 2.6e6), None, 0.0, 230.0, FOAMS["eva"], _WHITES, "plain", (0.01, 0.02), (0.0, 0.05)),
    # new midsoles, LivingMatterLab/CANN [S]
    "soft-foam": Material((0.29e6, 0.38e6), None, 0.0, 180.0, FOAMS["midsole-heel"], _WHITES, "noise", (0.008, 0.012),
                          (0.05, 0.12)),
    # McCulloch, Delp and Kuhl 2026 [S]
    "super-foam": Material((0.25e6, 0.32e6), None, 0.0, 100.0, FOAMS["ff-leap"], _BRIGHT, "noise", (0.008, 0.012),
                           (0.05, 0.12)),
    # polyurethane soles of boots and slippers: 2 to 8 MPa, 350 to 600 kg/m^3
    "pu-sole": Material((2e6, 8e6), None, 0.35, 480.0, None, (*_BROWNS, *_BLACKS), "plain", (0.01, 0.02), (0.0, 0.05)),
    "padding": Material((40e3, 80e3), None, 0.0, 45.0, _TONGUE, (*_GREYS, *_BLACKS), "laces", (0.014, 0.018),
                        (1.5, 3.0)),
    "fleece": Material((30e3, 60e3), None, 0.0, 40.0, _TONGUE, _WHITES, "noise", (0.006, 0.010), (0.40, 0.60)),
}
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
    return Law(own.poisson_ratio, own.density, own.foam)


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
    form: Mapping[str, float]
    """Fields of `ShoeForm` that are not the style's."""
    materials: tuple[str, ...]
    """Material of each of `PARTS`."""
    looks: Mapping[str, str]
    """Parts that look like another material than their own."""


def _model(style: str, sole: str, cap: str, upper: str, tongue: str, counter: str, outsole: str, *,
           looks: Mapping[str, str] | None = None, **form: float) -> Model:
    return Model(style, form, (sole, cap, upper, tongue, counter, outsole), looks or {})


MODELS: dict[str, Model] = {
    "work-boot": _model("boot", "pu-sole", "thermoplastic", "boot-leather", "padding", "thermoplastic", "rubber",
                        looks={"toe_cap": "boot-leather", "heel_counter": "boot-leather"}),
    "hiking-boot": _model("boot", "eva", "rubber-cap", "suede", "padding", "thermoplastic", "rubber",
                          collar_height=0.104, sole_heel=0.030),
    "chelsea-boot": _model("boot", "pu-sole", "thermoplastic", "leather", "padding", "leather", "rubber",
                           looks={"toe_cap": "leather", "tongue": "leather"}, width=0.096, toe_height=0.056),
    "desert-boot": _model("boot", "pu-sole", "suede", "suede", "suede", "suede", "rubber", collar_height=0.098),
    "combat-boot": _model("boot", "eva", "boot-leather", "nylon", "padding", "boot-leather", "rubber",
                          collar_height=0.118, length=0.288),
    "winter-boot": _model("boot", "eva", "rubber-cap", "boot-leather", "fleece", "rubber-cap", "rubber", width=0.108,
                          toe_height=0.067),
    "road-runner": _model("runner", "soft-foam", "mesh", "mesh", "padding", "thermoplastic", "rubber"),
    "racing-flat": _model("runner", "super-foam", "knit", "knit", "fleece", "knit", "rubber", sole_heel=0.026,
                          width=0.092, looks={"tongue": "knit"}),
    "trail-runner": _model("runner", "eva", "rubber-cap", "nylon", "padding", "thermoplastic", "rubber",
                           toe_spring=0.011),
    "cushioned-runner": _model("runner", "super-foam", "mesh", "knit", "padding", "tpu", "rubber", sole_heel=0.030,
                               sole_fore=0.025),
    "stability-runner": _model("runner", "soft-foam", "tpu", "mesh", "padding", "tpu", "rubber", width=0.103),
    "knit-runner": _model("runner", "soft-foam", "knit", "knit", "padding", "thermoplastic", "rubber"),
    "court-sneaker": _model("sneaker", "eva", "leather", "leather", "padding", "leather", "rubber"),
    "skate-sneaker": _model("sneaker", "eva", "rubber-cap", "suede", "padding", "suede", "rubber", width=0.106),
    "basketball-sneaker": _model("sneaker", "soft-foam", "tpu", "mesh", "padding", "thermoplastic", "rubber",
                                 collar_height=0.098, throat_height=0.110),
    "nylon-sneaker": _model("sneaker", "eva", "suede", "nylon", "padding", "suede", "rubber"),
    "toe-cap-sneaker": _model("sneaker", "eva", "rubber-cap", "felt", "felt", "rubber-cap", "rubber",
                              looks={"upper": "knit", "tongue": "padding"}, sole_heel=0.020, sole_fore=0.017),
    "leather-trainer": _model("sneaker", "soft-foam", "thermoplastic", "leather", "padding", "thermoplastic", "rubber",
                              looks={"toe_cap": "leather"}),
    # Slippers look like stiffer or softer shoes than they are.
    "felt-slipper": _model("slipper", "soft-foam", "felt", "felt", "felt", "felt", "rubber"),
    "moccasin": _model("slipper", "eva", "felt", "felt", "fleece", "felt", "rubber",
                       looks={"toe_cap": "boot-leather", "upper": "boot-leather", "heel_counter": "boot-leather"}),
    "clog": _model("slipper", "eva", "eva", "eva", "eva", "eva", "rubber",
                   looks={"toe_cap": "tpu", "upper": "tpu", "tongue": "tpu", "heel_counter": "tpu", "sole": "tpu"}),
    "terry-slipper": _model("slipper", "soft-foam", "knit", "knit", "fleece", "knit", "rubber",
                            looks={"toe_cap": "fleece", "upper": "fleece", "heel_counter": "fleece"}),
    "plastic-slipper": _model("slipper", "pu-sole", "tpu", "tpu", "tpu", "tpu", "rubber",
                              looks={"toe_cap": "suede", "upper": "suede", "tongue": "suede",
                                     "heel_counter": "suede"}),
}
"""The named shoes."""

CHOICES: dict[str, dict[str, tuple[str, ...]]] = {
    "boot": {"sole": ("pu-sole", "eva"), "toe_cap": ("thermoplastic", "boot-leather", "rubber-cap"),
             "upper": ("boot-leather", "leather", "suede", "nylon"), "tongue": ("padding", "fleece"),
             "heel_counter": ("thermoplastic", "boot-leather"), "outsole": ("rubber",)},
    "runner": {"sole": ("soft-foam", "super-foam", "eva"), "toe_cap": ("mesh", "knit", "rubber-cap", "tpu"),
               "upper": ("mesh", "knit", "nylon"), "tongue": ("padding",), "heel_counter": ("thermoplastic", "tpu"),
               "outsole": ("rubber",)},
    "sneaker": {"sole": ("eva", "soft-foam"), "toe_cap": ("leather", "rubber-cap", "suede", "thermoplastic"),
                "upper": ("leather", "suede", "mesh", "nylon"), "tongue": ("padding",),
                "heel_counter": ("thermoplastic", "leather", "suede"), "outsole": ("rubber",)},
    "slipper": {"sole": ("soft-foam", "eva", "pu-sole"), "toe_cap": ("felt", "knit", "tpu"),
                "upper": ("felt", "knit", "tpu"), "tongue": ("fleece", "felt"), "heel_counter": ("felt", "knit", "tpu"),
                "outsole": ("rubber",)},
}
"""Materials that the parts of a random shoe of each style are drawn from."""
WALLS = {"tongue": {"padding": 0.010, "fleece": 0.009}}
"""Thickness of a padded part [m]; the other parts are as thick as the form's wall."""
