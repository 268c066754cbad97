"""The 23 named shoes of the family `footwear`, of SBML's four classes: boots, running shoes, sneakers and slippers."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

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
