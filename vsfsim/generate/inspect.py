"""What `vsfsim inspect` shows: a dataset's summary and contact sheet, or a turntable of a scene's object."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from vsfsim.core.scene import Scene


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
    from vsfsim.core.solid import tet_volumes
    from vsfsim.generate.run import _BODY, _SCENE, stream, surface_of
    from vsfsim.physics import tiers
    from vsfsim.sensing.turntable import turntable

    loaded = load_scene(find_scene(name))
    # as object 0 of a dataset of this seed
    scene = loaded.sample(stream(seed, _SCENE, 0))
    path = out or Path(f"{loaded.name}.png")
    if scene.arm is not None:
        return _plant(scene, path, stream(seed, _BODY, 0), f"{loaded.name}, seed {seed}", device)
    tier = tiers.choose(scene)
    solid, values = tiers.body(scene, tier, seed=stream(seed, _BODY, 0))
    mean = values.mean(axis=1)
    surface = surface_of(solid, scene)
    owner = solid.surface()[1]
    turntable(surface, path, young_modulus=mean[owner], title=f"{loaded.name}, seed {seed}", device=device)
    lines = [f"{loaded.name}: {len(solid.tets)} tetrahedra, {1e6 * solid.volume():.1f} cm^3, E {mean.min():.3g} to {mean.max():.3g} Pa, tier {tier}"]
    volume = tet_volumes(solid.vertices, solid.tets)
    for index, region in enumerate(solid.region_names):
        inside = np.asarray(solid.region) == index
        if inside.any():
            lines.append(f"  {region:<14} E {np.average(mean[inside], weights=volume[inside]):9.3g} Pa  {1e6 * volume[inside].sum():8.1f} cm^3")
    lines.extend(f"note: {sentence}" for sentence in solid.notes)
    return [*lines, f"turntable: {path}"]


def _plant(scene: Scene, path: Path, seed: np.random.SeedSequence, title: str, device: str) -> list[str]:
    from vsfsim.generate.plant_surface import plant_surface, triangles_of
    from vsfsim.generate.plants import grow
    from vsfsim.sensing.turntable import turntable

    plant = grow(scene, seed)
    turntable(plant_surface(plant, pot=False), path, young_modulus=np.repeat(plant.young_modulus[1:], triangles_of(plant)[1:]), title=title, device=device)
    lines = [f"{scene.name}: {len(plant.nodes) - 1} segments, {plant.lengths().sum():.2f} m in all, {plant.nodes[:, 2].max():.2f} m high, tier rod"]
    for index, region in enumerate(plant.region_names):
        mine = np.flatnonzero(plant.region[1:] == index) + 1
        if len(mine):
            e, r = plant.young_modulus[mine], plant.radius[mine]
            lines.append(f"  {region:<14} {len(mine):4d} segments, E {e.min():9.3g} to {e.max():9.3g} Pa, {'half thickness' if plant.half_width[mine].any() else 'radius'} {1e3 * r.min():.2g} to {1e3 * r.max():.2g} mm")
    lines.extend(f"note: {sentence}" for sentence in plant.notes)
    return [*lines, f"turntable: {path}"]
