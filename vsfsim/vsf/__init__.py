"""The papers' particle model: structure from a view, stick-slip motion, observation rows, MAP estimate."""
