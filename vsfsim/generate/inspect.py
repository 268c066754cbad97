"""What `vsfsim show` draws: a dataset's summary and contact sheet, or a scene's object from outside and cut open."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vsfsim.core.errors import DatasetError, no_such_file
from vsfsim.data.streams import Stream, stream

if TYPE_CHECKING:
    from vsfsim.data.dataset import Dataset
    from vsfsim.data.records import ObjectView
    from vsfsim.generate.effector import Drawing


Progress = Callable[[int, int, str], None]
"""(what is done, of how many, and what is next)."""
_MOST = 24  # object views of a contact sheet


def inspect(what: str, out: Path | None, *, seed: int, device: str,
            progress: Progress = lambda done, total, what: None) -> tuple[list[str], dict[str, Any]]:
    """Draw the picture of a dataset folder or of a scene.

    Returns:
        The lines to print, and the same for JSON.

    Raises:
        DatasetError, SceneError: neither a dataset nor a scene, or one that is damaged.
    """
    return (_dataset(Path(what), out, progress) if is_dataset(what)
            else _scene(what, out, seed=seed, device=device, progress=progress))


def is_dataset(what: str) -> bool:
    """Whether a word names the folder of a dataset; if not, it is to name a scene.

    Raises:
        DatasetError: it can be neither.
    """
    path = Path(what)
    if len(path.parts) > 1 and path.suffix != ".toml" and not path.is_dir():
        raise DatasetError(no_such_file("folder of a dataset", what))
    return path.is_dir()


def draw_scene(name: str, seed: int) -> tuple[str, Drawing]:
    """The name of a scene, and its object as object 0 of a dataset of this seed.

    Raises:
        SceneError, MeshError: there is no such scene, or its object cannot be built.
    """
    from vsfsim.core.scene import load_scene
    from vsfsim.core.shelf import find_scene
    loaded = load_scene(find_scene(name))
    from vsfsim.generate.effector import effector_of

    scene = loaded.sample(stream(seed, Stream.SCENE, 0))
    return loaded.name, effector_of(scene).draw(scene, stream(seed, Stream.BODY, 0))


def draw_view(data: Dataset, shown: ObjectView) -> Drawing:
    """The object of a view, built again from its dataset's recipe; without its elements where its truth is withheld.

    Raises:
        VsfsimError: it cannot be made again: it was recorded, or its scene needs what is not here.
    """
    from vsfsim.generate.effector import effector_of
    from vsfsim.generate.resim import job_of

    job = job_of(data.recipe, shown.name)
    scene, tier = job.scene(), data.recipe.tier
    body = dataclasses.replace(scene.required_object, tier=tier)  # type: ignore[arg-type]
    drawing = effector_of(scene).draw(dataclasses.replace(scene, object=body), job.stream(Stream.BODY))
    return drawing if shown.truth is not None else dataclasses.replace(drawing, body=None, young_modulus=None)


def _dataset(folder: Path, out: Path | None, progress: Progress) -> tuple[list[str], dict[str, Any]]:
    from vsfsim.data.dataset import Dataset
    from vsfsim.data.verify import summary_rows

    data = Dataset.open(folder, progress=progress)
    path = out or Path(f"{folder.resolve().name}.png")
    data.plot(path, most=_MOST)
    more = f" (the first {_MOST} of {len(data)} object views)" if len(data) > _MOST else ""
    rows = summary_rows(folder, progress)
    return ([*(f"{key:<16}{value}" for key, value in rows), f"contact sheet{more}: {path}"],
            {**{key.strip(): value for key, value in rows}, "picture": str(path)})


def _scene(name: str, out: Path | None, *, seed: int, device: str,
           progress: Progress) -> tuple[list[str], dict[str, Any]]:
    from vsfsim.sensing.portrait import portrait

    progress(0, 2, "the object is built")
    name, drawing = draw_scene(name, seed)
    progress(1, 2, "its pictures are drawn")
    path = out or Path(f"{name}.png")
    portrait(drawing.surface, drawing.body, path, young_modulus=drawing.young_modulus,
             title=f"{name}, {drawing.subtitle or f'seed {seed}'}", device=device)
    first, *others = drawing.lines
    return ([f"{name}: {first}", *others, f"picture: {path}"],
            {"scene": name, "seed": seed, "lines": list(drawing.lines), "picture": str(path)})
