"""A law that another package brings: the finite element takes it, and a scene names it."""

from types import SimpleNamespace

import numpy as np
import pytest
import warp as wp
from element_body import SIZE, Body, E
from texts import scene

from vsfsim.core.errors import SceneError
from vsfsim.physics import tiers
from vsfsim.physics.laws import principal
from vsfsim.physics.laws.catalogue import LAWS
from vsfsim.physics.laws.law import SolidLaw
from vsfsim.physics.model import tetrahedra
from vsfsim.physics.runtime import mat33, real, vec3


def functions(module):
    """Hencky's law: Psi = mu sum (ln l)^2 + lambda/2 (ln J)^2."""

    @wp.func(module=module)
    def energy(x: vec3, lam: vec3, own: wp.array3d(dtype=real), terms: wp.array2d(dtype=real), t: int, q: int):
        trace = x[0] + x[1] + x[2]
        return own[t, q, 0] * wp.dot(x, x) + real(0.5) * own[t, q, 1] * trace * trace

    @wp.func(module=module)
    def slopes(x: vec3, lam: vec3, own: wp.array3d(dtype=real), terms: wp.array2d(dtype=real), t: int, q: int):
        trace = x[0] + x[1] + x[2]
        out = vec3()
        for k in range(3):
            out[k] = (real(2.0) * own[t, q, 0] * x[k] + own[t, q, 1] * trace) / lam[k]
        return out

    @wp.func(module=module)
    def curvatures(lam: vec3, own: wp.array3d(dtype=real), terms: wp.array2d(dtype=real), t: int, q: int):
        x = vec3(wp.log(lam[0]), wp.log(lam[1]), wp.log(lam[2]))
        first = slopes(x, lam, own, terms, t, q)
        out = mat33()
        for a in range(3):
            for b in range(3):
                out[a, b] = own[t, q, 1] / (lam[a] * lam[b])
            out[a, a] = out[a, a] + real(2.0) * own[t, q, 0] / (lam[a] * lam[a]) - first[a] / lam[a]
        return out

    return principal.functions_of(energy, slopes, curvatures, module)


HENCKY = SolidLaw("hencky", principal.STORED, functions,
                  lambda mu, lam, rows: (np.stack([mu, lam], axis=2), np.array([rows.get("unused", (0.0,))])))
NU = 0.3


@pytest.fixture(autouse=True)
def installed(monkeypatch):
    """An installed package has the law as an entry point."""
    entry = SimpleNamespace(name="hencky", value="elsewhere:HENCKY", load=lambda: HENCKY)
    monkeypatch.setattr("vsfsim.core.shelf._entries", lambda group, path: {"hencky": entry} if group == LAWS.group
                        else {})
    yield
    LAWS.data.pop("hencky", None)


MU, LAM, B = E / (2.0 * (1.0 + NU)), E * NU / ((1.0 + NU) * (1.0 - 2.0 * NU)), 5.0


def hencky(s):
    return MU * (np.log(s) @ np.log(s)) + 0.5 * LAM * np.log(s).sum() ** 2


def fung(s):
    return MU / (2.0 * B) * np.expm1(B * (s @ s - 3.0 - 2.0 * np.log(s).sum())) + 0.5 * LAM * (s.prod() - 1.0) ** 2


@pytest.mark.slow  # a module to compile
@pytest.mark.parametrize("name, rows, closed, stretch", [
    ("hencky", {}, hencky, [1.2, 0.7, 0.9]), ("fung", {"b": [B]}, fung, [1.2, 0.7, 0.9]),
    ("fung", {"b": [B]}, fung, [1.0, 1.0, 1.0001])])
def test_the_element_takes_a_law_of_another_package(name, rows, closed, stretch, block, device):
    """Energy of a uniform stretch in closed form; forces and tangent as its derivatives at a random state."""
    model = block(SIZE, 0.02, young_modulus=E, poisson_ratio=NU,
                  elements=lambda *given: tetrahedra(*given, law=LAWS[name], settings=rows))
    assert model.blocks[0].law == name
    body, points = Body(model, device), model.mesh.points
    stretch = np.array(stretch)
    _, energy, det = body((points * (stretch - 1.0)).reshape(-1, 1))
    assert energy[0] == pytest.approx(np.prod(SIZE) * closed(stretch), rel=1e-9 if np.ptp(stretch) > 0.1 else 1e-6)
    assert det[0] == pytest.approx(stretch.prod(), rel=1e-9)
    random = np.random.default_rng(0)
    u, way = 3e-4 * random.normal(size=points.size), random.normal(size=points.size)
    h = 1e-7
    force, energy, _ = body(np.stack([u + h * way, u - h * way, u], axis=1))
    assert force[:, 2] @ way == pytest.approx((energy[0] - energy[1]) / (2.0 * h), rel=1e-5)
    exact = (force[:, 0] - force[:, 1]) / (2.0 * h)
    found = body.tangent_times(u, way[:, None], projected=False)[:, 0]
    assert np.abs(found - exact).max() < 1e-5 * np.abs(exact).max()


def lawful(law, poisson_ratio=NU, **more):
    return scene("block", law=law, poisson_ratio=poisson_ratio, **more).sample(0)


def test_a_scene_names_a_law():
    found = lawful('"hencky"')
    assert tiers.choose(found) == "fem-coarse", "the cheapest tier that has the law"
    assert tiers.elements(found, "fem-coarse") == [("tet10", "hencky")]
    assert [b.law for b in tiers.build(found, "fem-coarse").blocks] == ["hencky"]
    small = tiers.build(found, "linear")
    assert [b.law for b in small.blocks] == ["neo-hooke"] and any("small strain" in n for n in small.solid.notes)
    foam = lawful('{ name = "hyperfoam", mu = [1e4, 2e4], alpha = [3.0, -2.0], beta = [0.0, 0.0] }', 0.0)
    (block,) = tiers.build(foam, "fem-coarse").blocks
    assert block.parameters["own"][..., 0] == pytest.approx(5e4 / 3e4), "scaled to Young's modulus"


@pytest.mark.parametrize("law, said", [
    ('"henky"', "hencky"), ('{ name = "hencky", mu = 1e5 }', "no numbers"), ("3", "name"),
    ('{ name = "hyperfoam", mu = 1e5 }', "mu, alpha, beta"), ('{ name = "hyperfoam", mu = "soft" }', "numbers"),
    ('"hencky"\nmaterial = "eva"', "material")])
def test_a_wrong_law_is_refused_with_what_to_do(law, said):
    with pytest.raises(SceneError, match=said):
        tiers.choose(lawful(law))


def test_a_law_that_needs_another_poisson_ratio_says_which():
    foam = lawful('{ name = "hyperfoam", mu = 1e4, alpha = 3.0, beta = 0.5 }', 0.1)
    with pytest.raises(SceneError, match=r"block.toml.*poisson_ratio = 0\.25"):
        tiers.build(foam, "fem-coarse")
    with pytest.raises(SceneError, match=r"0\.45"):
        tiers.choose(lawful('"hencky"', 0.49))
