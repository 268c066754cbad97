"""Measurements of time and accuracy: `vsfsim measure`. They need a checkout of the repository."""
