"""The stability map: its design, its checks, and a small part of it that must not turn worse."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
from frame_checks import some_slow

from measurements.stability import checks, report
from measurements.stability.design import INSTEAD, KINDS, Cell, design
from measurements.stability.evidence import Evidence
from measurements.stability.judge import Outcome, Verdict, judge
from vsfsim.core.shape import Sphere

EXPECTED = json.loads((Path(__file__).parent / "stability_expected.json").read_text())
LIMIT = 30.0  # of a frame [s]; three times that of the command, since CI's machines are shared


def test_the_design_is_stated_seeded_and_large():
    cells = design()
    assert len(cells) >= 500 and len({c.key for c in cells}) == len(cells)
    assert [c.key for c in cells] == [c.key for c in design()] != [c.key for c in design(seed=1)]
    for kind, factors in KINDS.items():
        for f in factors:
            met = {c.factors[f.name] for c in cells if c.kind == kind}
            assert met == set(f.levels) - INSTEAD.keys(), f"{kind}: {f.name}"


def ball_in_a_box(**changed: object) -> Evidence:
    """Three frames of a ball of 10 mm that dents the top of a flat sheet of triangles by 1, 2 and 3 mm, correctly."""
    ticks = np.linspace(-0.03, 0.03, 61)
    x, y = np.meshgrid(ticks, ticks, indexing="ij")
    surface, poses = [], np.tile(np.eye(4), (3, 1, 1, 1))
    number = np.arange(61 * 61).reshape(61, 61)
    a, b, c, d = number[:-1, :-1].ravel(), number[1:, :-1].ravel(), number[1:, 1:].ravel(), number[:-1, 1:].ravel()
    triangles = np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])
    depth = np.array([0.001, 0.002, 0.003])
    for t in range(3):
        centre = 0.01 - depth[t]
        low = centre - np.sqrt(np.maximum(0.01**2 - x**2 - y**2, 0.0))
        z = np.where(np.hypot(x, y) < 0.01, np.minimum(low, 0.0), 0.0)
        foot = np.array([[-0.03, -0.03, -0.05]])  # below, so that the sheet's box has a depth
        surface.append((np.concatenate([np.stack([x, y, z], axis=2).reshape(-1, 3), foot]), triangles))
        poses[t, 0, 2, 3] = centre
    push = np.array([1.0, 3.0, 6.0])
    e = Evidence(depth, push, np.stack([0 * push, 0 * push, push], axis=1), np.full(3, 1e-4),
                 1e-3 * np.array([0.4, 2.3, 6.8]), np.full(3, 2e-6), np.ones(3, bool), np.ones(3, bool),
                 ("", "", ""), np.zeros(3), 3,
                 True, 0.005, surface=surface, poses=poses, shapes=(Sphere(0.01),))
    return dataclasses.replace(e, **changed)


def test_a_correct_press_has_no_contradiction():
    assert checks.contradictions(ball_in_a_box()) == []


@pytest.mark.parametrize(("name", "changed"), [
    ("push", {"push": np.array([1.0, 3.0, 0.0])}),
    ("work", {"energy": 1e-3 * np.array([0.4, 2.3, 9.0])}),
    ("finite", {"force": np.full((3, 3), np.nan)}),
    ("unbalanced", {"balance": np.array([0.0, 0.5, 0.0])}),
    ("inside a rigid body", {"shapes": (Sphere(0.0105),)}),
])
def test_each_check_sees_its_error(name, changed):
    wrong = ball_in_a_box(**changed)
    found = checks.contradictions(wrong)
    assert found and any(name in sentence for sentence in found)
    # a frame that is marked is contradicted by nothing
    assert checks.contradictions(dataclasses.replace(wrong, converged=np.zeros(3, bool))) == []


def verdict(cell: Cell, outcome: Outcome = Outcome.CONVERGED, push: tuple[float, ...] = (1.0, 2.0),
            **more) -> Verdict:
    return Verdict(cell, outcome, frames=2, converged=2, push=push, **more)


def test_forces_that_do_not_scale_with_the_units_are_wrong():
    solids = {c.text: c for c in design() if c.kind == "solid"}
    base, stiff = solids["solid: defaults"], solids["solid: young 1e+11"]
    right = report.scaled([verdict(base), verdict(stiff, push=(1e6, 2e6))])
    wrong = report.scaled([verdict(base), verdict(stiff, push=(1e6, 1.9e6))])
    assert right[1].outcome is Outcome.CONVERGED and wrong[1].outcome is Outcome.WRONG


@pytest.mark.parametrize("name", some_slow(EXPECTED, *list(EXPECTED)[2:]))
def test_no_cell_turns_worse(name):
    """The small map of CI: each of these cells did at least as well when the file was made."""
    cell = next(c for c in design() if c.text == name)
    found = judge(cell, LIMIT)
    assert found.outcome.rank <= Outcome(EXPECTED[name]).rank, f"{found.outcome}: {found.words} {found.reasons}"
