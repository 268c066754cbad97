"""How a probe moves: pose(t)."""
