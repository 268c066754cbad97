"""A dataset in a dozen lines."""

from __future__ import annotations

from collections import Counter, defaultdict
from pathlib import Path

import numpy as np

from vsfsim.data.dataset import Dataset, Progress
from vsfsim.data.verify import contact_frames, unresolved_frames

_AUDIT = {"min_det_f": ", all converged frames", "energy": " J", "penetration": " m"}
"""Columns of the audit that are told, with what follows their numbers."""


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
            found["ended"].append(np.array([touch.ended or 0]))
            found["force"].append(touch.normal_force()[good])
            found["iterations"].append(touch.iterations)
            found["balance"].append(np.asarray(touch.audit["force_balance"])[contact_frames(touch)])
            found["unresolved"].append(np.asarray(touch.audit.get("mesh_error", np.zeros(len(lost))))[lost])
            if touch.pressure is not None and touch.rest_pressure is not None:
                found["pressure"].append((touch.pressure - touch.rest_pressure)[good])
            for name in _AUDIT.keys() & touch.audit.keys():  # a plant has no det F
                found[name].append(np.asarray(touch.audit[name])[good])
            reasons.update(touch.reason_names[int(code) - 1] for code in touch.reason[touch.reason > 0])
        assert view.truth is not None
        found["modulus"].append(view.truth.young_modulus)
        for index, name in enumerate(view.truth.region_names):
            regions[name].append(view.truth.young_modulus[view.truth.region == index])
    whole = {name: np.concatenate(parts) for name, parts in found.items()}
    frames, unconverged = sum(e.frames for e in entries), sum(e.unconverged for e in entries)
    by_split = {split: len({e.object_index for e in entries if e.split == split}) for split in dataset.splits}
    unresolved, iterations = whole["unresolved"], whole["iterations"]
    rows = [
        ("dataset", f"{dataset.path}   sha256 {dataset.sha256[:12]}"),
        ("recipe", f"scene {recipe.scene}, seed {recipe.seed}, tier {recipe.tier}, {recipe.device}, "
                   f"{recipe.precision}, renderer {recipe.renderer}"),
        ("made by", f"vsfsim {dataset.made_by['vsfsim']}, commit {dataset.made_by['commit'] or 'unknown'}"),
        ("objects", f"{len({e.object_index for e in entries})} in {len(dataset)} views: "
                    + ", ".join(f"{n} {split}" for split, n in by_split.items())),
        ("touches", f"{len(whole['touched'])}, {int((~whole['touched']).sum())} met nothing")]
    if whole["ended"].any():
        rows.append(("ended early", f"{int((whole['ended'] == 1).sum())} touches at the arm's protective stop, "
                                    f"{int((whole['ended'] == 2).sum())} with the solver's iterations used up"))
    rows.append(("frames", f"{frames}, {unconverged} unconverged ({100.0 * unconverged / max(frames, 1):.1f} %)"))
    if len(unresolved):
        rows.append(("not resolved", f"{len(unresolved)} frames ({100.0 * len(unresolved) / max(frames, 1):.1f} %): "
                                     f"the mesh is too coarse for the contact or the parts inside; estimated error of "
                                     f"the force up to {100.0 * unresolved.max():.0f} %"))
    rows.append(("normal force", f"{_span(whole['force'])} N, converged frames"))
    if "pressure" in whole:
        rows.append(("pressure", f"{_span(whole['pressure'])} Pa over the free dome's, converged frames"))
    rows += [
        ("iterations", f"mean {iterations.mean():.1f}, most {iterations.max()} a frame" if iterations.size else "none"),
        ("force balance", f"worst {whole['balance'].max(initial=0.0):.1e} of the force, converged frames in contact"),
        *((name.replace("_", " "), f"{_span(whole[name])}{unit}") for name, unit in _AUDIT.items() if name in whole),
        *(("  reason", f"{count} frames: {why}") for why, count in sorted(reasons.items())),
        ("true E", f"{_span(whole['modulus'])} Pa over all elements"),
        *((f"  {name}", f"{_span(np.concatenate(parts))} Pa") for name, parts in regions.items()),
        ("on disk", f"{sum(e.bytes for e in entries) / 1e6:.1f} MB")]
    return rows


def _span(values: np.ndarray) -> str:
    values = values[np.isfinite(values)]  # NaN: no sensor of a recording read it
    return f"{values.min() + 0.0:.3g} to {values.max():.3g}" if values.size else "none"
