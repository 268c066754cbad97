"""Measurements on datasets: how fast they are read."""
