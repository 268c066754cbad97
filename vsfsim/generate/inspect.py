"""What `vsfsim inspect` shows: a dataset's summary and contact sheet, or a turntable of a scene's object."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from vsfsim.core.errors import DatasetError, no_such_file


def inspect(what: str, out: Path | None, *, seed: int, device: str) -> tuple[list[str], dict[str, Any]]:
    """Draw the picture of a dataset folder or of a scene.

    Returns:
        The lines to print, and the same for JSON.

    Raises:
        DatasetError, SceneError: neither a dataset nor a scene, or one that is damaged.
    """
    path = Path(what)
    if path.is_dir():
        return _dataset(path, out)
    if len(path.parts) > 1 and path.suffix != ".toml":
        raise DatasetError(no_such_file("folder of a dataset", what))
    return _scene(what, out, seed=seed, device=device)


def _dataset(folder: Path, out: Path | None) -> tuple[list[str], dict[str, Any]]:
    from vsfsim.data.contact_sheet import contact_sheet
    from vsfsim.data.dataset import Dataset
    from vsfsim.data.summary import summary_rows

    data = Dataset.open(folder)
    path = out or Path(f"{folder.resolve().name}.png")
    views = [data.load(name) for name in data.names()[:24]]
    contact_sheet(views, path, title=f"{data.recipe.scene}, tier {data.recipe.tier}, seed {data.recipe.seed}")
    more = f" (the first {len(views)} of {len(data)} object views)" if len(views) < len(data) else ""
    rows = summary_rows(folder)
    return ([*(f"{key:<16}{value}" for key, value in rows), f"contact sheet{more}: {path}"],
            {**{key.strip(): value for key, value in rows}, "picture": str(path)})


def _scene(name: str, out: Path | None, *, seed: int, device: str) -> tuple[list[str], dict[str, Any]]:
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
    return ([f"{loaded.name}: {first}", *others, f"turntable: {path}"],
            {"scene": loaded.name, "seed": seed, "lines": list(drawing.lines), "picture": str(path)})
