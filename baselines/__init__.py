"""Baselines: one method a file, registered through entry points as any other method."""
