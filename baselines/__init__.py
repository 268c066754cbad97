"""Baselines: one method a file, registered through entry points like an outsider's."""
