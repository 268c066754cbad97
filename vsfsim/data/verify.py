"""Is a dataset whole, and fit to be used? Every byte, every field, every frame. Is it the same as another of its
recipe, bit by bit, or to 1e-3? And what does it hold, in a dozen lines?"""

from __future__ import annotations

import dataclasses
from collections import Counter, defaultdict
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from vsfsim.core.errors import DatasetError
from vsfsim.data.dataset import Dataset, Progress
from vsfsim.data.hdf5 import MAKE_AGAIN, examine, fault_of
from vsfsim.data.manifest import CARD, MANIFEST, Entry, entry_of, observed, verdict
from vsfsim.data.records import Touch, values_of

BALANCE_LIMIT = 1e-3
"""Largest |force - reaction - weight| over the larger norm in a converged frame with contact; the solver's own residual
is far below it, so a frame above has lost or invented force."""

CONTACT_FORCE = 1e-3
"""Force [N] from which a frame counts as in contact; under 1 % of the 0.15 N noise of a real sensor. Below it, a
relative balance compares rounding with rounding."""

SKIN_LIMIT = 1e-4
"""Largest difference [N] of the force on a soft sensor from the sum over the nodes of its skin, besides `BALANCE_LIMIT`
of it: the nodes' are stored in single precision, hundreds of up to a few newtons each."""

CLOSE = 1e-3
"""Largest difference of the force, over the largest force of the touch, of touches that count as equal."""

_REPORT_IT = "report it with the scene and the seed, and do not use this touch."


@dataclass(frozen=True)
class Problem:
    """One thing that is wrong."""

    file: str
    """Where."""
    what: str
    """What is wrong."""
    todo: str
    """What to do about it."""

    def __str__(self) -> str:
        return f"{self.file}: {self.what} {self.todo}"


@dataclass(frozen=True)
class Report:
    """What `verify` found."""

    path: Path
    """The folder."""
    problems: tuple[Problem, ...] = ()
    """Empty if all is well."""
    files: int = 0
    """Number of object files that are whole."""
    touches: int = 0
    """Number of touches."""
    frames: int = 0
    """Number of frames."""
    unconverged: int = 0
    """Frames that are marked as not converged."""
    unresolved: int = 0
    """Frames that are marked as equilibria which the mesh does not resolve."""
    untouched: int = 0
    """Touches that met nothing."""
    worst_balance: float = 0.0
    """Largest force imbalance of a converged frame with contact [-]."""
    accuracy: Mapping[str, Any] | None = None
    """Asked, factor, expected, observed (`vsfsim.data.manifest.observed`); None of a dataset that promises none."""
    labels: float | None = None
    """Error of the truth's probe stiffness, the median over its points [-]; None where it is not known."""

    @property
    def ok(self) -> bool:
        """Nothing is wrong."""
        return not self.problems

    def table(self) -> dict[str, Any]:
        """For JSON."""
        return {**dataclasses.asdict(self), "path": str(self.path), "ok": self.ok}

    def text(self) -> str:
        """For the terminal."""
        share = 100.0 * self.unconverged / max(self.frames, 1)
        lines = [f"{self.path}: {self.files} files, {self.touches} touches ({self.untouched} met nothing), "
                 f"{self.frames} frames "
                 f"({self.unconverged} = {share:.1f} % unconverged, {self.unresolved} = "
                 f"{100.0 * self.unresolved / max(self.frames, 1):.1f} % not resolved by the mesh), "
                 f"worst force balance {self.worst_balance:.1e}"]
        if self.accuracy is not None:
            worst = 100 * (self.accuracy["observed"]["worst"] or 0.0)
            lines.append(f"accuracy of every reading: {verdict(self.accuracy)[0]}; the worst is off by {worst:.2g} %"
                         + f"; probe_stiffness is known to {100 * (self.labels or 0.0):.2g} % (median)"
                         * (self.labels is not None))
        lines += [f"  {problem}" for problem in self.problems]
        lines.append("ok" if self.ok else f"{len(self.problems)} problem{'s' if len(self.problems) > 1 else ''}")
        return "\n".join(lines)


def verify(path: str | Path, progress: Progress = lambda *_: None) -> Report:
    """Check the dataset in folder ``path``: hashes, schema, finiteness, force balance. ``progress`` is called with
    (files done, of how many, name).

    Unconverged and unresolved frames and touches that met nothing are counted, not complained about: they are marked as
    such.

    Returns:
        The report; `Report.problems` names every file that is wrong and what to do.

    Raises:
        DatasetError: there is no finished dataset there at all.
    """
    path = Path(path)
    try:
        dataset = Dataset.open(path)
    except DatasetError as error:
        if not (path / MANIFEST).is_file():
            raise
        return Report(path, (Problem(MANIFEST, str(error), ""),))
    whole: list[Entry] = []  # whose file is as it should be
    unresolved, untouched, worst, labels = 0, 0, 0.0, list[np.ndarray]()
    listed = {entry.file for entry in dataset.entries} | {MANIFEST, CARD}
    problems = [Problem(name, f"is not listed in {MANIFEST}.", "Remove it; it is no part of the dataset.")
                for name in sorted({p.name for p in path.iterdir()} - listed)]
    for done, entry in enumerate(dataset.entries):
        progress(done, len(dataset.entries), entry.name)
        file = path / entry.file
        fault = fault_of(file, entry.sha256)
        if fault is not None:
            problems.append(Problem(entry.file, *fault))
            continue
        view, faults = examine(file)
        problems += [Problem(entry.file, what, MAKE_AGAIN) for what in faults]
        if view is None:
            continue
        found = entry_of(view, file.read_bytes(), entry.made_on)
        problems += [Problem(entry.file, f"says {key} = {value!r}, {MANIFEST} says {getattr(entry, key)!r}.",
                             MAKE_AGAIN) for key, value in vars(found).items() if value != getattr(entry, key)]
        whole.append(found)
        if view.truth is not None and view.truth.probe_error is not None:
            labels.append(view.truth.probe_error / view.truth.probe_stiffness)
        for index, touch in enumerate(view.touches):
            balance = np.asarray(touch.audit["force_balance"])
            contact = contact_frames(touch)
            top = float(balance[contact].max(initial=0.0))
            worst = max(worst, top)
            if top > BALANCE_LIMIT:
                frame = int(np.flatnonzero(contact & (balance == top))[0])
                problems.append(Problem(
                    entry.file, f"touches/{index:03d} frame {frame}: force and reaction differ by {top:.1e} of the "
                    f"larger one, over {BALANCE_LIMIT:g}.", f"The solver lost force; {_REPORT_IT}"))
            if (lost := skin_loss(touch)) is not None:
                problems.append(Problem(
                    entry.file, f"touches/{index:03d} frame {lost[0]}: the forces on the nodes of the skin add up to "
                    f"{lost[1]:.2g} N off the force.", f"The read-out lost force; {_REPORT_IT}"))
            unresolved += int(unresolved_frames(touch).sum())
            untouched += int(not touch.touched)
    recipe = dataset.recipe
    promise = observed(recipe.options, [error for entry in whole for error in entry.audits])
    if promise is not None and (told := verdict(promise))[1]:
        problems.append(Problem(MANIFEST, f"promises an accuracy, which is {told[0]}.",
                                "Generate it again with a smaller --accuracy."))
    return Report(path, tuple(problems), len(whole), sum(e.touches for e in whole), sum(e.frames for e in whole),
                  sum(e.unconverged for e in whole), unresolved, untouched, worst, promise,
                  float(np.median(np.concatenate(labels))) if labels else None)


def skin_loss(touch: Touch) -> tuple[int, float] | None:
    """The first converged frame whose node forces do not add up to the force, and by how much they are off [N]; None if
    all do, or there is no skin."""
    if touch.node_force is None:
        return None
    off = np.linalg.norm(touch.node_force.astype(float).sum(axis=1) - touch.force, axis=1)
    bad = np.flatnonzero(touch.converged & ~(off <= SKIN_LIMIT + BALANCE_LIMIT * np.linalg.norm(touch.force, axis=1)))
    return (int(bad[0]), float(off[bad[0]])) if len(bad) else None


def unresolved_frames(touch: Touch) -> np.ndarray:
    """Converged frames that the mesh does not resolve (T,) bool; none where that was not measured."""
    return np.zeros(len(touch.converged), bool) if touch.resolved is None else touch.converged & ~touch.resolved


def contact_frames(touch: Touch) -> np.ndarray:
    """Converged frames whose force is over `CONTACT_FORCE` (T,) bool."""
    return touch.converged & (np.linalg.norm(np.nan_to_num(touch.force), axis=1) > CONTACT_FORCE)


@dataclass(frozen=True)
class Alike:
    """What `compare` found, in touches."""

    equal: int = 0
    """Every reading is equal to the bit."""
    close: int = 0
    """Forces are equal to `CLOSE`."""
    other: int = 0
    """The rest."""
    worst: float = 0.0
    """Largest relative difference of a force [-]."""
    first: str = ""
    """The first touch that is not equal to the bit, "" if there is none."""
    kinds: tuple[str, ...] = ()
    """Kinds of machines of the first dataset, then of the second."""

    def text(self) -> str:
        """For the terminal."""
        total = max(self.equal + self.close + self.other, 1)
        lines = [f"{name:<18}{n:6d} touches  {100.0 * n / total:5.1f} %" for name, n in
                 (("bit-equal", self.equal), (f"equal to {CLOSE:g}", self.close), ("other", self.other))]
        lines.append(f"largest difference of a force: {self.worst:.1e} of the largest of its touch"
                     + f", first in {self.first}" * bool(self.first))
        return "\n".join([*lines, *(f"made on {kind}" for kind in self.kinds)])


def compare(one: str | Path, other: str | Path, progress: Progress | None = None) -> Alike:
    """Compare two datasets touch by touch, made on any devices. ``progress`` is called with (views done, of how many,
    name).

    Raises:
        DatasetError: one of them is none, or they are of different recipes or code.
    """
    a, b = Dataset.open(one, progress=progress), Dataset.open(other)
    differences = a.recipe.differences(dataclasses.replace(b.recipe, device=a.recipe.device))
    if differences:
        raise DatasetError(f"{one} and {other} are of different recipes: {'; '.join(differences)}.")
    if set(a.names()) != set(b.names()):
        raise DatasetError(f"{one} and {other} hold different object views: "
                           f"{', '.join(sorted(set(a.names()) ^ set(b.names()))[:5])} in one only.")
    counts, worst, first = {"equal": 0, "close": 0, "other": 0}, 0.0, ""
    for view in a:
        for index, (p, q) in enumerate(zip(view.touches, b.load(view.name).touches, strict=True)):
            mine, theirs = values_of(p), values_of(q)
            if mine.keys() == theirs.keys() and all(np.asarray(mine[k]).tobytes() == np.asarray(theirs[k]).tobytes()
                                                    for k in mine):
                counts["equal"] += 1
                continue
            apart = difference(p, q)
            worst, first = max(worst, apart), first or f"{view.name} touches/{index:03d}"
            counts["close" if apart <= CLOSE else "other"] += 1
    kinds = tuple(dict.fromkeys(e.made_on or "not recorded" for data in (a, b) for e in data.entries))
    return Alike(**counts, worst=worst, first=first, kinds=kinds)


def difference(one: Touch, other: Touch) -> float:
    """Largest difference of the force over the largest force of a touch [-]; infinite where frames or their marks
    differ."""
    if one.force.shape != other.force.shape or not np.array_equal(one.converged, other.converged):
        return float("inf")
    good = one.converged
    size = float(np.linalg.norm(one.force[good], axis=1).max(initial=0.0))
    apart = float(np.linalg.norm((one.force - other.force)[good], axis=1).max(initial=0.0))
    return apart / size if size > 0.0 else (0.0 if apart == 0.0 else float("inf"))


_OPTIONAL = {"pressure": " Pa over the free dome's, converged frames", "det F": ", converged frames"}
"""Rows that not every dataset has, with what follows their numbers."""


def summary_rows(path: str | Path, progress: Progress | None = None) -> list[tuple[str, str]]:
    """Objects, splits, touches, frames, forces, effort, truth and size of the dataset in folder ``path``, each with its
    name.

    Raises:
        DatasetError: no finished dataset there.
    """
    dataset = Dataset.open(path, progress=progress)
    recipe, entries = dataset.recipe, dataset.entries
    found: dict[str, list[np.ndarray]] = defaultdict(list)  # of the frames or touches, by what it is
    regions: dict[str, list[np.ndarray]] = defaultdict(list)
    reasons: Counter[str] = Counter()
    for view in dataset:
        for touch in view.touches:
            good, lost = touch.converged, unresolved_frames(touch)
            found["touched"].append(np.array([touch.touched]))
            found["force"].append(touch.normal_force()[good])
            found["iterations"].append(touch.iterations)
            found["balance"].append(np.asarray(touch.audit["force_balance"])[contact_frames(touch)])
            found["unresolved"].append(np.asarray(touch.audit.get("mesh_error", np.zeros(len(lost))))[lost])
            if touch.pressure is not None and touch.rest_pressure is not None:
                found["pressure"].append((touch.pressure - touch.rest_pressure)[good])
            if "min_det_f" in touch.audit:  # a plant has none
                found["det F"].append(np.asarray(touch.audit["min_det_f"])[good])
            reasons.update(touch.reason_names[int(code) - 1] for code in touch.reason[touch.reason > 0])
        assert view.truth is not None
        found["modulus"].append(view.truth.young_modulus)
        for index, name in enumerate(view.truth.region_names):
            regions[name].append(view.truth.young_modulus[view.truth.region == index])
    whole = {name: np.concatenate(parts) for name, parts in found.items()}
    frames, unconverged = sum(e.frames for e in entries), sum(e.unconverged for e in entries)
    by_split = {split: len({e.object_index for e in entries if e.split == split}) for split in dataset.splits}
    unresolved, iterations = whole["unresolved"], whole["iterations"]
    return [
        ("dataset", f"{dataset.path}   sha256 {dataset.sha256[:12]}"),
        ("recipe", f"scene {recipe.scene}, seed {recipe.seed}, tier {recipe.tier}, {recipe.device}, "
                   f"{recipe.precision}, renderer {recipe.renderer}"),
        ("made by", f"vsfsim {dataset.made_by['vsfsim']}, commit {dataset.made_by['commit'] or 'unknown'}"),
        ("objects", f"{len({e.object_index for e in entries})} in {len(dataset)} views: "
                    + ", ".join(f"{n} {split}" for split, n in by_split.items())),
        ("touches", f"{len(whole['touched'])}, {int((~whole['touched']).sum())} met nothing"),
        ("frames", f"{frames}, {unconverged} unconverged ({100.0 * unconverged / max(frames, 1):.1f} %)"),
        *([("not resolved", f"{len(unresolved)} frames ({100.0 * len(unresolved) / max(frames, 1):.1f} %): the mesh is "
                            f"too coarse for the contact or the parts inside; estimated error of the force up to "
                            f"{100.0 * unresolved.max():.0f} %")] if len(unresolved) else []),
        ("normal force", f"{_span(whole['force'])} N, converged frames"),
        *((name, f"{_span(whole[name])}{words}") for name, words in _OPTIONAL.items() if name in whole),
        ("iterations", f"mean {iterations.mean():.1f}, most {iterations.max()} a frame" if iterations.size else "none"),
        ("force balance", f"worst {whole['balance'].max(initial=0.0):.1e} of the force, converged frames in contact"),
        *(("  reason", f"{count} frames: {why}") for why, count in sorted(reasons.items())),
        ("true E", f"{_span(whole['modulus'])} Pa over all elements"),
        *((f"  {name}", f"{_span(np.concatenate(parts))} Pa") for name, parts in regions.items()),
        ("on disk", f"{sum(e.bytes for e in entries) / 1e6:.1f} MB")]


def _span(values: np.ndarray) -> str:
    values = values[np.isfinite(values)]  # NaN: no sensor of a recording read it
    return f"{values.min() + 0.0:.3g} to {values.max():.3g}" if values.size else "none"
