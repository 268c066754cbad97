"""Meshes: structured, from a scan, quadratic, of membranes; and whether they are valid."""
