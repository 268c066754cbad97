"""Scene, material, shape, errors and the shelf of named things: frozen dataclasses, numpy only."""
