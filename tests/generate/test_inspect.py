"""`vsfsim show` of a scene: what each effector draws, and the figures that it prints."""

import re

import numpy as np
import pytest
from texts import text

from vsfsim.generate.inspect import inspect


def lines_of(scene, tmp_path):
    (tmp_path / "small.toml").write_text(scene)
    lines, numbers = inspect(str(tmp_path / "small.toml"), tmp_path / "small.png", seed=3, device="cpu")
    assert (tmp_path / "small.png").read_bytes()[:4] == b"\x89PNG"
    assert numbers["picture"] == str(tmp_path / "small.png") and lines[0] == f"small: {numbers['lines'][0]}"
    assert lines[0].startswith("small: ") and lines[-1] == f"picture: {tmp_path / 'small.png'}"
    return lines


def test_of_a_probe_the_object(tmp_path):
    parts = "{ base = 1e4, inclusions = [{ box = [0.0, -0.03, 0.0, 0.03, 0.03, 0.03], value = 4e4 }] }"
    first = lines_of(text("block", name='"small"', press=None, young_modulus=parts), tmp_path)[0]
    assert "108.0 cm^3, E 1e+04 to 4e+04 Pa" in first


def test_of_a_bubble_without_an_object_its_free_dome(tmp_path):
    said = "\n".join(lines_of(text("bubble", name='"small"', press=None, nodes=100), tmp_path))
    assert "a bubble of 100 nodes" in said and "sealed: dp/dV" in said
    figures = re.search(r"apex (\S+) mm, volume (\S+) mL, at (\S+) Pa", said).groups()
    apex, volume, gauge = (float(v) for v in figures)
    # a real Punyo's height map, 30.89 mm (1 - rho^2)^0.763, encloses pi a b h / 1.763
    # 100 nodes are 4 % low at the apex and 3 % in volume
    assert apex == pytest.approx(30.89, rel=0.05) and gauge == 7820.0
    assert volume == pytest.approx(1e6 * np.pi * 0.05725 * 0.040 * 0.03089 / 1.763, rel=0.05)
