"""Structured meshes: orientation, boundary, shape quality."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
import trimesh

from vsfsim.core.errors import SceneError
from vsfsim.core.scene import parse_scene
from vsfsim.core.shape import Box, Cylinder, Rod, Sphere
from vsfsim.core.solid import Solid, smallest_sine, tet_volumes
from vsfsim.physics.mesh.discretise import beside_supports, build_solid

SPEC = parse_scene('[object]\nshape = { box = [0.1, 0.1, 0.05] }\nyoung_modulus = 1e5\n', "test.toml").sample(0).object

SHAPES = {
    "box": (Box((0.1, 0.1, 0.05)), 0.02, 0.1 * 0.1 * 0.05),
    "odd box": (Box((0.1, 0.03, 0.07)), 0.021, 0.1 * 0.03 * 0.07),
    "sphere": (Sphere(0.04), 0.012, 4 / 3 * math.pi * 0.04**3),
    "cylinder": (Cylinder(0.03, 0.08), 0.012, math.pi * 0.03**2 * 0.08),
    "rod": (Rod(0.4, 0.006), 0.01, math.pi * 0.006**2 * 0.4),
}


def solid_of(shape: object, resolution: float, **options: object) -> Solid:
    return build_solid(dataclasses.replace(SPEC, shape=shape), resolution=resolution, **options)


def check_boundary(solid: Solid, *, euler: int = 2) -> None:
    """Watertight, wound outwards, each edge in two faces, the faces at each vertex one fan."""
    faces, owner = solid.surface()
    surface = trimesh.Trimesh(solid.vertices, faces, process=False)
    assert surface.is_watertight and surface.is_winding_consistent
    # rounding of a sum of some thousand volumes
    assert surface.volume == pytest.approx(solid.volume(), rel=1e-9)
    used = np.unique(faces)
    assert len(used) - len(surface.edges_unique) + len(faces) == euler
    assert (np.sort(faces, axis=1)[:, :, None] == np.sort(solid.tets[owner], axis=1)[:, None, :]).any(axis=2).all()
    # Vertex-manifold: around each vertex the faces form one closed fan, not two that touch at a point.
    link: dict[int, dict[int, int]] = {}
    for a, b, c in faces.tolist():
        for v, start, stop in ((a, b, c), (b, c, a), (c, a, b)):
            link.setdefault(v, {})[start] = stop
    for v, fan in link.items():
        start = next(iter(fan))
        seen, at = 1, fan[start]
        while at != start:
            seen, at = seen + 1, fan[at]
        assert seen == len(fan), f"vertex {v} joins {len(fan)} faces in more than one fan"


@pytest.mark.parametrize("name", SHAPES)
def test_mesh_is_whole(name: str) -> None:
    shape, resolution, volume = SHAPES[name]
    solid = solid_of(shape, resolution)
    assert tet_volumes(solid.vertices, solid.tets).min() > 0.0
    assert len(np.unique(solid.tets)) == len(solid.vertices), "a vertex belongs to no tetrahedron"
    check_boundary(solid)
    again = solid_of(shape, resolution)
    assert np.array_equal(solid.vertices, again.vertices) and np.array_equal(solid.tets, again.tets)
    # The cube's corner tetrahedron has 54.7 degrees; the rod's cells are three times longer than wide, on purpose.
    assert smallest_sine(solid.vertices, solid.tets).min() > math.sin(math.radians(12.0 if name == "rod" else 30.0))
    assert solid.vertices[:, 2].min() == pytest.approx(0.0, abs=1e-15)
    assert 0.7 * volume < solid.volume() <= volume * (1.0 + 1e-12)


def test_box_is_symmetric() -> None:
    # A mirrored mesh is the same mesh: same edges under x -> -x, so no sideways force under a centred press.
    solid = solid_of(Box((0.1, 0.1, 0.05)), 0.03)
    key = {tuple(np.round(p, 9)): i for i, p in enumerate(solid.vertices + 0.0)}
    mirror = np.array([key[tuple(np.round(p * [-1, 1, 1], 9) + 0.0)] for p in solid.vertices])
    original, mirrored = ({tuple(sorted(row)) for row in t.tolist()} for t in (solid.tets, mirror[solid.tets]))
    assert mirrored == original


def test_focus_grades_the_box() -> None:
    block, focus = Box((0.1, 0.1, 0.05)), np.array([[0.0, 0.0, 0.05]])
    graded, uniform = solid_of(block, 0.004, focus=focus), solid_of(block, 0.004)
    assert len(graded.tets) < 0.35 * len(uniform.tets)
    assert graded.volume() == pytest.approx(0.1 * 0.1 * 0.05, rel=1e-12)
    check_boundary(graded)


def test_a_box_that_holds_a_body_ends_at_layers_of_its_elements() -> None:
    rng = np.random.default_rng(0)
    for shape, axis in [(SPEC.shape, 0), (SPEC.shape, 2), (Cylinder(0.03, 0.08), 2)] * 30:
        size, fixed = rng.uniform(0.006, 0.025), np.outer([-1.0, 1.0], np.ones(3))
        plain, near = solid_of(shape, size).vertices, 0.1 * size
        low, high = plain[[0, -1], axis]
        ends = np.sort(rng.uniform(low + near, high - 2.0 * near, 2))
        first, last = fixed[:, axis] = ends + [-rng.integers(2), near]  # half of them cut the body once
        spec = dataclasses.replace(SPEC, shape=shape, fixed=tuple(fixed.ravel()))
        levels = solid_of(shape, size, parts=beside_supports(spec, plain, size)).vertices[:, axis]
        held = levels[(levels > first - 1e-9) & (levels < last + 1e-9)]
        assert held.min() - max(first, low) < near and last - held.max() < near
    # a layer ends there
    spec = dataclasses.replace(spec, fixed=(-1.0, -1.0, -1.0, 1.0, 1.0, 0.04))
    assert not len(beside_supports(spec, solid_of(shape, 0.02).vertices, 0.02))


def test_refusals() -> None:
    with pytest.raises(SceneError, match="cells"):
        solid_of(Box((1.0, 1.0, 1.0)), 0.001)
