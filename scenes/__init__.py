"""Scenes: TOML files, and procedural families as Python files with a function build, whose tables are TOML, too."""
