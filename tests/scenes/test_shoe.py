"""The shoe: whole and well shaped over all its parameters, the same for the same seed, and what its regions mean."""

from __future__ import annotations

import math

import numpy as np
import pytest
import trimesh

from vsfsim.core.errors import SceneError
from vsfsim.core.solid import TEXTURES, Solid, smallest_sine, tet_volumes
from vsfsim.physics.mesh.validity import body_of_each_tet, pinched_vertices
from vsfsim.scenes import shoe
from vsfsim.scenes._materials import CLASSES, SOLE_MATERIAL, TEXTURED, draw_appearance
from vsfsim.scenes._shoe_styles import RANGES, REGIONS, STYLES

# Degrees. 200 draws over the full range of every parameter gave 5.7 at least.
WORST = 5.0


def make(seed: int = 0, *, resolution: float = 0.016, **parameters: object) -> Solid:
    return shoe.build(parameters, np.random.default_rng(seed), resolution=resolution, where="test")


def test_no_inverted_tets_over_all_parameters() -> None:
    rng = np.random.default_rng(7)
    for number in range(12):
        form = {name: float(rng.uniform(*span)) for name, span in RANGES.items()}
        solid = make(number, resolution=(0.016, 0.012)[number % 2], style=list(STYLES)[number % 4],
                     side=("left", "right")[number // 2 % 2], **form)
        assert tet_volumes(solid.vertices, solid.tets).min() > 0.0, form
        assert smallest_sine(solid.vertices, solid.tets).min() > math.sin(math.radians(WORST)), form
        assert not len(pinched_vertices(solid.tets))


@pytest.mark.parametrize("style", STYLES)
def test_boundary_is_one_sphere(style: str) -> None:
    solid = make(1, style=style)
    faces, _ = solid.surface()
    surface = trimesh.Trimesh(solid.vertices, faces, process=False)
    assert surface.is_watertight and surface.is_winding_consistent and surface.body_count == 1
    # The cavity is open to the outside through the collar: topologically a ball.
    assert surface.euler_number == 2
    assert surface.volume == pytest.approx(solid.volume(), rel=1e-9)
    assert len(np.unique(solid.tets)) == len(solid.vertices)


def test_it_is_hollow_and_its_walls_are_as_thick_as_asked() -> None:
    solid, half = (make(3, style="sneaker", wall=wall, variation=0.0) for wall in (0.006, 0.003))
    hull = trimesh.Trimesh(solid.vertices, solid.surface()[0], process=False).convex_hull
    assert solid.volume() < 0.55 * hull.volume
    thick, thin = (tet_volumes(s.vertices, s.tets[s.region == REGIONS.index("upper")]).sum() for s in (solid, half))
    assert thick == pytest.approx(2.0 * thin, rel=0.15)


def test_regions_lie_where_they_should() -> None:
    solid = make(2, style="sneaker")
    assert solid.region_names == REGIONS
    middle = solid.vertices[solid.tets].mean(axis=1)
    low, high = solid.vertices.min(axis=0), solid.vertices.max(axis=0)
    assert low[2] == 0.0 and low[:2] == pytest.approx(-high[:2])
    of = {name: middle[solid.region == number] for number, name in enumerate(REGIONS)}
    assert all(len(points) for points in of.values())
    assert of["toe_cap"][:, 0].min() > 0.5 * high[0] and of["heel_counter"][:, 0].max() < 0.5 * low[0]
    assert of["sole"][:, 2].max() < 0.035 < of["tongue"][:, 2].min()
    assert np.abs(of["tongue"][:, 1]).max() < 0.3 * high[1]
    # Each region is in one piece.
    for number in range(len(REGIONS)):
        assert body_of_each_tet(solid.tets[solid.region == number]).max() == 0
    # It stands on more than a point.
    assert (solid.vertices[:, 2] < 1e-6).sum() >= 30


def test_a_finer_mesh_is_of_the_same_shoe() -> None:
    coarse, fine = (make(4, style="runner", resolution=h) for h in (0.016, 0.008))
    for number, name in enumerate(REGIONS):
        volumes = [tet_volumes(s.vertices, s.tets[s.region == number]).sum() for s in (coarse, fine)]
        # Chords of curved walls; borders of regions do not move.
        assert volumes[0] == pytest.approx(volumes[1], rel=0.12), name


def test_same_seed_same_shoe_and_other_seed_another() -> None:
    one, two, other = make(5, style="boot"), make(5, style="boot"), make(6, style="boot")
    for a, b in ((one.vertices, two.vertices), (one.tets, two.tets), (one.young_modulus, two.young_modulus),
                 (one.appearance.albedo, two.appearance.albedo)):
        assert np.array_equal(a, b)
    assert one.notes == two.notes
    assert not np.array_equal(one.young_modulus, other.young_modulus)
    # Fixing one parameter leaves the draws of all the others, and the materials, as they were.
    assert np.array_equal(make(5, style="boot", bend=0.001).young_modulus, one.young_modulus)
    # The mesh may be refined without changing what the shoe is made of.
    assert np.array_equal(make(5, style="boot", resolution=0.012).young_modulus, one.young_modulus)


def test_moduli_follow_their_classes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(shoe, "improve_rank", lambda vertices, hexes, rank: rank)  # of the mesh alone
    drawn = np.array([make(seed, style=style, resolution=0.03).young_modulus for style in STYLES for seed in range(20)])
    e = dict(zip(REGIONS, drawn.T))
    assert (e["sole"] >= 1e6).all() and (e["sole"] <= 1e7).all()
    assert (e["tongue"] >= 1e4).all() and (e["tongue"] <= 5e5).all()
    assert (e["toe_cap"] > e["upper"]).all() and (e["heel_counter"] > e["upper"]).all()
    assert np.ptp(np.log10(e["sole"])) > 0.8


def test_appearance_goes_with_the_material_but_not_perfectly() -> None:
    names = ["leather"] * 2000
    low, high = CLASSES["leather"].young_modulus
    modulus = np.geomspace(low, high, len(names))
    look = draw_appearance(names, modulus, 0.8, np.random.default_rng(0))
    assert set(look.texture) <= set(TEXTURES) and look.albedo.min() > 0.0 and look.albedo.max() <= 1.0
    # Own class in 0.8 of draws, and one of seven in the rest; only leather is grained. Four sigma of 2000 draws.
    p = 0.8 + 0.2 / len(CLASSES)
    assert np.mean([t == "grain" for t in look.texture]) == pytest.approx(p, abs=4 * math.sqrt(p * (1 - p) / 2000))
    brightness = np.log(look.albedo.mean(axis=1))
    correlation = np.corrcoef(np.log(modulus), brightness)[0, 1]
    assert -0.6 < correlation < -0.1
    sure = draw_appearance(names, modulus, 1.0, np.random.default_rng(0))
    assert set(sure.texture) == {"grain"}


def test_shoes_of_any_material_tell_it_by_texture_and_by_nothing_else(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(shoe, "improve_rank", lambda vertices, hexes, rank: rank)  # of the mesh alone
    moduli, bright, contrast, shoes = [], [], [], 90
    for seed in range(shoes):
        solid = make(seed, resolution=0.03, materials="any", appearance_informative=1.0)
        look = solid.appearance
        for region, modulus in enumerate(solid.young_modulus):
            (name,) = {c for c, m in TEXTURED.items() if m.young_modulus[0] <= modulus <= m.young_modulus[1]
                       and (c == SOLE_MATERIAL) == (REGIONS[region] == "sole")}
            assert look.texture[region] == TEXTURED[name].texture
        moduli.append(np.log(solid.young_modulus[1:]))
        bright.append(np.log(look.albedo.mean(axis=1))[1:])
        contrast.append(look.texture_contrast[1:])
        # One colour a shoe, give or take a tenth.
        assert np.ptp(np.log(look.albedo), axis=0).max() < 0.8
    moduli, bright, contrast = (np.array(x) for x in (moduli, bright, contrast))
    # Four sigma of the shoes, whose parts are drawn alone.
    assert abs(np.corrcoef(moduli.ravel(), bright.ravel())[0, 1]) < 4.0 / math.sqrt(shoes)
    assert np.abs(moduli.mean(axis=0) - moduli.mean()).max() < 4.0 * moduli.std() / math.sqrt(
        shoes), "no part is softer than another"
    assert np.corrcoef(moduli.ravel(), contrast.ravel())[0, 1] < -0.8
    # Two parts are of the shoe's own class in 0.8^2 of the shoes; classes follow each other on a scale that each fills
    # a fifth of.
    assert 0.4 < np.corrcoef(moduli[:, 0], moduli[:, 1])[0, 1] < 0.85


def test_refusals() -> None:
    with pytest.raises(SceneError, match=r"length is 26; it must be a number from 0.22 to 0.3"):
        make(length=26)
