"""Estimators of stiffness from readings that are linear in it."""
