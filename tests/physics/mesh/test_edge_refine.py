"""Elements divided along the edges of a probe: conforming, sound, small where asked for and nowhere else."""


import numpy as np
import pytest
import trimesh

from vsfsim.core.shape import Box
from vsfsim.core.solid import Solid, smallest_sine, tet_volumes
from vsfsim.physics.contact.body_samples import sharp_samples
from vsfsim.physics.mesh.edge_refine import GROWTH, EdgePath, refine_near
from vsfsim.physics.mesh.structured import ball, box

SIZE, CELL, SIDE = (0.06, 0.05, 0.03), 0.01, 0.013


def punch(top, depth=0.004, at=(0.002, 0.003)):
    """The way of a box's edges from 2 mm over a surface at height ``top`` to ``depth`` under it, in four steps."""
    spot = sharp_samples(Box((SIDE,) * 3), 0.001)[0] + [*at, top + 0.5 * SIDE]
    down = np.linspace(0.002, -depth, 5)[:, None, None] * np.array([0.0, 0.0, 1.0])
    return EdgePath(spot + down, np.full(len(spot), 0.5 * SIDE))


def conforming(solid):
    """Whether every face inside belongs to two tetrahedra, and the boundary is closed without a hanging node."""
    faces = np.sort(solid.tets[:, [[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]]].reshape(-1, 3), axis=1)
    surface = trimesh.Trimesh(solid.vertices, solid.surface()[0], process=False)
    return (np.unique(faces, axis=0, return_counts=True)[1] <= 2).all() and surface.is_watertight


@pytest.mark.parametrize("shape", ["box", "ball"])
def test_tetrahedra_are_small_along_the_edges_of_a_punch(shape):
    vertices, tets = box(SIZE, CELL) if shape == "box" else ball(0.03, CELL)
    top = vertices[:, 2].max()
    plain = Solid(vertices, tets, np.arange(len(tets)) % 2, ("even", "odd"))
    path = punch(top)
    fine, part = refine_near(plain, path, 0.25)
    assert part == 0.25 and conforming(fine) and fine.volume() == pytest.approx(plain.volume(), rel=1e-12)
    assert tet_volumes(fine.vertices, fine.tets).min() > 0.0
    # bisection of the longest edge keeps half of the smallest angle at the least
    assert smallest_sine(fine.vertices, fine.tets).min() > 0.5 * smallest_sine(vertices, tets).min()
    # regions keep their volume
    for r in (0, 1):
        assert tet_volumes(fine.vertices, fine.tets)[fine.region == r].sum() == pytest.approx(
            tet_volumes(vertices, tets)[plain.region == r].sum(), rel=1e-12)
    place, _ = path.meets(plain)
    assert len(place)
    corner = fine.vertices[fine.tets]
    longest = np.linalg.norm(corner[:, :, None] - corner[:, None], axis=3).max(axis=(1, 2))
    away = np.linalg.norm(corner[:, :, None] - place, axis=3).min(axis=(1, 2))
    size = 1.3 * 0.25 * 0.5 * SIDE
    assert (longest <= size + GROWTH * away + 1e-12).all() and longest[away > 0.025].max() > 0.9 * CELL
    assert len(tets) < len(fine.tets) < 7500
    some, part = refine_near(plain, path, 0.05)  # as small as there may be elements for
    assert part > 0.05 and len(fine.tets) < len(some.tets) <= 2 * len(tets) + 12_000


def test_a_centred_punch_leaves_the_mesh_its_mirror_image():
    """Edges of equal length were divided in the order of their numbers: a box punch in the middle of a block then had a
    sideways force of up to 5 % of the normal force in its first frame; now of 1e-9."""
    size = (0.06, 0.06, 0.03)
    vertices, tets = box(size, CELL)
    plain = Solid(vertices, tets, np.zeros(len(tets), int), ("body",))
    fine, _ = refine_near(plain, punch(size[2], at=(0.0, 0.0)), 0.25)
    assert len(fine.tets) > len(tets)
    known = {tuple(sorted(t)) for t in fine.tets.tolist()}
    for axis in (0, 1):
        mirrored = fine.vertices.copy()
        mirrored[:, axis] *= -1.0
        away = np.linalg.norm(mirrored[:, None] - fine.vertices[None], axis=2)
        assert away.min(axis=1).max() < 1e-12
        assert {tuple(sorted(t)) for t in away.argmin(axis=1)[fine.tets].tolist()} == known
