"""The trust map: presses as a user writes them against forces that another solver computed: `vsfsim measure trust`.

It asks what a user asks: is the force that I am shown right, and if it is not, am I told? The forces are those of
`references/presses.json`. A press takes one of them at a random tier, on elements of a random size, in few frames or
many, straight down or from aside, of the shape or of a scan of it. `vsfsim measure stability` presses at the extremes
instead, and asks whether a frame that is called converged contradicts mechanics.
"""

from __future__ import annotations

import tempfile
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

import references
from measurements.measurement import Column, Measurement, Progress, Table
from measurements.stability.team import Ended, Late, answers, processor_time
from references.cells import FRAMES, Cell
from vsfsim.core.errors import VsfsimError
from vsfsim.core.scene import parse_scene
from vsfsim.press.command import press

TIERS = ("linear", "fem-coarse", "fem-coarse", "fem")
WAYS = ("press", "press", "press", "slide", "scan")
WITHIN = (0.02, 0.05, 0.10)
"""Errors that the report tells apart [-]; past the last a frame that is not marked is wrong in silence."""
TOLD = {"up to 1 %": (0.0, 0.01), "1 to 2 %": (0.01, 0.02), "2 to 5 %": (0.02, 0.05), "5 to 10 %": (0.05, 0.1),
        "over 10 %": (0.1, np.inf), "all": (0.0, np.inf)}
"""Rows of the errors that frames are told [-]."""
SURE = 0.03
"""Largest error of a reference [-]; frames whose reference is worse are not judged."""
SMALL = 0.1
"""Forces count as this part of the largest of the reference at least [-]."""
_SPARE = 300.0  # on the clock, beyond eight times the limit: for kernels [s]


@dataclass(frozen=True)
class Ask:
    """One press of a reference."""

    number: int
    """Of the press."""
    reference: int
    """Its number in `references/presses.json`."""
    tier: str
    """At which it is pressed."""
    way: str
    """"press", "slide" (from aside, at full depth) or "scan" (the body given as a file of triangles)."""
    times: int
    """Frames for each depth of the reference."""
    coarse: float
    """Element size over the tier's own [-]."""


def ask(seed: int, number: int, known: Sequence[Any]) -> Ask:
    """Press ``number`` of a ``seed``: every reference in turn, all else at random."""
    rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(number,)))
    order = np.random.default_rng(seed).permutation(len(known))
    tier, way = str(rng.choice(TIERS)), str(rng.choice(WAYS))
    coarse = float(np.exp(rng.uniform(np.log(0.8), np.log(1.5)))) if rng.random() < 0.5 else 1.0
    reference = int(order[number % len(known)])
    one = cell_of(known[reference])
    if one.foam and tier == "linear":
        tier = "fem-coarse"  # which has no small strain
    if (way == "scan" and one.parts) or (way == "slide" and one.probe[0] == "plane"):
        way = "press"
    return Ask(number, reference, tier, way, int(rng.choice([1, 2])), coarse)


def cell_of(row: Any) -> Cell:
    """The press of a row of `references/presses.json`."""
    return msgspec.convert(row["press"], Cell)


def judge(one: Ask, *, limit: float) -> list[dict[str, Any]]:
    """A row for each frame that has a reference, or one that says why there is none; ``limit`` of the press's processor
    time [s]."""
    row = references.load("presses")["presses"][one.reference]
    cell, began = cell_of(row), time.process_time()
    mesh = "own mesh" if one.coarse == 1.0 else "other mesh"
    base = {**asdict(one), "kinds": [*cell.kinds(), one.tier, one.way, mesh]}
    with tempfile.TemporaryDirectory() as name:
        try:
            with processor_time(limit):
                found = _pressed(one, cell, Path(name))
        except (VsfsimError, Late) as why:
            return [{**base, "why": str(why) or "it took too long", "refused": isinstance(why, VsfsimError)}]
    at = [len(found.normal_force) - 1] if one.way == "slide" else one.times * np.arange(1, FRAMES + 1) - 1
    force, unsure = (np.array(row[key])[-len(at):] for key in ("force_N", "relative_error"))
    error = np.abs(found.normal_force[at] - force) / np.maximum(force, SMALL * max(row["force_N"]))
    result = found.result
    told = np.asarray(result.more.get("mesh_error", np.full(len(found.normal_force), np.nan)))[at]
    marked = ~(result.converged & (False if result.resolved is None else result.resolved))[at]
    return [{**base, "frame": int(t), "error": float(error[k]), "told": float(told[k]), "unsure": float(unsure[k]),
             "marked": bool(marked[k]), "seconds": time.process_time() - began} for k, t in enumerate(at)]


def _pressed(one: Ask, cell: Cell, folder: Path) -> Any:
    mesh = ""
    if one.way == "scan":
        import trimesh

        kind, *sizes = cell.body
        body = {"box": lambda: trimesh.creation.box(sizes),
                "cylinder": lambda: trimesh.creation.cylinder(*sizes, sections=96),
                "sphere": lambda: trimesh.creation.icosphere(subdivisions=4, radius=sizes[0])}[kind]()
        body.export(folder / "scan.stl")
        mesh = "scan.stl"
    text = partial(cell.scene, mesh=mesh, slide=one.way == "slide", times=one.times)
    size = None
    if one.coarse != 1.0:
        from vsfsim.physics import tiers

        sample = parse_scene(text(), folder / "scene.toml").sample(0)
        size = one.coarse * tiers.element_size(sample.required_object, one.tier, sample.probe)
    return press(parse_scene(text(resolution=size), folder / "scene.toml"), tier=one.tier)


def measure(cells: int = 300, seed: int = 0, *, limit: float = 60.0, workers: int = 1,
            progress: Progress = lambda said: None) -> Measurement:
    """Press the first ``cells`` of a ``seed``; ``limit`` of the processor time of each [s]."""
    known = references.load("presses")["presses"]
    rows: list[dict[str, Any]] = []
    jobs = [ask(seed, number, known) for number in range(cells)]
    for done, (job, found) in enumerate(answers(jobs, partial(judge, limit=limit), workers=workers,
                                                most=8.0 * limit + _SPARE), start=1):
        rows += [{**asdict(job), "why": found.words, "refused": False}] if isinstance(found, Ended) else found
        progress(f"{done} of {cells} presses")
    return report(rows, {"cells": cells, "seed": seed, "limit": limit})


def report(rows: Sequence[dict[str, Any]], settings: dict[str, Any]) -> Measurement:
    """Marked frames and the errors of the others, by kind; whether the errors that are told hold; what is wrong."""
    frames = [row for row in rows if "error" in row and row["unsure"] <= SURE]
    kinds = Counter(kind for row in frames for kind in row["kinds"])
    shares = [_shares("all", frames)] + [_shares(kind, [row for row in frames if kind in row["kinds"]])
                                         for kind, _ in kinds.most_common()]
    plain = [row for row in frames if not row["marked"]]
    wrong = [{**row, "kind": ", ".join(row["kinds"])} for row in plain if row["error"] - row["unsure"] > WITHIN[-1]]
    told = [row for row in plain if row["told"] == row["told"]]
    hold = [_hold(words, some) for words, (low, high) in TOLD.items()
            if (some := [row for row in told if low <= row["told"] < high])]
    why = Counter(row["why"][:80] for row in rows if "why" in row)
    percent = partial(Column, unit="1", printed="%")
    tables = [
        Table("Frames without a mark, by kind", (
            Column("kind", "frames"), Column("frames", "judged", "1", form="d"),
            percent("marked", "marked", form=".0f"),
            *(percent(f"within_{100 * w:.0f}", f"of the others within {100 * w:.0f} %", form=".0f") for w in WITHIN),
            percent("most", "largest error", form=".0f"),
            percent("wrong", "wrong in silence", form=".1f")), shares, "shares"),
        Table("Frames without a mark, by the error that is told", (
            Column("told", "told"), Column("frames", "frames", "1", form="d"),
            percent("within", "within it", form=".0f"),
            Column("ratio", "error over told, 95 %", "1", form=".2f")), hold, "told")]
    if wrong:
        tables.append(Table("Frames that are wrong in silence", (
            Column("number", "press", "1", form="d"), Column("frame", "frame", "1", form="d"),
            percent("error", "error", form=".0f"), percent("told", "told", form=".0f"), Column("kind", "kind")),
            wrong, "wrong"))
    if why:
        tables.append(Table("Presses that are not judged", (
            Column("why", "why"), Column("number", "presses", "1", form="d")),
            [{"why": words, "number": n} for words, n in why.most_common()], "others"))
    return Measurement.of("trust", settings, tables, numbers={"frames": list(rows)}, notes=[
        f"a frame is wrong in silence if its force is off by more than {100 * WITHIN[-1]:g} % beyond the error of "
        f"its reference and it is neither marked nor told as not resolved",
        f"{sum('error' in row for row in rows) - len(frames)} frames are not judged, because their reference is known "
        f"to no better than {100 * SURE:g} %"])


def _shares(kind: str, rows: Sequence[dict[str, Any]]) -> dict[str, Any]:
    plain = [row for row in rows if not row["marked"]]
    error = np.array([row["error"] for row in plain])
    sure = np.array([row["error"] - row["unsure"] for row in plain])
    return {"kind": kind, "frames": len(rows), "marked": 1.0 - len(plain) / max(len(rows), 1),
            **{f"within_{100 * w:.0f}": float((error <= w).mean()) if len(plain) else np.nan for w in WITHIN},
            "most": float(error.max()) if len(plain) else np.nan,
            "wrong": float((sure > WITHIN[-1]).mean()) if len(plain) else np.nan}


def _hold(words: str, rows: Sequence[dict[str, Any]]) -> dict[str, Any]:
    sure = np.array([max(row["error"] - row["unsure"], 0.0) for row in rows])
    told = np.array([max(row["told"], 1e-4) for row in rows])
    return {"told": words, "frames": len(rows), "within": float((sure <= told).mean()),
            "ratio": float(np.quantile(sure / told, 0.95))}
