"""Peers: what is computed from what was measured."""

import numpy as np
import pytest

from measurements import indent


def test_a_peers_errors_are_shares_of_the_reference():
    made = {"forces": [1.1, 1.8], "balance": [1e-6, 1e-7], "seconds": [1.0, 3.0], "tets": 8, "said": ""}
    found = indent.compared(made, np.array([0.001, 0.005]), np.array([1.0, 2.0]))
    assert found["at_5"] == pytest.approx(-0.1) and found["at_1"] == found["worst"] == pytest.approx(0.1)
    assert found["rms"] == pytest.approx(0.1) and found["seconds"] == 2.0 and found["balance"] == 1e-6
