"""Finite elements on Warp: model, contact, quasi-static solver, tiers."""
