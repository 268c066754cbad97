"""dataset.json: one entry a file, a digest by which no byte of it changes unseen, and whether a dataset that was made
for an accuracy keeps it, by its touches that have a reference; and README.md, the card for people and dataset hubs."""

from __future__ import annotations

import dataclasses
import hashlib
import json
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import msgspec
import numpy as np

from vsfsim.core.errors import DatasetError
from vsfsim.core.plain_text import from_json, plain
from vsfsim.core.table import Count, typed, value
from vsfsim.data.recipe import Recipe
from vsfsim.data.records import ObjectView, Touch
from vsfsim.data.safety import NAME
from vsfsim.data.schema import SCHEMA_VERSION

FORMAT = "vsfsim-dataset"
MANIFEST = "dataset.json"
PART_MANIFEST = "dataset.part.json"
LOCK = "dataset.lock"
CARD = "README.md"
"""What the folder is, for people; no part of the content."""
_OPTIONAL = ("made_on", "audits")
Name = Annotated[str, msgspec.Meta(pattern=rf"\A{NAME}\Z", description="a name: letters, digits and . _ + -, no path")]
LARGEST_MANIFEST = 64 << 20
"""A dataset.json with more bytes is not read."""
NOISE = 0.15
"""Force from which a reading counts: what a Kinova Gen3's estimate of the contact force is off by, as the tasks have it
[N]."""
ENOUGH, SURE = 0.95, 0.90
"""Share of the touches that a promise holds for, and the least that its audits must show [-]."""
ROUNDING = 1e-6
"""Difference of two simulations on one mesh, at most [-]."""
RISK = 0.05
"""Probability with which either verdict of a promise may be wrong [-]."""


@dataclass(frozen=True)
class Entry:
    """One object file as dataset.json lists it."""

    name: Name
    """Of the object view."""
    file: Name
    """File name."""
    split: Name
    """"train", "test", ..."""
    object_index: Count
    """From 0."""
    view_index: Count
    """Of the view of that object, from 0."""
    touches: Count
    """Number of touches."""
    frames: Count
    """Of all touches."""
    unconverged: Count
    """Frames that are marked as not converged."""
    bytes: Count
    """Size of the file."""
    sha256: Name
    """Of the file."""
    made_on: str = ""
    """The kind of CPU, or of GPU and CPU, that made it; "" in a dataset of a version that did not say."""
    audits: tuple[Annotated[float, msgspec.Meta(ge=0.0)], ...] = ()
    """Errors of its touches that have a reference, see `audit_error` [-]."""

    def table(self) -> dict[str, Any]:
        """As JSON values."""
        out = {**dataclasses.asdict(self), "audits": list(self.audits)}
        return {key: value for key, value in out.items() if value or key not in _OPTIONAL}


def entry_of(view: ObjectView, content: bytes, made_on: str) -> Entry:
    """That of an object view with the content of its file."""
    return Entry(view.name, file_name(view.name), view.split, view.object_index, view.view_index, len(view.touches),
                 sum(len(touch.time) for touch in view.touches),
                 sum(int((~touch.converged).sum()) for touch in view.touches), len(content),
                 hashlib.sha256(content).hexdigest(), made_on, tuple(
                     float(f"{min(error, 1e3):.4g}") for error in map(audit_error, view.touches) if error is not None))


def content_sha256(entries: tuple[Entry, ...]) -> str:
    """See `Dataset.sha256`."""
    lines = "".join(f"{entry.name} {entry.split} {entry.sha256}\n" for entry in entries)
    return hashlib.sha256(lines.encode()).hexdigest()


def file_name(name: str) -> str:
    """File of the object view ``name``."""
    return f"{name}.h5"


def manifest_bytes(table: Mapping[str, Any]) -> bytes:
    """dataset.json as bytes; its first key ``digest`` is the sha256 of all the others, so that no byte can change
    unseen."""
    body = {key: value for key, value in table.items() if key != "digest"}
    digest = hashlib.sha256(json.dumps(body, sort_keys=True).encode()).hexdigest()
    return (json.dumps({"digest": digest, **body}, indent=1) + "\n").encode()


def make_manifest(recipe: Recipe, made_by: Mapping[str, str | None], entries: tuple[Entry, ...],
                  left_out: Mapping[str, str] | None = None) -> bytes:
    """dataset.json of a finished dataset; no times and no paths, so that a second run gives the same bytes.

    Args:
        recipe: what it was made from. made_by: version and commit. entries: its files. left_out: names of object views
        that could not be made, with the reason.
    """
    promise = observed(recipe.options, [error for entry in entries for error in entry.audits])
    return manifest_bytes({"format": FORMAT, "schema_version": SCHEMA_VERSION, "made_by": dict(made_by),
                           "sha256": content_sha256(entries), "recipe": recipe.table(),
                           **({"left_out": dict(left_out)} if left_out else {}),
                           **({"accuracy": promise} if promise else {}),
                           "files": [entry.table() for entry in entries]})


def parse_manifest(content: bytes, path: Path) -> dict[str, Any]:
    """The table of a dataset.json, after a check that it is whole.

    Args:
        content: of the file. path: for messages; one named `PART_MANIFEST` has no files yet.

    Raises:
        DatasetError: not readable, changed since it was written, or of another schema version.
    """
    try:
        if len(content) > LARGEST_MANIFEST:
            raise ValueError(f"it has more than {LARGEST_MANIFEST} bytes")
        table = from_json(content)
        format_, version = table["format"], table.get("schema_version")
        whole = manifest_bytes(table) == content
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        raise DatasetError(f"{path} cannot be read as a dataset's manifest: {plain(repr(error))}. It is damaged; "
                           f"delete the folder and generate the dataset again, or restore the file.") from error
    if format_ != FORMAT:
        raise DatasetError(f"{path} is not the manifest of a vsfsim dataset (format "
                           f"{plain(repr(format_), longest=60)}).")
    if version != SCHEMA_VERSION:
        raise DatasetError(f"{path} has schema version {plain(version, longest=60)}; this vsfsim reads "
                           f"{SCHEMA_VERSION}. Use the vsfsim version it names under made_by, or generate it again.")
    if not whole:
        raise DatasetError(f"{path} was changed after it was written (its digest does not fit). Restore the file, or "
                           f"delete the folder and run the same `vsfsim generate` again.")
    asked = {"made_by": dict[str, str | None], "recipe": dict[str, Any], "left_out": dict[str, str], "files": list}
    if path.name == PART_MANIFEST:
        del asked["files"]
    for key, kind in asked.items():
        table[key] = value(table.get(key, {} if key == "left_out" else None), kind, f"{path}: {key}", DatasetError)
    return table


def entries_of(rows: list[Any], path: Path) -> tuple[Entry, ...]:
    """The entries of ``files``, none of them twice, and no object in two splits."""
    if not rows:
        raise DatasetError(f"{path}: files is empty; a dataset has at least one entry.")
    try:
        entries = tuple(typed(row, Entry, f"{path} files[{k}]", error=DatasetError) for k, row in enumerate(rows))
    except DatasetError as error:
        raise DatasetError(f"{plain(error, longest=500)} The dataset is damaged; generate it again.") from None
    for what, keys in (("name", [e.name for e in entries]), ("file", [e.file for e in entries]),
                       ("object and view", [(e.object_index, e.view_index) for e in entries]),
                       ("content", [e.sha256 for e in entries])):
        twice = [key for key, count in Counter(keys).items() if count > 1]
        if twice:
            raise DatasetError(f"{path}: the {what} {twice[0]} is there twice; a dataset holds everything once. Delete "
                               f"the folder and generate it again.")
    splits: dict[int, str] = {}
    for entry in entries:
        if splits.setdefault(entry.object_index, entry.split) != entry.split:
            raise DatasetError(f"{path}: object {entry.object_index} is in the splits {splits[entry.object_index]} and "
                               f"{entry.split}; an object belongs to one.")
    return entries


def audit_error(touch: Touch) -> float | None:
    """Error of a touch by its audit [-], None if it was not audited or met nothing; see `error_against`."""
    if "reference_force" not in touch.audit:
        return None
    force, error, found = (np.asarray(touch.audit[f"reference_{name}"]) for name in ("force", "error", "converged"))
    return error_against(touch.force, touch.converged, force, found.astype(bool), error)


def error_against(force: np.ndarray, converged: np.ndarray, wanted: np.ndarray, found: np.ndarray,
                  error: np.ndarray | float = 0.0) -> float | None:
    """Largest error of a reading of a touch over the force wanted there [-], of the frames in which one of both is
    above `NOISE`; None if none is. Infinite if a frame was lost, which has no equilibrium in one of both.

    Args:
        force, wanted: (T, 3) [N]. converged, found: frames of each with an equilibrium (T,). error: of ``wanted``; it
        counts against the touch (T,) [N].
    """
    if not (converged & found).all():
        return float("inf")
    size = np.linalg.norm(wanted, axis=1)
    on = np.maximum(size, np.linalg.norm(force, axis=1)) > NOISE
    off = (np.linalg.norm(force - wanted, axis=1) + error)[on] / np.maximum(size[on], NOISE)
    return float(np.where(np.isfinite(off), off, np.inf).max()) if on.any() else None


def apart(coarse: Touch, fine: Touch) -> float:
    """By how much two simulations of a touch differ, see `error_against`; 0 if neither meets anything, and infinite if
    they are the same but for rounding, because two settings that gave one mesh tell nothing of its error."""
    off = error_against(coarse.force, coarse.converged, fine.force, fine.converged)
    return 0.0 if off is None else off if off > ROUNDING else float("inf")


def observed(options: Mapping[str, Any], errors: Sequence[float]) -> dict[str, Any] | None:
    """What dataset.json says of an accuracy: asked, factor, expected, observed; None if none was asked for.

    Args:
        options: of the recipe. errors: of all audited touches [-].
    """
    promise = options.get("accuracy")
    if not isinstance(promise, Mapping):
        return None
    kept = int(np.sum(np.asarray(errors, float) <= promise["asked"]))
    return {"asked": promise["asked"], "factor": promise["factor"], "expected": promise["expected"],
            "observed": {"audits": len(errors), "kept": kept, "worst": max(errors, default=None)}}


def least_share(kept: int, audits: int) -> float:
    """Least share of touches [-] of which ``kept`` of ``audits`` or more are kept with a probability of `RISK`: the
    exact one-sided bound of Clopper and Pearson 1934, Biometrika 26, 404."""
    from scipy.special import betaincinv  # takes a tenth of a second

    return float(betaincinv(kept, audits - kept + 1, RISK)) if kept else 0.0


def verdict(found: Mapping[str, Any]) -> tuple[str, bool]:
    """What the audits of a promise, as `observed` gives it, say of it, and whether they refute it."""
    seen = found["observed"]
    kept, audits = seen["kept"], seen["audits"]
    least, most = least_share(kept, audits), 1.0 - least_share(audits - kept, audits)
    said = (f"{kept} of {audits} audited touches are within {100 * found['asked']:g} %, so that {100 * least:.0f} to "
            f"{100 * most:.0f} % of all are")
    if most < ENOUGH:
        return f"broken: {said}, under {100 * ENOUGH:g} %", True
    if kept >= ENOUGH * audits and least >= SURE:
        return f"kept: {said}", False
    needed = audits + 1
    while least_share(needed - (audits - kept), needed) < SURE or audits - kept > (1.0 - ENOUGH) * needed:
        needed += 1
    return f"cannot tell yet: {said}; {needed} audits are needed if no more touches break it", False


def card(recipe: Recipe, made_by: Mapping[str, str | None], entries: Sequence[Entry],
         left_out: Mapping[str, str] | None = None) -> str:
    """The text of the card, with the front matter that dataset hubs read.

    Args:
        recipe: what the dataset was made from. made_by: version and commit. entries: its files. left_out: object views
        that could not be made, with the reason.
    """
    import jinja2  # not needed to read a dataset

    touches = sum(e.touches for e in entries)
    objects = {split: len({e.object_index for e in entries if e.split == split})
               for split in dict.fromkeys(e.split for e in entries)}
    size = "n<1K" if touches < 1000 else "1K<n<10K" if touches < 10_000 else "10K<n<100K" if touches < 100_000 else \
        "100K<n<1M"
    text = Path(__file__).with_name("card.md").read_text(encoding="utf-8")
    return jinja2.Template(text, trim_blocks=True, keep_trailing_newline=True).render(
        recipe=recipe, made_by=made_by, entries=entries, left_out=left_out, touches=touches, objects=objects, size=size,
        kinds=Counter(e.made_on or "not recorded" for e in entries))
