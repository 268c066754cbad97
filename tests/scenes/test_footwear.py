"""Footwear: whole over all its shoes, made of the materials that it names, and of the elastic laws that they have."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from vsfsim.core.errors import SceneError
from vsfsim.core.scene import load_scene, parse_scene
from vsfsim.core.shelf import scenes
from vsfsim.core.solid import Solid, smallest_sine, tet_volumes
from vsfsim.physics import tiers
from vsfsim.physics.mesh.validity import body_of_each_tet, pinched_vertices
from vsfsim.scenes import footwear
from vsfsim.scenes._footwear_materials import CHOICES, MATERIALS, MODELS, PARTS, modulus_of

WORST = 8.0  # degrees; two draws of every shoe gave 9.6 at least


def make(seed: int = 0, *, resolution: float = 0.018, **parameters: object) -> Solid:
    return footwear.build(parameters, np.random.default_rng(seed), resolution=resolution, where="test")


def test_there_are_23_shoes_of_four_classes_and_slippers_mislead() -> None:
    styles = [m.style for m in MODELS.values()]
    assert len(MODELS) == 23 and {s: styles.count(s) >= 5 for s in CHOICES} == dict.fromkeys(CHOICES, True)
    # a slipper that looks like a boot is an order of magnitude softer than one
    slipper, boot = MODELS["moccasin"], MODELS["work-boot"]
    assert slipper.looks["upper"] == boot.materials[PARTS.index("upper")] == "boot-leather"
    soft, stiff = (make(0, model=name).young_modulus[PARTS.index("upper")] for name in ("moccasin", "work-boot"))
    assert stiff > 10.0 * soft


@pytest.mark.parametrize("model", MODELS)
def test_every_shoe_is_whole(model: str) -> None:
    solid = make(1, model=model)
    assert tet_volumes(solid.vertices, solid.tets).min() > 0.0 and not len(pinched_vertices(solid.tets))
    assert smallest_sine(solid.vertices, solid.tets).min() > math.sin(math.radians(WORST))
    assert solid.region_names == PARTS and set(np.unique(solid.region)) == set(range(len(PARTS)))
    for part in range(len(PARTS)):
        assert body_of_each_tet(solid.tets[solid.region == part]).max() == 0
    middle = solid.vertices[solid.tets].mean(axis=1)[:, 2]
    assert middle[solid.region == PARTS.index("outsole")].max() < middle[solid.region == PARTS.index("sole")].max()


def test_a_wall_has_the_point_stiffness_of_its_sheet() -> None:
    # 4 E t^2 / (R sqrt(3 (1 - nu^2))) at R = 40 mm: leather of 1.4 mm 4 to 10 N/mm, a thermoplastic cap 13 to 90
    def stiffness(name: str, share: float) -> float:
        wall = 0.006
        nu = MATERIALS[name].poisson_ratio
        return 4.0 * modulus_of(name, wall, (share, 0.5)) * wall**2 / (0.04 * math.sqrt(3.0 * (1.0 - nu**2)))

    low, _ = MATERIALS["leather"].young_modulus
    assert stiffness("leather", 0.0) == pytest.approx(4.0 * low * 0.0014**2 / (0.04 * math.sqrt(3.0 * 0.84)))
    assert stiffness("leather", 0.5) / 1e3 == pytest.approx(6.0, rel=0.2)
    assert stiffness("knit", 0.5) < 500.0 < 1500.0 < stiffness("suede", 0.5) < stiffness("leather", 0.5)
    assert 10e3 < stiffness("thermoplastic", 0.0) < stiffness("thermoplastic", 1.0) < 93e3


def test_a_lined_wall_has_the_bending_stiffness_of_a_sandwich() -> None:
    wall, share = 0.006, (0.5, 0.5)
    for name, material in MATERIALS.items():
        bare, lined = modulus_of(name, wall, share), modulus_of(name, wall, share, lined=True)
        assert (lined > bare) == (material.lining > 0.0) and lined >= bare
    # a knit of 3.46 MPa and 1.4 mm: D = E t^3 / 12 + 0.7 h^2 / (1 / E t + 1 / 3000), and the wall has sqrt(12 D E t)
    tension = math.sqrt(2e6 * 6e6) * 0.0014
    bending = tension * 0.0014**2 / 12.0 + 0.7 * 0.003**2 / (1.0 / tension + 1.0 / 3000.0)
    assert modulus_of("knit", wall, share, lined=True) == pytest.approx(math.sqrt(12.0 * bending * tension) / wall**2)
    # a lining far stiffer than the sheet cannot bend less than both faces of a sandwich do without shear
    assert modulus_of("knit", wall, share, lined=True) < math.sqrt(12.0 * tension**2 * (0.0014**2 / 12 + 0.003**2)) / (
        wall**2)
    soft, firm = make(2, model="knit-runner"), make(2, model="knit-runner", lined=True)
    assert np.array_equal(soft.vertices, firm.vertices)
    ratio = firm.young_modulus / soft.young_modulus
    for part in ("sole", "tongue", "heel_counter", "outsole"):
        assert ratio[PARTS.index(part)] == 1.0
    assert 2.5 < ratio[PARTS.index("upper")] < 7.0, "thin soft knits gain most"


def test_parts_of_one_material_are_of_one_sheet_and_the_seed_decides() -> None:
    felt = make(3, model="felt-slipper")
    own = [felt.young_modulus[PARTS.index(part)] for part in ("toe_cap", "upper", "heel_counter")]
    assert own[0] == own[1] == own[2]
    again, other = make(3, model="felt-slipper"), make(4, model="felt-slipper")
    assert np.array_equal(felt.vertices, again.vertices) and np.array_equal(felt.young_modulus, again.young_modulus)
    assert np.array_equal(felt.appearance.albedo, again.appearance.albedo)
    assert not np.array_equal(felt.young_modulus, other.young_modulus)


def test_each_part_has_its_own_law_in_the_model() -> None:
    text = """
    gravity = [0.0, 0.0, -9.81]
    [object]
    resolution = 0.03
    [object.shape]
    family = "footwear"
    model = "racing-flat"
    """
    scene = parse_scene(text, Path("t.toml")).sample(0)
    model = tiers.build(scene, "fem-coarse", seed=0)
    region = np.asarray(model.solid.region)
    foams = [law.foam for law in model.solid.laws]
    assert [foam is not None for foam in foams] == [True, False, False, True, False, False]
    assert {block.law for block in model.blocks} == {"neo-hooke", "hyperfoam"}
    assert sum(len(block) for block in model.blocks) == len(region) and len(model.blocks) == 3
    rigid = next(block for block in model.blocks if block.law == "neo-hooke")
    assert len(rigid) == np.isin(region, [r for r, foam in enumerate(foams) if foam is None]).sum()
    # the weight is that of parts of different density
    volume = tet_volumes(model.solid.vertices, model.solid.tets)
    density = np.array([law.density for law in model.solid.laws])[region]
    assert -model.load.sum() == pytest.approx(9.81 * (density * volume).sum())
    assert 0.12 < (density * volume).sum() < 0.6, "a shoe weighs 0.1 to 0.6 kg"
    # the linear tier takes foams at small strain
    assert {block.law for block in tiers.build(scene, "linear", seed=0).blocks} == {"neo-hooke"}


def test_the_datasets_have_each_shoe_once() -> None:
    for name, count in (("shoes-v2-mini", 12), ("shoes-v2-punyo-mini", 12)):
        written = load_scene(scenes()[name])
        shoes = [written.sample(0, number=k).object.shape.parameters["model"] for k in range(count)]
        assert len(set(shoes)) == count <= len(MODELS) and set(shoes) <= set(MODELS)
        assert written.sample(0).dataset.objects == count
        styles = [MODELS[shoe].style for shoe in shoes]
        assert min(styles.count(style) for style in CHOICES) >= 2


def test_refusals() -> None:
    with pytest.raises(SceneError, match="whose style is 'boot'; take style out"):
        make(model="work-boot", style="runner")
    with pytest.raises(SceneError, match=r"cells of 0.004 to 0.03 m"):
        make(resolution=0.1)


def test_a_named_shoe_looks_as_its_model_says() -> None:
    for name in ("work-boot", "clog"):
        model = MODELS[name]
        for seed in range(5):
            look = make(seed, model=name, resolution=0.03).appearance
            for part, material, texture in zip(PARTS, model.materials, look.texture):
                assert texture == MATERIALS[model.looks.get(part, material)].texture
