"""The report on the local indentation: errors are those of the forces, and a run goes on."""

import numpy as np
import pytest

from measurements.trust import indentation
from vsfsim.physics import tiers


def forces(jobs, work, *, workers, most):
    """In place of `answers`: `fem` is 1 % too stiff at every depth, the others and what has no compliance 5 %."""
    for job in jobs:
        body, tier, local = job
        reference = np.ones(10 if isinstance(body, str) else 5)
        if body == "S1":
            reference = np.array(indentation.references.load("s1")["force_N"])
        if body == "S2":
            reference[[4, 9]] = indentation.references.load("s2")["force_N"]
        error = 0.0 if tier == "the fine mesh" else 0.01 if tier == "fem" and local else 0.05
        yield job, {"body": body, "tier": tier, "local": local, "force": ((1.0 + error) * reference).tolist()}


def test_errors_are_those_of_the_forces_and_a_run_goes_on(tmp_path, monkeypatch):
    monkeypatch.setattr(indentation, "answers", forces)
    file = tmp_path / "presses.jsonl"
    indentation.measure([1], file)
    found = indentation.measure([1, 2], file).record()
    assert len(file.read_text().splitlines()) == 1 + 2 * 7 + 2 * 6
    best = next(row for row in found["means"] if (row["tier"], row["local"]) == ("fem", "with"))
    assert best["rms"] == pytest.approx(0.01) and best["last"] == pytest.approx(0.01) and best["bodies"] == 2
    blocks = {(row["block"], row["tier"], row["local"]): (row["half"], row["full"]) for row in found["blocks"]}
    assert len(blocks) == 12 and blocks["S2", "linear", "with"] == pytest.approx((0.05, 0.05))
    assert indentation.stored(file).record()["errors"] == found["errors"]


def test_the_reference_has_smaller_elements_than_the_press(monkeypatch):
    for body in indentation.BODIES:
        own, fine = (indentation.scene_of(body, fine=fine) for fine in (False, True))
        size = tiers.element_size(own.object, "fem", own.probe)
        assert tiers.element_size(fine.object, "fem", fine.probe) <= 0.6 * size
