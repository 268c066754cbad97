"""Cameras and tactile sensors."""
