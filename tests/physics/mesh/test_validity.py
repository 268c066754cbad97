"""Tetrahedra that make no body: what is turned, what is left out, what is refused and why."""

import dataclasses

import numpy as np
import pytest

from vsfsim.core.errors import MeshError, SceneError
from vsfsim.core.solid import Solid, tet_volumes
from vsfsim.physics import model
from vsfsim.physics.mesh.quadratic import gauss_points
from vsfsim.physics.mesh.structured import box
from vsfsim.physics.mesh.validity import sound
from vsfsim.physics.model import build_model


def solid(vertices, tets):
    return Solid(np.asarray(vertices, float), np.asarray(tets), np.zeros(len(tets), int), ("body",))


@pytest.fixture
def block():
    return solid(*box((0.02, 0.02, 0.01), 0.01))


def held(body, modulus=1e5):
    values = modulus(gauss_points(body)) if callable(modulus) else np.full((len(body.tets), 4), modulus)
    return build_model(body, values, poisson_ratio=0.3, fixed="bottom", bottom_tolerance=1e-9, where="t.toml [object]")


def test_inverted_tetrahedra_are_turned_and_said(block):
    tets = block.tets.copy()
    tets[::3] = tets[::3][:, [0, 2, 1, 3]]
    wrong = dataclasses.replace(block, tets=tets)
    mended, turned = sound(wrong, "t")
    assert turned.sum() == len(tets[::3]) and tet_volumes(mended.vertices, mended.tets).min() > 0.0
    assert mended.notes == (f"{len(tets[::3])} of {len(tets)} tetrahedra were inside out; turned them round.",)
    # and each modulus stays where it was
    def field(x):
        return 1e5 * (1.0 + 50.0 * x[..., 0] + 80.0 * x[..., 2])

    model, right = held(wrong, field), held(block, field)
    assert model.young_modulus == pytest.approx(field(gauss_points(model.solid)), rel=1e-12)
    # summed in another order: rounding is all that may differ
    assert abs(model.factor.stiffness - right.factor.stiffness).max() < 1e-9 * abs(right.factor.stiffness).max()


def test_a_fold_is_refused_with_its_place(block):
    vertices = block.vertices.copy()
    # the middle of the top is pushed through the base
    middle = np.flatnonzero((np.abs(vertices[:, :2]) < 1e-9).all(axis=1) & (vertices[:, 2] > 0.009))
    vertices[middle, 2] = -0.01
    with pytest.raises(MeshError, match=r"t: \d+ of \d+ tetrahedra are folded over a neighbour.*Mesh the body again"):
        sound(dataclasses.replace(block, vertices=vertices), "t")
    with pytest.raises(MeshError, match="listed twice"):
        sound(solid(block.vertices, np.concatenate([block.tets, block.tets[:1]])), "t")


def test_flat_tetrahedra_and_bad_numbers_are_refused(block):
    with pytest.raises(MeshError, match="1 of 2 tetrahedra are flat"):
        sound(solid([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 0]], [[0, 1, 2, 3], [1, 4, 2, 0]]), "t")
    for vertices, tets in ((np.where(block.vertices == block.vertices.max(), np.nan, block.vertices), block.tets),
                           (block.vertices, block.tets + 1)):
        with pytest.raises(MeshError, match="do not exist or are not finite"):
            sound(solid(vertices, tets), "t")


def test_vertices_that_nothing_uses_are_left_out(block):
    model = held(solid(np.vstack([[[0.1, 0.1, 0.1]], block.vertices]), block.tets + 1))
    assert model.solid.notes == ("Left out 1 vertices that no tetrahedron uses.",)
    assert np.array_equal(model.solid.vertices, block.vertices)


def test_an_island_that_nothing_holds_is_refused_and_one_that_stands_is_kept(block):
    def two(shift):
        return solid(np.concatenate([block.vertices, block.vertices + shift]),
                     np.concatenate([block.tets, block.tets + len(block.vertices)]))

    with pytest.raises(SceneError,
                       match=r"t.toml \[object\]: fixed = 'bottom' holds 0 of \d+ nodes of one of 2 parts that no face "
                             r"joins, from \[0.\d+, .*join the parts"):
        held(two([0.05, 0.0, 0.02]))
    model = held(two([0.05, 0.0, 0.0]))
    right = np.random.default_rng(0).standard_normal((len(model.free), 1)) * model.free[:, None]
    assert np.isfinite(model.factor.solve(right)).all()


def test_a_part_on_a_hinge_is_refused():
    # two tetrahedra that share an edge: the second could turn about it
    vertices = [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0.3, 0.3, 1], [0.9, 0.9, 0.5], [0.6, 1.2, 0.8]]
    body = solid(vertices, [[0, 1, 2, 3], [1, 2, 5, 4]])
    mended, _ = sound(body, "t")
    with pytest.raises(SceneError, match=r"holds \d of \d+ nodes of one of 2 parts"):
        held(mended)


def test_a_mesh_that_cannot_be_factorised_is_refused(block, monkeypatch):
    """A block of 0.6 mm elements ended the process with a segmentation fault."""
    monkeypatch.setattr(model, "MOST_NODES", 40)
    with pytest.raises(SceneError, match=r"t.toml \[object\]: the mesh has \d+ nodes, and 40 are the most"):
        held(block)
    monkeypatch.setattr(model, "MOST_NODES", 10_000)
    held(block)
