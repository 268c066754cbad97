"""The family of plants: every species, what its looks tell, and the size of the papers' dataset."""

import numpy as np
import pytest

from vsfsim.core.scene import load_scene
from vsfsim.core.shelf import find_scene
from vsfsim.scenes._plant_species import SPECIES
from vsfsim.scenes.plant import grow


def test_every_species_grows_and_they_differ():
    sizes, soft = {}, {}
    for name in SPECIES:
        plants = [grow({"species": name}, np.random.default_rng(k), where="test") for k in range(2)]
        for p in plants:
            assert 50 <= len(p.nodes) - 1 <= 500, name
            assert p.nodes[:, 2].min() >= 0.02 - 1e-9 and p.pot is not None
            assert len(p.appearance.texture) == p.look.max() + 1
            petiole = p.young_modulus[1:][p.region[1:] == 2]
            branch = p.young_modulus[1:][p.region[1:] == 1]
            # the ranges, and three standard deviations of what an axis varies along itself
            assert not len(petiole) or (petiole.min() > 0.5e6 and petiole.max() < 4e8)
            assert not len(branch) or (branch.min() > 0.5e8 and branch.max() < 2e10)
        assert not np.array_equal(plants[0].young_modulus, plants[1].young_modulus)
        sizes[name] = len(plants[0].nodes), plants[0].nodes[:, 2].max()
        soft[name] = np.median(plants[0].young_modulus)
    assert len(SPECIES) == 12 and len(set(sizes.values())) == 12 and max(soft.values()) > 10 * min(soft.values())
    again = grow({"species": "olive"}, np.random.default_rng(0), where="test")
    assert (again.nodes == grow({"species": "olive"}, np.random.default_rng(0), where="test").nodes).all()
    order = [grow({"species": "by-object"}, np.random.default_rng(0), where="test",
                  number=k).notes[0].split(":")[0] for k in range(12)]
    assert order == list(SPECIES)


def test_looks_tell_of_stiffness_but_not_surely():
    """Brightness and ln E of branches of many plants correlate, and less so where the scene says that looks tell
    less."""
    def correlation(informative):
        light, stiff = [], []
        for k in range(12):
            p = grow({"species": "olive", "appearance_informative": informative, "leaves": False},
                     np.random.default_rng(k), where="test")
            axes, first = np.unique(p.look[1:], return_index=True)
            branch = p.region[1:][first] == 1
            light += list(np.log(p.appearance.albedo[axes[branch]].mean(axis=1)))
            stiff += list(np.log(p.young_modulus[1:][first][branch]))
        return np.corrcoef(light, stiff)[0, 1]

    assert -0.95 < correlation(0.8) < -0.4 and abs(correlation(0.0)) < 0.25


def test_the_full_scene_has_the_papers_size():
    """SBML appendix B.1: 12 plants, 4 views by turning them, 50 to 70 touches of each, up to about 250 readings, a
    depth camera's noise; 3,255 touches and 807,103 readings in all."""
    scene = load_scene(find_scene("plants")).sample(0)
    assert (scene.dataset.objects == 12 and scene.dataset.views == 4
            and 50 <= scene.touches.count <= 70)
    touches = 12 * 4 * scene.touches.count
    assert touches == pytest.approx(3255, rel=0.01)
    assert touches * sum(scene.touches.frames) == pytest.approx(807_103, rel=0.01)
    assert scene.camera.noise == "kinect" and scene.camera.width == 640
    assert scene.object.shape.parameters["species"] == "by-object"
