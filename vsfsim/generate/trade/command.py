"""`vsfsim tradeoff SCENE`: the limit of some touches, then setting after setting, kept as they come."""

from __future__ import annotations

import dataclasses
import json
import math
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

import vsfsim
from vsfsim.core.errors import VsfsimError
from vsfsim.core.plain_text import from_json
from vsfsim.core.scene import SceneFile
from vsfsim.data.disk import write_atomic
from vsfsim.data.provenance import commit, machine_kind
from vsfsim.data.recipe import text_sha256
from vsfsim.generate.trade import front
from vsfsim.generate.trade.front import Point
from vsfsim.generate.trade.made import Run, Touched, limits
from vsfsim.generate.trade.page import page
from vsfsim.generate.trade.runs import touched
from vsfsim.generate.trade.setting import Setting
from vsfsim.physics import tiers
from vsfsim.physics.convergence import Limit
from vsfsim.physics.runtime import devices

LINES = "points.jsonl"
_SAME = ("format", "scene", "scene_sha256", "seed", "touches", "objects", "device", "version", "commit")
"""What lines must share to be put together."""


@dataclass(frozen=True)
class Tradeoff:
    """What a sweep found."""

    scene: str
    """Name."""
    what: str
    """The touches in words."""
    points: tuple[Point, ...]
    """Cheapest first."""
    limit: tuple[str, ...]
    """One sentence a touch: its order and what is known of its limit."""
    refused: Mapping[str, str]
    """Settings that could not be made, with the reason."""
    left: int
    """Settings that the budget did not reach."""
    machine: str
    """Kind of machine."""

    def sentences(self) -> list[str]:
        """One a goal."""
        return [front.sentence(goal, self.points) for goal in front.GOALS if self.points]

    def text(self) -> str:
        """For the terminal."""
        out = [f"{self.scene}: {self.what}", *self.limit]
        if self.points:
            out += ["", front.text(self.points), "* on the front   ~ error below that of the limit, not ranked   "
                    "x tier does not show the scene's needs"]
        return "\n".join([*out, "", *self.sentences(), *(f"note: {sentence}" for sentence in self.notes())])

    def notes(self) -> list[str]:
        """What could not be made, and what is left."""
        left = [f"the budget ended before {self.left} settings; run the same command again to go on"] * bool(self.left)
        return [*(f"{key}: {why}" for key, why in self.refused.items()), *left]

    def table(self) -> dict[str, Any]:
        """For JSON."""
        return {"scene": self.scene, "what": self.what, "machine": self.machine, "limit": list(self.limit),
                "points": [dataclasses.asdict(p) for p in self.points], "sentences": self.sentences(),
                "refused": dict(self.refused), "left": self.left}


class _Lines:
    """A file of JSON lines: first the circumstances, then what was made, by its key."""

    def __init__(self, file: Path, circumstances: Mapping[str, Any]):
        self.file, self.rows = file, {}
        if not file.exists():
            file.parent.mkdir(parents=True, exist_ok=True)
            write_atomic(file, (json.dumps(dict(circumstances)) + "\n").encode())
            return
        head, rows, whole = read_lines(file)
        for name in _SAME:
            if head.get(name) != circumstances[name]:
                raise VsfsimError(f"{file} was made with {name} {head.get(name)!r}, and this run has "
                                  f"{circumstances[name]!r}; their points cannot be put together. Give another --out, "
                                  f"or delete the file.")
        self.rows = {row["key"]: row for row in rows}
        if not whole:
            write_atomic(file, "".join(json.dumps(row) + "\n" for row in (head, *rows)).encode())

    def add(self, row: dict[str, Any]) -> dict[str, Any]:
        self.rows[row["key"]] = row
        with open(self.file, "a") as file:
            file.write(json.dumps(row, allow_nan=False) + "\n")
        return row


def read_lines(file: Path) -> tuple[dict[str, Any], list[dict[str, Any]], bool]:
    """Circumstances and rows of a file of lines, and whether its last line is whole.

    Raises:
        VsfsimError: it is no such file.
    """
    try:
        lines = file.read_text().split("\n")
        head, rows = from_json(lines[0]), [from_json(line) for line in lines[1:-1]]
        if head["format"] != "vsfsim-tradeoff" or not all("key" in row for row in rows):
            raise ValueError("it has another format")
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise VsfsimError(f"{file} is not a file of `vsfsim tradeoff` ({error}). Give the {LINES} of a run.") from None
    return head, rows, not lines[-1]


def tradeoff(loaded: SceneFile, out: Path, *, touches: int = 4, objects: int = 1, seed: int = 0, device: str = "cpu",
             budget: float | None = None, tiers_only: tuple[str, ...] = (), axes: tuple[str, ...] = (),
             check: Path | None = None, cache: Path | None = None,
             progress: Callable[[int, int, str], None] | None = None) -> tuple[Tradeoff, list[str]]:
    """Measure what settings cost and miss on a scene, and write lines, page and table into a folder.

    Args:
        loaded: the scene.
        out: folder; what an earlier run of the same command has there is not made again.
        touches: of each object.
        objects: the first so many of the scene's.
        seed: as of `vsfsim generate`.
        device: Warp device.
        budget: begin nothing new after this time [s]; None for all.
        tiers_only: only these tiers; empty for all.
        axes: only these of `vsfsim.generate.trade.setting.AXES`; empty for all that the scene has.
        check: lines of a run to compare with, or None.
        cache: folder of filled meshes, or None for the user's own.
        progress: called with (done, in all, what).

    Returns:
        What was found, and where it differs from ``check``.

    Raises:
        VsfsimError: neither [touches] nor [press], an axis that the scene does not have, a budget that ends before the
            first point, a folder or a stored front of another run, or no touch whose limit is known.
    """
    until = time.perf_counter() + (math.inf if budget is None else budget)
    stored = _stored(check, loaded)
    circumstances = {"format": "vsfsim-tradeoff", "scene": loaded.name, "scene_sha256": text_sha256(loaded.text),
                     "seed": seed, "touches": touches, "objects": objects, "device": device,
                     "version": vsfsim.__version__, "commit": commit(), "machine": machine_kind()}
    lines = _Lines(out / LINES, circumstances)
    subject = touched(loaded, touches=touches, objects=objects, seed=seed, device=device, cache=cache)
    others = [alias for words in devices() if (alias := words.split(" ")[0]) != device]
    sweep = [s for s in subject.ground.sweep(axes, others[:1]) if not tiers_only or (s.tier or "bubble") in tiers_only]
    if not sweep:
        raise VsfsimError(f"{loaded.path}: none of the tiers {', '.join(tiers_only)} can be touched here; there are "
                          f"{', '.join(subject.ground.pressable) or 'none, because the scene has no [object]'}.")
    total, late = subject.count + len(sweep), False
    bounds, shares = [], []
    for k in range(subject.count):
        key = f"limit of touch {k}"
        if key not in lines.rows and time.perf_counter() > until:
            late = True
            break
        row = lines.rows.get(key) or lines.add({"key": key, "ladder": [
            subject.near(k, setting).table() for setting in subject.ground.ladder()]})
        bound, share = limits([Run.read(mesh) for mesh in row["ladder"]])
        bounds.append(bound)
        shares.append(share)
        if progress is not None:
            progress(k + 1, total, key)
    points, refused, left = [], {}, 0
    if not late:
        _refuse_unknown(loaded, bounds)
    for number, setting in enumerate(sweep):
        if setting.key not in lines.rows:
            if late or time.perf_counter() > until:
                left += 1
                continue
            lines.add(_made(subject, setting, bounds, shares, loaded))
        row = lines.rows[setting.key]
        if "refused" in row:
            refused[setting.key] = row["refused"]
        elif not late:
            points.append(front.point(setting.key, setting.tier or "bubble", Run.read(row["run"]), bounds, shares,
                                      shows=row["shows"]))
        if progress is not None:
            progress(subject.count + number + 1, total, setting.key)
    if len(refused) == len(sweep):
        raise VsfsimError(f"{loaded.path}: no setting of the sweep can be made. "
                          + " ".join(f"{key}: {why}" for key, why in refused.items()))
    if not points:
        raise VsfsimError(f"the budget of {budget:g} s was over before the first point: the limit of "
                          f"{len(bounds)} of {subject.count} touches is found. It is kept in {lines.file}; run the "
                          f"same command again to go on, with a longer --budget or fewer --touches.")
    found = Tradeoff(loaded.name, subject.what, tuple(front.with_front(points)), tuple(_said(bounds)), refused, left,
                     str(circumstances["machine"]))
    write_atomic(out / "tradeoff.html", page(f"Speed against accuracy: {found.scene}", [found.what, *found.limit],
                                             found.points, found.sentences(), found.notes()).encode())
    return found, front.differences(found.points, stored) if check is not None else []


def _made(subject: Touched, setting: Setting, bounds: list[dict[str, Limit]], shares: list[np.ndarray],
          loaded: SceneFile) -> dict[str, Any]:
    """The row of a setting: its run, and the point for who reads the file."""
    try:
        run = subject.run(setting)
    except VsfsimError as error:
        return {"key": setting.key, "refused": str(error)}
    shows = _shows(loaded, setting)
    p = front.point(setting.key, setting.tier or "bubble", run, bounds, shares, shows=shows)
    return {"key": setting.key, "shows": shows, "cpu": p.cpu, "bar": p.bar,
            "error": p.error if np.isfinite(p.error) else None, "run": run.table()}


def _shows(loaded: SceneFile, setting: Setting) -> bool:
    """Whether the tier shows what the scene needs."""
    if setting.tier not in tiers.TIERS:
        return True
    try:
        tiers.choose(loaded.sample(0), setting.tier)
    except VsfsimError:
        return False
    return True


def _refuse_unknown(loaded: SceneFile, bounds: list[dict[str, Limit]]) -> None:
    if not any(own["force"].known for own in bounds):
        raise VsfsimError(f"{loaded.path}: the limit of no touch is known: {'; '.join(_said(bounds))}. Give more "
                          f"--touches, or a finer resolution in [object], from which the meshes of the limit start.")


def _said(bounds: list[dict[str, Limit]]) -> list[str]:
    out = []
    for k, own in enumerate(bounds):
        force = own["force"]
        if not force.known:
            out.append(f"touch {k}: not used, {force.why}"
                       + (f", known to {100 * force.size:.2g} % only" if np.isfinite(force.size) else ""))
            continue
        order = "" if force.order is None else f", order {force.order:.1f}"
        top = float(np.abs(force.value).max())
        out.append(f"touch {k}: {force.why}{order}; largest force {top:.4g} N, known to "
                   f"{100 * force.size:.2g} %")
    return out


def _stored(check: Path | None, loaded: SceneFile) -> list[dict[str, Any]]:
    if check is None:
        return []
    head, rows, _ = read_lines(check)
    if head.get("scene_sha256") != text_sha256(loaded.text):
        raise VsfsimError(f"--check is '{check}', the front of the scene '{head.get('scene')}', not of "
                          f"'{loaded.name}' as it is written now. Give the {LINES} of this scene.")
    return [row for row in rows if "run" in row]
