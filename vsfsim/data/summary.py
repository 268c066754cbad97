"""A dataset in a dozen lines."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from vsfsim.data.dataset import Dataset, Progress
from vsfsim.data.verify import contact_frames, unresolved_frames


def summary(path: str | Path) -> str:
    """`summary_rows` as text, one line a row.

    Raises:
        DatasetError: no finished dataset there.
    """
    return "\n".join(f"{key:<16}{value}" for key, value in summary_rows(path))


def summary_rows(path: str | Path, progress: Progress | None = None) -> list[tuple[str, str]]:
    """Objects, splits, touches, frames, forces, effort, truth and size of the dataset in folder ``path``, each with its
    name.

    Raises:
        DatasetError: no finished dataset there.
    """
    dataset = Dataset.open(path, progress=progress)
    recipe = dataset.recipe
    force, change, iterations, balance, modulus = [], [], [], [], []
    regions: dict[str, Any] = {}
    touched = 0
    ended, unresolved, worst = [0, 0, 0], 0, 0.0
    audit: dict[tuple[str, str], list[Any]] = {
        ("min_det_f", ", all converged frames"): [], ("energy", " J"): [], ("penetration", " m"): []}
    reasons: dict[str, int] = {}
    for view in dataset:
        for touch in view.touches:
            force.append(touch.normal_force()[touch.converged])
            if touch.pressure is not None and touch.rest_pressure is not None:
                change.append((touch.pressure - touch.rest_pressure)[touch.converged])
            iterations.append(touch.iterations)
            balance.append(np.asarray(touch.audit["force_balance"])[contact_frames(touch)])
            touched += touch.touched
            if (lost := unresolved_frames(touch)).any():
                unresolved += int(lost.sum())
                worst = max(worst, float(np.asarray(touch.audit.get("mesh_error", np.zeros(len(lost))))[lost].max()))
            ended[touch.ended or 0] += 1
            for (name, _), values in audit.items():
                if touch.audit.get(name) is not None:  # a plant has no det F
                    values.append(np.asarray(touch.audit[name])[touch.converged])
            for code in touch.reason[touch.reason > 0]:
                why = touch.reason_names[int(code) - 1]
                reasons[why] = reasons.get(why, 0) + 1
        assert view.truth is not None
        modulus.append(view.truth.young_modulus)
        for index, name in enumerate(view.truth.region_names):
            regions.setdefault(name, []).append(view.truth.young_modulus[view.truth.region == index])
    force_all, iterations_all, balance_all, modulus_all = (np.concatenate(x) if x else np.zeros(0)
                                                           for x in (force, iterations, balance, modulus))
    touches = sum(e.touches for e in dataset.entries)
    frames = sum(e.frames for e in dataset.entries)
    unconverged = sum(e.unconverged for e in dataset.entries)
    objects = len({e.object_index for e in dataset.entries})
    by_split = {split: len({e.object_index for e in dataset.entries if e.split == split})
                for split in dict.fromkeys(e.split for e in dataset.entries)}
    rows = [
        ("dataset", f"{dataset.path}   sha256 {dataset.sha256[:12]}"),
        ("recipe", f"scene {recipe.scene}, seed {recipe.seed}, tier {recipe.tier}, {recipe.device}, "
                   f"{recipe.precision}, renderer {recipe.renderer}"),
        ("made by", f"vsfsim {dataset.made_by['vsfsim']}, commit {dataset.made_by['commit'] or 'unknown'}"),
        ("objects", f"{objects} in {len(dataset)} views: "
                    + ", ".join(f"{n} {split}" for split, n in by_split.items())),
        ("touches", f"{touches}, {touches - touched} met nothing"),
        *([("ended early", f"{ended[1]} touches at the arm's protective stop, {ended[2]} with the solver's "
                           f"iterations used up")] if any(ended[1:]) else []),
        ("frames", f"{frames}, {unconverged} unconverged ({100.0 * unconverged / max(frames, 1):.1f} %)"),
        *([("not resolved", f"{unresolved} frames ({100.0 * unresolved / max(frames, 1):.1f} %): the mesh is too "
                            f"coarse for the contact or the parts inside; estimated error of the force up to "
                            f"{100.0 * worst:.0f} %")]
          if unresolved else []),
        ("normal force", f"{_span(force_all)} N, converged frames"),
        *([("pressure", f"{_span(np.concatenate(change))} Pa over the free dome's, converged frames")] if change
          else []),
        ("iterations", f"mean {iterations_all.mean():.1f}, most {iterations_all.max()} a frame" if iterations_all.size
         else "none"),
        ("force balance", f"worst {balance_all.max(initial=0.0):.1e} of the force, converged frames in contact"),
        *((name.replace("_", " "), f"{_span(np.concatenate(values))}{unit}") for (name, unit),
          values in audit.items() if values),
        *(("  reason", f"{count} frames: {why}") for why, count in sorted(reasons.items())),
        ("true E", f"{_span(modulus_all)} Pa over all elements"),
    ]
    rows += [(f"  {name}", f"{_span(np.concatenate(parts))} Pa") for name, parts in regions.items()]
    rows.append(("on disk", f"{sum(e.bytes for e in dataset.entries) / 1e6:.1f} MB"))
    return rows


def _span(values: np.ndarray) -> str:
    values = values[np.isfinite(values)]  # NaN: no sensor of a recording read it
    return f"{values.min() + 0.0:.3g} to {values.max():.3g}" if values.size else "none"
