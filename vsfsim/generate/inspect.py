"""What `vsfsim inspect` shows: a dataset's summary and contact sheet, or a turntable of a scene's object."""

from __future__ import annotations

from pathlib import Path


def inspect(what: str, out: Path | None, *, seed: int, device: str) -> list[str]:
    """Draw the picture of a dataset folder or of a scene; returns lines to print.

    Raises:
        DatasetError, SceneError: neither a dataset nor a scene, or one that is damaged.
    """
    if Path(what).is_dir():
        return _dataset(Path(what), out)
    return _scene(what, out, seed=seed, device=device)


def _dataset(folder: Path, out: Path | None) -> list[str]:
    from vsfsim.data.dataset import Dataset
    from vsfsim.data.summary import summary
    from vsfsim.sensing.contact_sheet import contact_sheet

    data = Dataset.open(folder)
    path = out or Path(f"{folder.resolve().name}.png")
    views = [data.load(name) for name in data.names()[:24]]
    contact_sheet(views, path, title=f"{data.recipe.scene}, tier {data.recipe.tier}, seed {data.recipe.seed}")
    more = f" (the first {len(views)} of {len(data)} object views)" if len(views) < len(data) else ""
    return [summary(folder), f"contact sheet{more}: {path}"]


def _scene(name: str, out: Path | None, *, seed: int, device: str) -> list[str]:
    from vsfsim.core.scene import load_scene
    from vsfsim.core.shelf import find_scene
    from vsfsim.data.streams import Stream, stream
    from vsfsim.generate.effector import effector_of
    from vsfsim.sensing.turntable import turntable

    loaded = load_scene(find_scene(name))
    # as object 0 of a dataset of this seed
    scene = loaded.sample(stream(seed, Stream.SCENE, 0))
    drawing = effector_of(scene).draw(scene, stream(seed, Stream.BODY, 0))
    path = out or Path(f"{loaded.name}.png")
    turntable(drawing.surface, path, young_modulus=drawing.young_modulus,
              title=f"{loaded.name}, {drawing.subtitle or f'seed {seed}'}", device=device)
    first, *others = drawing.lines
    return [f"{loaded.name}: {first}", *others, f"turntable: {path}"]
