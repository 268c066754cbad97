"""Factorisations of the rest stiffness, kept as preconditioners."""
