"""A frame's time limit is one, on every path: measured in processor time, so that a busy machine does not matter."""

from __future__ import annotations

import dataclasses
import time

import numpy as np
import pytest

from vsfsim.core.scene import parse_scene
from vsfsim.generate.effector import effector_of
from vsfsim.generate.press_result import PressRequest
from vsfsim.physics import tiers
from vsfsim.physics.contact.rigid_contact import RigidContact
from vsfsim.physics.solve.frames import Reason

LIMIT = 0.5  # of a frame [s]
SOLID = """
name = "hard"
description = "A press that no path finishes in time"
needs = ["contact"]
[object]
shape = {{ box = [0.1, 0.1, 0.04] }}
resolution = {size}
fixed = "bottom"
friction = {friction}
poisson_ratio = {poisson}
young_modulus = {{ base = 1e5, inclusions = [ {{ sphere = [0.01, 0.0, 0.02, 0.012], value = 1e8 }} ] }}
[probe]
shape = {{ {probe} }}
[press]
path = [[0.0, 0.0, {top}], [0.0, 0.0, {low}], [0.01, 0.0, {low}]]
rotation = [[0, 0, 0], [0, 0, 0], [0, 0, 0.7]]
frames = [2, 2]
"""
BALL = """
name = "ball"
[object]
shape = { box = [0.1, 0.1, 0.05] }
resolution = 0.05
young_modulus = 1e5
[probe]
shape = { sphere = 0.02 }
[press]
path = [[0.0, 0.0, 0.07], [0.0, 0.0, 0.06]]
frames = [1]
"""
BUBBLE = """
name = "hard"
[sensor]
kind = "bubble"
nodes = 1500
{object}
[press]
path = [[0.0, 0.0, {top}], [0.0, 0.0, {low}], [0.01, 0.0, {low}]]
frames = [2, 2]
"""
CORNER = """
friction = 2.0
[[obstacles]]
shape = { box = [0.02, 0.02, 0.02] }
pose = [0.0, 0.0, -0.0173]
rotation = [1.5459, 1.5459, 0.0]
"""
BLOCK = """
[object]
shape = { box = [0.1, 0.1, 0.05] }
young_modulus = 3e4
friction = 0.5
poisson_ratio = 0.45
"""


def solid(tier: str, friction: float) -> tuple[str, str]:
    """The text of a scene and its tier. Layers (vsf) take nu up to 0.47 only."""
    probe = "cylinder = [0.015, 0.02]"
    return SOLID.format(probe=probe, top=0.05, low=0.032, friction=friction, size=0.008,
                        poisson=0.45 if tier == "vsf" else 0.4999), tier


CASES = {
    **{f"{tier}, friction {mu:g}": solid(tier, mu) for tier in ("vsf", "linear", "fem")
       for mu in (0.0, 1.0)},
    "bubble": (BUBBLE.format(object=CORNER, top=0.034, low=0.014), None),
    "bubble on a block": (BUBBLE.format(object=BLOCK, top=0.085, low=0.065), None),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", CASES)
def test_no_frame_takes_a_fifth_more_than_its_limit_or_one_iteration(name, monkeypatch, tmp_path):
    """The solver's clock is the processor's. What cannot be interrupted is measured: a frame's preparation and its
    first iteration, by a press with a limit of no time, and the longest growth of a patch by new faces."""
    text, tier = CASES[name]
    loaded = parse_scene(text, tmp_path / "hard.toml")
    press = effector_of(loaded.sample(0)).press
    press(loaded, PressRequest(tier=tier, seconds=0.0))  # compiles kernels
    monkeypatch.setattr(time, "perf_counter", time.process_time)
    least = np.max(press(loaded, PressRequest(tier=tier, seconds=0.0)).more["seconds"])
    grows, grow = [0.0], RigidContact.extend_patch

    def timed(*given, **more):
        began = time.process_time()
        grown = grow(*given, **more)
        grows.append(time.process_time() - began)
        return grown

    monkeypatch.setattr(RigidContact, "extend_patch", timed)
    result = press(loaded, PressRequest(tier=tier, seconds=LIMIT))
    seconds, late = np.asarray(result.more["seconds"]), np.array(result.more["reason"]) == Reason.TIME.text
    print(f"{name}: {np.round(seconds, 2)} s, least {least:.2f} s, growth {max(grows):.2f} s, "
          f"{late.sum()} of {len(late)} frames at the limit")
    assert seconds.max() <= 1.2 * LIMIT + least + max(grows)


def test_a_stated_time_limit_is_the_only_one_of_a_frame(monkeypatch, tmp_path):
    """Two conjugate gradients a frame are not enough here. Who states a time limit gets that time for the frame."""
    own = tiers.options
    monkeypatch.setattr(tiers, "options", lambda tier: dataclasses.replace(own(tier), cg_frame=2))
    loaded = parse_scene(BALL, tmp_path / "ball.toml")
    press = effector_of(loaded.sample(0)).press
    few, timed = (press(loaded, PressRequest(tier="fem-coarse", seconds=seconds)) for seconds in (None, 60.0))
    assert Reason.ITERATIONS.text in few.more["reason"]
    assert set(timed.more["reason"]) == {Reason.NONE.text}
