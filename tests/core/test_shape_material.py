"""Shapes and Young's modulus as a scene names them."""


import numpy as np
import pytest

from vsfsim.core.errors import SceneError
from vsfsim.core.material import Inclusion, parse_material
from vsfsim.core.shape import (
    Box,
    Capsule,
    Cylinder,
    Family,
    MeshFile,
    Plane,
    Rod,
    Sphere,
    parse_object_shape,
    parse_probe_shape,
    probe_table,
)


@pytest.mark.parametrize(("table", "shape"), [
    ({"box": [0.1, 0.2, 1]}, Box((0.1, 0.2, 1.0))), ({"sphere": 0.02}, Sphere(0.02)),
    ({"cylinder": [0.01, 0.03]}, Cylinder(0.01, 0.03)),
    ({"rod": [0.2, 0.006]}, Rod(0.2, 0.006)), ({"mesh": "a.obj"}, MeshFile("a.obj")),
    ({"mesh": "a.obj", "scale": 0.01}, MeshFile("a.obj", 0.01)),
    ({"family": "shoe", "length": 0.26}, Family("shoe", {"length": 0.26})),
])
def test_object_shapes(table, shape):
    assert parse_object_shape(table, "x") == shape


@pytest.mark.parametrize("shape", [Sphere(0.02), Capsule(0.01, 0.05), Cylinder(0.01, 0.03), Box((0.1, 0.2, 0.3)),
                                   Plane()])
def test_a_probe_survives_its_table(shape):
    assert parse_probe_shape(probe_table(shape), "x") == shape


def test_distance_to_inclusions_and_their_thickness():
    ball = Inclusion("sphere", (0.1, 0.0, 0.0, 0.05), 1e6)
    assert ball.distance(np.array([[0.1, 0.0, 0.0], [0.1, 0.0, 0.05],
                                   [0.1, 0.13, 0.0]])) == pytest.approx([-0.05, 0.0, 0.08])
    # corners given in any order; outside the corner (3, 4, 0) away
    block = Inclusion("box", (1.0, 2.0, 3.0, -1.0, -2.0, -3.0), 1e6)
    assert block.distance(np.array([[0.0, 0.0, 0.0], [0.5, 0.0, 0.0], [1.0, 0.0, 0.0],
                                    [4.0, 6.0, 0.0]])) == pytest.approx([-1.0, -0.5, 0.0, 5.0])
    pill = Inclusion("capsule", (0.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.25), 1e6)
    assert pill.distance(np.array([[0.0, 0.0, 0.5], [1.0, 0.0, 0.3],
                                   [0.0, 0.0, 2.0]])) == pytest.approx([-0.25, 0.75, 0.75])
    assert (ball.thickness, block.thickness, pill.thickness) == (0.1, 2.0, 0.5)
    point = Inclusion("capsule", (0.0, 0.0, 1.0, 0.0, 0.0, 1.0, 0.25), 1e6)
    assert point.distance(np.zeros((1, 1, 3))) == pytest.approx(np.array([[0.75]]))


def test_the_last_inclusion_wins_and_regions_lie_under_them():
    parts = [{"sphere": [0, 0, 0, 0.02], "value": 1e6}, {"box": [0, -1, -1, 1, 1, 1], "value": 1e7}]
    field = parse_material({"base": 1e5, "inclusions": parts}, "x")
    at = np.array([[-0.01, 0.0, 0.0], [0.01, 0.0, 0.0], [-0.5, 0.0, 0.0]])
    assert field.evaluate(at).tolist() == [1e6, 1e7, 1e5]
    assert field.of_regions(np.array([3.0]), "x") is None, "the scene's base counts in all regions"
    modulus = parse_material(None, "x").of_regions(np.array([1e5, 2e6]), "x")
    assert modulus.tolist() == [1e5, 2e6]
    assert field.evaluate(at, np.array([1, 1, 1]), modulus).tolist() == [1e6, 1e7, 2e6]
    with pytest.raises(SceneError, match="x: young_modulus is missing, and the family gives none; give base = pascals"):
        parse_material(None, "x").of_regions(None, "x")
