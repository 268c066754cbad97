"""Measurements of artificial plants and their touches."""
