"""The plants of a scene as its camera sees them, with their names: `vsfsim measure plant-sheet`."""

from __future__ import annotations

from pathlib import Path

from measurements.measurement import Column, Measurement, Progress, Table
from vsfsim.core.errors import VsfsimError
from vsfsim.core.scene import load_scene
from vsfsim.core.shelf import find_scene
from vsfsim.data.streams import Stream
from vsfsim.generate.job import jobs_of
from vsfsim.generate.plants.admit import grow
from vsfsim.generate.plants.prepare import see
from vsfsim.generate.recipe import make_recipe

COLUMNS = 6


def measure(scene: str, *, picture: Path | None = None, objects: int | None = None, seed: int = 0,
            progress: Progress = lambda _: None) -> Measurement:
    """Size of every plant of a scene, as first drawn, and its picture of the first view.

    Args:
        scene: name or path of a scene with [arm].
        picture: PNG to write, None for none.
        objects: how many plants, None for the scene's own number.
        seed: of the dataset.
        progress: called with the name of each plant.

    Raises:
        VsfsimError: the scene has no [arm].
    """
    loaded = load_scene(find_scene(scene))
    if loaded.sample(0).arm is None:
        raise VsfsimError(f"measure plant-sheet: {loaded.path} has no [arm]; give a scene of plants, e.g. plants-v4.")
    recipe = make_recipe(loaded, seed=seed, objects=objects)
    jobs = [job for job in jobs_of(recipe, loaded.path, Path("."), None) if job.view_index == 0]
    rows, images = [], []
    for job in jobs:
        at = job.scene()
        plant = grow(at, job.stream(Stream.BODY), number=job.object_index)
        name = plant.name or f"object {job.object_index}"
        progress(name)
        rows.append({"name": name, "segments": len(plant.nodes) - 1, "height": float(plant.nodes[:, 2].max())})
        if picture is not None:
            images.append(see(plant, at.camera, device="cpu", renderer="warp").rgb)
    if picture is not None:
        from matplotlib.figure import Figure

        high = -(-len(images) // COLUMNS)
        figure = Figure(figsize=(3.0 * COLUMNS, 2.85 * high))
        for k, (row, image) in enumerate(zip(rows, images, strict=True)):
            axes = figure.add_subplot(high, COLUMNS, k + 1)
            axes.imshow(image)
            axes.set_title(row["name"])
            axes.axis("off")
        figure.tight_layout()
        figure.savefig(picture, dpi=60)
    return Measurement.of("plant-sheet", {"scene": loaded.name, "seed": seed}, [Table(
        "plants as first drawn", (Column("name", "plant"), Column("segments", "segments", "1", "", "d"),
                                  Column("height", "height with pot", "m", "", ".2f")), rows, name="plants")])
