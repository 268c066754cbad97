"""How hard shoes push back: force on the probe at some travel by part and material, and by class, from a dataset."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from measurements.measurement import Column, Measurement, Progress, Table
from vsfsim.bench.task import load_task
from vsfsim.bench.trials.training import Training
from vsfsim.core import shelf
from vsfsim.core.errors import SceneError
from vsfsim.core.scene import parse_scene
from vsfsim.core.shape import Family
from vsfsim.data.dataset import Dataset
from vsfsim.data.recipe import Recipe
from vsfsim.data.records import Touch
from vsfsim.data.streams import Stream, stream
from vsfsim.papers.study import load_study
from vsfsim.scenes._footwear_models import MODELS, PARTS

SCENE = "shoes-v2-mini"
"""Whose dataset is measured if none is given."""
CLASSES = "shoes-breadth"
"""The study that names the classes of shoes."""
CONTACT = 0.05
"""Force above which a touch counts as in contact [N]; the travel begins at that force."""


def travel(touch: Touch) -> tuple[np.ndarray, np.ndarray]:
    """Travel of the mount since contact (t,) [m], from 0, and force against the press (t,) [N] of the frames that
    converged; empty where there was no contact."""
    force = touch.normal_force()
    along = (touch.mount_pose[:, :3, 3] - touch.mount_pose[0, :3, 3]) @ touch.axis
    good = touch.converged & np.isfinite(force)
    along, force = along[good], force[good]
    met = np.flatnonzero(force > CONTACT)
    if not len(met) or met[0] == 0:
        return np.zeros(0), np.zeros(0)
    # the first frame in contact tells the stiffness of the first contact, and so where it began
    first = met[0]
    after = met[1] if len(met) > 1 and met[1] == first + 1 else first
    slope = (force[after] - force[first]) / (along[after] - along[first]) if after > first else np.inf
    start = max(along[first] - force[first] / slope, along[first - 1]) if slope > 0.0 else along[first - 1]
    return np.concatenate([[0.0], along[first:] - start]), np.concatenate([[0.0], force[first:]])


def materials(recipe: Recipe, number: int) -> dict[str, str]:
    """Material of each part of shoe ``number`` of a dataset of named shoes.

    Raises:
        SceneError: the scene's objects are not named shoes.
    """
    scene = parse_scene(recipe.scene_text, f"{recipe.scene}.toml").sample(stream(recipe.seed, Stream.SCENE, number),
                                                                          number=number)
    shape = scene.object.shape
    name = shape.parameters.get("model") if isinstance(shape, Family) else None
    if name not in MODELS:
        raise SceneError(f"the objects of scene {recipe.scene} are not named shoes; give a dataset of shoes-v2, "
                         f"shoes-v2-mini or their like.")
    return dict(zip(PARTS, MODELS[name].materials, strict=True))


def default_folder() -> Path:
    """Where the dataset of `SCENE` is that a task asks for."""
    tasks = map(load_task, shelf.tasks())
    return next(t.dataset.path() for t in tasks if t.dataset.scene == SCENE)


def measure(folder: Path | None = None, *, depths: Sequence[float] = (0.005, 0.010),
            progress: Progress | None = None) -> Measurement:
    """Median force over touches at the travels ``depths`` [m], by part and material, and how far classes differ.

    A touch that ends before a travel does not count there. The part is that of the tetrahedron nearest to the touch's
    target.

    Args:
        folder: of a dataset of named shoes; None: `default_folder`.
        depths: travels [m].
        progress: called with what is going on.

    Raises:
        SceneError: the objects are not named shoes. DatasetError: there is no dataset.
    """
    dataset = Dataset.open(folder or default_folder())
    found: dict[tuple[str, str], list[list[float]]] = {}
    largest: dict[int, list[float]] = {}
    for entry in dataset.entries:
        if progress is not None:
            progress(entry.name)
        view, own = dataset.load(entry.name), materials(dataset.recipe, entry.object_index)
        assert view.truth is not None
        tree = cKDTree(view.truth.points)
        for touch in view.touches:
            far, force = travel(touch)
            if len(force):
                largest.setdefault(entry.object_index, []).append(float(np.log(force.max())))
            part = view.truth.region_names[view.truth.region[tree.query(touch.target)[1]]]
            kind = "wall" if part in ("upper", "toe_cap", "heel_counter") else part
            found.setdefault((kind, own[part]), []).append(
                [float(np.interp(d, far, force)) if len(far) and far[-1] >= d else np.nan for d in depths])
    rows = []
    for (part, material), values in sorted(found.items()):
        known = [np.array([v[k] for v in values if np.isfinite(v[k])]) for k in range(len(depths))]
        rows.append({"part": part, "material": material, "force": [float(np.median(x)) if len(x) else None
                                                                   for x in known],
                     "touches": [len(x) for x in known]})
    columns = [Column("part", "part"), Column("material", "material")]
    for k, depth in enumerate(depths):
        columns += [Column(f"force.{k}", f"at {1e3 * depth:g} mm", "N", form=".1f"),
                    Column(f"touches.{k}", "touches", "1", form="d")]
    title = f"Median force over touches of {dataset.recipe.scene}, by travel of the mount since contact"
    return Measurement.of("shoe-forces", {"dataset": dataset.path.name, "depths_m": list(depths)},
                          [Table(title, columns, rows, "parts"), *_classes(dataset, largest)])


def _classes(dataset: Dataset, largest: Mapping[int, Sequence[float]]) -> list[Table]:
    """How far shoes of a class and the means of classes differ, by each shoe's mean logarithm of the largest force of a
    touch, which all touches reach by the same range of depths.

    Args:
        dataset: of named shoes. largest: those logarithms, by number of the shoe.
    """
    kind = Training(classes=load_study(CLASSES).classes).classes_of(dataset)
    shoes: dict[str, list[float]] = {}
    for number, values in largest.items():
        shoes.setdefault(kind[number], []).append(float(np.mean(values)))
    many = {name: values for name, values in shoes.items() if len(values) > 1}
    if len(many) < 2:
        return []
    within = float(np.mean([np.var(values, ddof=1) for values in many.values()]))
    chance = within * float(np.mean([1.0 / len(values) for values in many.values()]))
    means = [float(np.mean(values)) for values in many.values()]
    rows = [{"class": name, "shoes": len(values), "force": float(np.exp(np.mean(values))),
             "spread": float(np.exp(np.std(values, ddof=1)))} for name, values in sorted(many.items())]
    spreads = [{"of": "shoes of a class", "spread": float(np.exp(within**0.5))},
               {"of": "means of the classes", "spread": float(np.exp(np.std(means, ddof=1)))},
               {"of": "means of as many shoes drawn from one class", "spread": float(np.exp(chance**0.5))}]
    factor = Column("spread", "standard deviation, as a factor", "1", form=".2f")
    return [Table("Largest force of a touch by class of the shoe, geometric mean over shoes",
                  [Column("class", "class"), Column("shoes", "shoes", "1", form="d"),
                   Column("force", "force", "N", form=".1f"), factor], rows, "classes"),
            Table("How far classes differ", [Column("of", "of"), factor], spreads, "spreads")]
