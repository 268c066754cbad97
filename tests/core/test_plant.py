"""What a plant refuses, and that what lies on a limit is accepted."""

import numpy as np
import pytest

from vsfsim.core.errors import SceneError
from vsfsim.core.plant import Plant

LENGTH, THICK = 0.1, 0.003


def plant(**more):
    """A stem of two round segments with a blade at its end."""
    nodes = np.array([[0, 0, 0], [0, 0, LENGTH], [0, 0, 2 * LENGTH], [LENGTH, 0, 2 * LENGTH]], float)
    values = {"nodes": nodes, "parent": np.array([-1, 0, 1, 2]), "radius": np.full(4, THICK),
              "half_width": np.array([0, 0, 0, 0.01]), "blade_normal": np.tile([0.0, 0.0, 1.0], (4, 1)),
              "young_modulus": np.full(4, 1e9), "density": np.full(4, 500.0), "region": np.zeros(4, int),
              "region_names": ("stem",)}
    return Plant(**{**values, **more})


def with_entry(name, index, value):
    array = np.array(getattr(plant(), name), float)
    array[index] = value
    return plant(**{name: array})


def core(share):
    """Cores that take a share of the bending stiffness E I of their round segment or blade."""
    second = np.array([0, 0.25 * np.pi * THICK**4, 0.25 * np.pi * THICK**4, 4 / 3 * 0.01 * THICK**3])
    return np.column_stack([share * 1e9 * second, np.full(4, 0.01)])


def test_a_core_is_at_most_as_stiff_as_its_segment():
    assert plant(yielding=core(1.0)).yielding is not None
    for segment in (1, 2, 3):
        stiffer = core(0.5)
        stiffer[segment] = core(1.001)[segment]
        with pytest.raises(SceneError, match=f"bending stiffness of the core of segment {segment} is"):
            plant(yielding=stiffer)


@pytest.mark.parametrize(("name", "good", "bad"), [
    ("radius", (1e-5, 1.0), (0.99e-5, 1.01)), ("young_modulus", (1.0, 1e13), (0.99, 1.01e13)),
    ("half_width", (0.0,), (-1e-9,)), ("density", (0.0,), (-1e-9,))])
@pytest.mark.parametrize("segment", [1, 2])
def test_every_segment_is_held_to_its_limits(name, good, bad, segment):
    for value in good:
        with_entry(name, segment, value)
    for value in (*bad, np.nan):
        with pytest.raises(SceneError, match="plant: "):
            with_entry(name, segment, value)


def test_poissons_ratio_is_below_a_half():
    assert plant(poisson_ratio=0.4999)
    with pytest.raises(SceneError, match="Poisson's ratio of segment 1"):
        plant(poisson_ratio=0.5)


def test_entry_0_of_a_segments_array_is_not_read():
    for name in ("radius", "young_modulus", "density"):
        with_entry(name, 0, -1.0)


def test_a_blades_normal_is_a_unit_vector_across_it():
    for normal in ([0.0, 0.0, 1.01], [0.01, 0.0, 1.0], [1.0, 0.0, 0.0]):
        with pytest.raises(SceneError, match="normal of a blade"):
            with_entry("blade_normal", 3, normal)
    with_entry("blade_normal", 2, [0.0, 0.0, 5.0])  # of a round segment it says nothing


def test_a_parent_comes_before_its_child():
    for parent in (2, 3, -1):
        with pytest.raises(SceneError, match="the parent of segment 2 is"):
            plant(parent=np.array([-1, 0, parent, 2]))


def test_turning_keeps_lengths_and_normals():
    turned = plant().turned(0.7)
    assert np.allclose(turned.lengths(), plant().lengths(), rtol=1e-12)
    assert np.allclose(turned.nodes[3], [LENGTH * np.cos(0.7), LENGTH * np.sin(0.7), 2 * LENGTH], atol=1e-12)
