"""The papers' particle model: structure from a view, stick-slip motion, observation rows, MAP estimate."""

from vsfsim.core.extras import require

require("methods", "warp", "torch")
