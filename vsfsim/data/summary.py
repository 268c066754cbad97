"""A dataset in a dozen lines."""

from __future__ import annotations

from collections import Counter, defaultdict
from pathlib import Path

import numpy as np

from vsfsim.data.dataset import Dataset, Progress
from vsfsim.data.verify import contact_frames, unresolved_frames

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
