"""Finite elements on Warp: model, contact, quasi-static solver, tiers."""

from vsfsim.core.extras import require

require("sim", "warp", "torch")
