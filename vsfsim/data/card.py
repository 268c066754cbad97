"""The card of a dataset: README.md of its folder, what it holds and how it is read."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence

from vsfsim.data.manifest import Entry
from vsfsim.data.recipe import Recipe


def card(recipe: Recipe, made_by: Mapping[str, str | None], entries: Sequence[Entry],
         left_out: Mapping[str, str] | None = None) -> str:
    """The text of the card, with the front matter that dataset hubs read.

    Args:
        recipe: what the dataset was made from. made_by: version and commit. entries: its files. left_out: object views
        that could not be made, with the reason.
    """
    touches, frames = sum(e.touches for e in entries), sum(e.frames for e in entries)
    unconverged = sum(e.unconverged for e in entries)
    objects = {split: len({e.object_index for e in entries if e.split == split})
               for split in dict.fromkeys(e.split for e in entries)}
    kinds = Counter(e.made_on or "not recorded" for e in entries)
    size = "n<1K" if touches < 1000 else "1K<n<10K" if touches < 10_000 else "10K<n<100K" if touches < 100_000 else \
        "100K<n<1M"
    out = [
        "---", f"pretty_name: {recipe.scene} (vsfsim, seed {recipe.seed})", "license: apache-2.0",
        "tags: [simulation, tactile, robotics, stiffness]", f"size_categories: ['{size}']", "---", "",
        f"# {recipe.scene}", "",
        f"Simulated vision and touch of {sum(objects.values())} deformable objects, with their true stiffness: "
        f"{len(entries)} object views, {touches} touches, {frames} frames, of which {unconverged} did not converge and "
        f"are marked.", "", "| | |", "|---|---|",
        f"| objects | {', '.join(f'{n} {split}' for split, n in objects.items())} |",
        f"| scene | {recipe.scene}, seed {recipe.seed}, tier {recipe.tier}, {recipe.precision} on {recipe.device} |",
        f"| made by | vsfsim {made_by.get('vsfsim')}, commit {made_by.get('commit') or 'unknown'} |",
        *(f"| made on | {kind}: {n} files |" for kind, n in kinds.items()),
        f"| size | {sum(e.bytes for e in entries) / 1e6:.1f} MB |", "",
        "Each `.h5` file is one object view: an RGB-D image, its touches with poses and forces by frame, and "
        "under `truth/` what no estimator may see. Every array carries its unit and its dimensions. The data are "
        "simulated: "
        "touches are quasi-static, and materials come from the literature, not from the objects that a scene imitates.",
        "", "```python", "import vsfsim", 'dataset = vsfsim.load("FOLDER")',
        "print(dataset, dataset[0].touches[0].force)",
        "```", "", "`vsfsim verify FOLDER` checks every byte, field and frame against `dataset.json`, and that holds "
        "the whole scene file. The same `vsfsim generate` makes the same bytes again on such a machine.", ""]
    if left_out:
        out += ["## Left out", "", *(f"- {name}: {reason}" for name, reason in left_out.items()), ""]
    return "\n".join(out)
