"""What is asked of a scene: the options of `vsfsim press` and `vsfsim generate`, their functions, and a recipe."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from vsfsim.core.system.engines import HERE, Fan


@dataclass(frozen=True)
class Request:
    """The options; None leaves what the scene, its tier or the machine says. The texts below are also the
    help of the commands."""

    seed: int = 0
    """Root of all random numbers."""
    tier: str | None = None
    """Fidelity, from the cheapest: linear, fem-coarse, fem, fem-fine; default: the scene's."""
    device: str = "cpu"
    """Warp device: cpu or cuda:0."""
    progress: Callable[[int, int, str], None] = lambda *_: None
    """Called with (done, in all, what)."""
    limit: float | None = None
    """Of a press: processor time of a frame [s]; one that takes more is marked. Default: the tier's own, 120, and 1,500
    conjugate gradients."""
    tolerance: float | None = None
    """Of a press: tolerance of the equilibrium, see `vsfsim.physics.solve.frames.SolverOptions` [-]."""
    objects: int | None = None
    """How many objects a dataset has; default: the scene's."""
    views: int | None = None
    """Views of each object; default: the scene's."""
    touches: int | None = None
    """Touches of each view; default: the scene's."""
    renderer: str = "warp"
    """Of the pictures: warp or pyrender."""
    accuracy: float | None = None
    """Largest error of any reading of the force over it [-], e.g. 5%: every touch goes to finer elements until
    a bound that a pilot calibrates keeps it, and some touches are audited against a reference."""
    workers: int | None = None
    """Processes; default: one a CPU core, or one for 5 GiB of a GPU, 16 at most and one a core."""
    allow: Sequence[str] = ()
    """What is refused otherwise; may be given again. mixed: machines of several kinds, which round otherwise; poison:
    a view that fails twice, which is left out while the others are made (exit code 4)."""
    fan: Fan = HERE
    """Where the views are made, and which of them by this call."""
    note: Callable[[str], None] = lambda _: None
    """Called with sentences for the user."""

    def but(self, **options: Any) -> Request:
        """The same with other values of some options."""
        return dataclasses.replace(self, **options)
