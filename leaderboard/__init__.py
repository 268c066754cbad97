"""Committed results: <task>/<method>.json."""
