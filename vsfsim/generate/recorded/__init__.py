"""Datasets and touches from recordings of real robots."""
