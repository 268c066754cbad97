"""A law of contact that another package brings: the contact of rigid bodies takes it, and a scene names it."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch
import warp as wp
from texts import scene, text

import vsfsim
from vsfsim.core import shelf
from vsfsim.core.errors import SceneError
from vsfsim.core.scene import parse_scene
from vsfsim.core.shape import Plane
from vsfsim.physics import tiers
from vsfsim.physics.contact.bodies import RigidBodies
from vsfsim.physics.contact.law import CONTACT_LAWS, PENALTY, ContactLaw, contact_law_of
from vsfsim.physics.contact.rigid_contact import RigidContact
from vsfsim.physics.runtime import real


def asperities(module):
    """Hertzian asperities of one height h: f = w d (d / h)^(1/2), as stiff as the penalty at the depth h."""

    @wp.func(module=module)
    def push(w: real, share: real, soft: real, onset: real, depth: real, terms: wp.array(dtype=real)):
        root = wp.sqrt(depth / terms[0])
        return w * depth * root, real(1.5) * w * root, real(0.4) * w * depth * depth * root

    return push


ROUGH, HEIGHT = ContactLaw("rough", asperities, ("height",)), 1e-5
NAMED = '{ name = "rough", height = 1e-5 }'


def lawful(law):
    """A box, under which no indentation is local."""
    return text("block", ("shape = { sphere = 0.01 }", f"law = {law}, shape = {{ box = [0.02, 0.02, 0.02] }}"))


@pytest.fixture(autouse=True)
def installed(monkeypatch):
    """An installed package has the law as an entry point."""
    entry = SimpleNamespace(name="rough", value="elsewhere:ROUGH", load=lambda: ROUGH)
    monkeypatch.setattr(shelf, "_entries", lambda group, path: {"rough": entry} if group == CONTACT_LAWS.group else {})
    yield
    CONTACT_LAWS.data.pop("rough", None)


@pytest.mark.slow  # a module to compile
def test_forces_of_a_plane_are_those_of_the_law(block, device):
    """At one depth under all points: in closed form from the forces of the penalty. The energy is their potential."""
    model, depth = block((0.04, 0.04, 0.03), 0.02, young_modulus=1e5), np.array([4e-6, 5e-6, 6e-6])
    poses = np.tile(np.diag([1.0, -1.0, -1.0, 1.0]), (1, 3, 1, 1, 1))
    poses[0, :, 0, 2, 3] = 0.03 - depth

    def found(law):
        contact = RigidContact(model, RigidBodies(Plane()), np.zeros(1), poses, device=device, law=law)
        contact.move(poses[0])
        every = torch.arange(3, device=device)
        contact.evaluate(every, contact.gather(torch.zeros((model.mesh.points.size, 3), dtype=torch.float64,
                                                           device=device)))
        return [t.cpu().numpy() for t in (contact.on_bodies(every)[:, 0, 2], contact.energy(every))]

    (linear, _), (rough, energy) = found((PENALTY, np.zeros(1))), found((ROUGH, np.array([HEIGHT])))
    assert rough == pytest.approx(linear * np.sqrt(depth / HEIGHT), rel=1e-9) and rough.min() > 0.0
    assert (energy[2] - energy[0]) / 2e-6 == pytest.approx(rough[1], rel=0.01)


@pytest.mark.slow
def test_a_scene_is_pressed_by_the_law(tmp_path):
    """Asperities that give way by micrometres change the force of a press of millimetres little, and not by nothing."""
    (tmp_path / "block.toml").write_text(lawful(NAMED))
    (tmp_path / "plain.toml").write_text(lawful('"penalty"'))
    rough, plain = (vsfsim.press(tmp_path / f"{name}.toml") for name in ("block", "plain"))
    assert rough.converged
    assert 0.0 < abs(rough.force[-1, 2] / plain.force[-1, 2] - 1.0) < 0.02


@pytest.mark.parametrize(("law", "said"), [
    ('"ruff"', "rough"), ('"rough"', "height"), ('{ name = "penalty", height = 1.0 }', "no numbers"), ("3", "name")])
def test_a_wrong_law_is_refused_with_what_to_do(law, said):
    with pytest.raises(SceneError, match=rf"\[probe\].*{said}"):
        tiers.choose(parse_scene(lawful(law), "block.toml").sample(0))


def test_the_law_has_its_numbers_and_is_part_of_a_recipe(monkeypatch):
    one = parse_scene(lawful(NAMED), "block.toml")
    law, terms = contact_law_of(one.sample(0))
    assert law is ROUGH and terms.tolist() == [HEIGHT] and contact_law_of(scene("block").sample(0))[0] is PENALTY
    entry = SimpleNamespace(name="rough", group="vsfsim.contact_laws")
    monkeypatch.setattr(shelf.importlib.metadata, "entry_points",
                        lambda group: [entry] if group == entry.group else [])
    assert shelf.plug_ins(one.tree, "probe") == [entry]
