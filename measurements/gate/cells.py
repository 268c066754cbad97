"""The presses of the gate: small ones that between them ask everything of the solver."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np

from measurements.measurement import factorise
from measurements.stability.design import KINDS, Cell, Level
from measurements.stability.scene import bubble_scene, solid_scene
from vsfsim.core.scene import SceneFile, load_scene
from vsfsim.core.scene_tables.request import Request
from vsfsim.core.shelf import find_scene
from vsfsim.generate.effector import effector_of
from vsfsim.physics.solve.frames import Frames, Reason
from vsfsim.physics.solve.touches import Solver


@dataclass(frozen=True)
class GateCell:
    """One press."""

    name: str
    scene: str = ""
    """A scene of the package that is pressed as it is; empty for a cell of the stability map."""
    tier: str | None = None
    """Of that scene; None for its own."""
    seed: int = 0
    """Of that scene."""
    kind: str = "solid"
    """Of a cell of the stability map: "solid" or "bubble"."""
    factors: Mapping[str, Level] = field(default_factory=dict)
    """Of a cell of the stability map: those that are not at their default."""

    def load(self, folder: Path) -> tuple[SceneFile, str | None]:
        """Its scene and tier; ``folder`` takes meshes."""
        if self.scene:
            return load_scene(find_scene(self.scene)), self.tier
        cell = Cell(self.kind, "gate", {f.name: self.factors.get(f.name, f.default) for f in KINDS[self.kind]})
        return (bubble_scene(cell, folder), None) if self.kind == "bubble" else solid_scene(cell, folder)


def _solid(name: str, **factors: Level) -> GateCell:
    return GateCell(name, factors=factors)


def _bubble(name: str, **factors: Level) -> GateCell:
    return GateCell(name, kind="bubble", factors=factors)


CELLS = (
    GateCell("S1", scene="indent-homogeneous", tier="fem"),
    GateCell("S2", scene="indent", tier="fem"),
    GateCell("S1 coarse", scene="indent-homogeneous", tier="fem-coarse"),
    GateCell("S2 coarse", scene="indent", tier="fem-coarse"),
    GateCell("shoe", scene="shoes-mini"),
    GateCell("other shoe", scene="shoes-mini", seed=3),
    GateCell("foam shoe", scene="shoes-v2-mini"),
    GateCell("ball"),
    _solid("one frame", frames=1.0, depth=0.3),
    _solid("ball half", depth=0.5, frames=12.0),
    _solid("ball deep", depth=0.7, frames=12.0),
    _solid("small ball", probe="small ball", depth=0.3),
    _solid("box", probe="box", depth=0.3),
    _solid("box edge", probe="box edge"),
    _solid("box corner", probe="box corner"),
    _solid("cylinder", probe="cylinder", depth=0.3),
    _solid("cylinder rim", probe="cylinder rim"),
    _solid("capsule", probe="capsule"),
    _solid("capsule end", probe="capsule end", depth=0.3),
    _solid("plane", probe="plane", depth=0.3),
    _solid("fork", probe="fork"),
    _solid("ball and wall", probe="ball and wall"),
    _solid("pyramid", probe="pyramid"),
    _solid("weight", gravity=9.81, young=1e3),
    _solid("friction 0.5", friction=0.5),
    _solid("friction 1 rim", friction=1.0, probe="cylinder rim", frames=12.0),
    _solid("friction 1 box", friction=1.0, probe="box", depth=0.3),
    _solid("friction 2 deep", friction=2.0, depth=0.3),
    _solid("nu 0.49", poisson=0.49),
    _solid("nu 0.499", poisson=0.499),
    _solid("nu 0.4999", poisson=0.4999),
    _solid("nu 0.4999 deep", poisson=0.4999, depth=0.3),
    _solid("contrast 1e4", contrast=1e4),
    _solid("contrast 1e8", contrast=1e8, depth=0.3),
    _solid("sheet", thickness=0.1, depth=0.3),
    _solid("thin sheet", thickness=0.025, depth=0.3),
    _solid("column", thickness=3.0, depth=0.15, frames=12.0),
    _bubble("bubble tip"),
    _bubble("bubble ball drag", against="ball", friction=0.5, move="drag"),
    _bubble("bubble soft block", against="soft block"),
)
"""Ball, box and so on press a block of 40 x 40 x 20 mm of 1e5 Pa at fem-coarse, to 15 % of its height in four frames
unless their names say otherwise (see `stability.design`)."""
SMALL = ("ball", "one frame", "friction 0.5", "nu 0.499", "contrast 1e4", "capsule", "sheet", "bubble tip")
"""Eight of them that together take seconds."""


@dataclass(frozen=True)
class Run:
    """What a press of a cell cost, and gave."""

    force: list[list[float]]
    """Force on the bodies (T, 3) [N]; of frames that did not converge NaN."""
    frames: int
    """Frames that converged."""
    reasons: list[str]
    """Of those that did not, in order."""
    newton: int
    """Newton iterations of all frames."""
    cg: int
    """Conjugate gradients of all frames."""
    cpu: float
    """CPU time of the solver [s]."""

    @property
    def asked(self) -> int:
        """Frames that the cell has."""
        return len(self.force)


@contextmanager
def _recorded() -> Iterator[list[tuple[Frames, float]]]:
    """Frames and CPU time of every run of the solver in this block, without the factor that all touches share."""
    inner, out = Solver.run, []

    def run(self: Solver, *args: Any, **settings: Any) -> Frames:
        factorise(self.model)
        began = time.process_time()
        frames = inner(self, *args, **settings)
        out.append((frames, time.process_time() - began))
        return frames

    with mock.patch.object(Solver, "run", run):
        yield out


def press(cell: GateCell) -> Run:
    """Press a cell; frames end by their limits of iterations, so that the load of the machine has no say."""
    with tempfile.TemporaryDirectory() as name, _recorded() as runs:
        loaded, tier = cell.load(Path(name))
        request = Request(tier=tier, seed=cell.seed)
        effector_of(loaded.sample(cell.seed)).press(loaded, request)
    frames = runs[-1][0]
    good = frames.converged[:, 0]
    return Run(np.where(good[:, None], frames.force[:, 0], np.nan).tolist(), int(good.sum()),
               [r.name.lower() for r in map(Reason, frames.reason[~good, 0])], int(frames.iterations.sum()),
               int(frames.cg_iterations.sum()), sum(spent for _, spent in runs))
