"""What is asked of a scene: the options of `vsfsim press` and `vsfsim generate`, their functions, and a recipe."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from vsfsim.core.system.engines import HERE, Fan


@dataclass(frozen=True)
class Request:
    """The options; None leaves what the scene, its tier or the machine says."""

    seed: int = 0
    """Root of all random numbers (0 or more)."""
    tier: str | None = None
    """Fidelity."""
    device: str = "cpu"
    """Warp device, "cpu" or "cuda:0"."""
    cache: Path | None = None
    """Folder of meshes that were made before; None for the user's own cache."""
    progress: Callable[[int, int, str], None] | None = None
    """Called with (done, in all, what)."""
    limit: float | None = None
    """Of a press: limit of a frame's processor time [s]; a frame that takes longer is marked."""
    tolerance: float | None = None
    """Of a press: tolerance of the equilibrium, see `vsfsim.physics.solve.frames.SolverOptions` [-]."""
    objects: int | None = None
    """Of a dataset, as all that follow: how many objects."""
    views: int | None = None
    """Views of each object."""
    touches: int | None = None
    """Touches of each view."""
    renderer: str = "warp"
    """Renderer of the pictures, "warp" or "pyrender"."""
    accuracy: float | None = None
    """Largest error of the force over its largest value in a touch [-], for which a pilot chooses tier and element
    size, and by which some touches are audited."""
    workers: int | None = None
    """Processes; None for one a CPU core, or one for 5 GiB of a GPU, 16 at most and one a core."""
    finish: bool = False
    """Only check what shards have made, and write dataset.json."""
    mixed: bool = False
    """Whether machines of several kinds may make the dataset."""
    poison: bool = False
    """Whether a view that fails twice is left out and the others are made."""
    fan: Fan = HERE
    """Where the views are made, and which of them by this call."""
    note: Callable[[str], None] | None = None
    """Called with sentences for the user."""

    def but(self, **options: Any) -> Request:
        """The same with other values of some options."""
        return dataclasses.replace(self, **options)
