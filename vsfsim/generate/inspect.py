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
    if scene.object is None:
        return _sensor(scene, loaded.name, out or Path(f"{loaded.name}.png"), device=device)
    if scene.arm is not None:
        return _plant(scene, out or Path(f"{loaded.name}.png"), stream(seed, _BODY, 0), f"{loaded.name}, seed {seed}",
                      device)
    tier = tiers.choose(scene)
    solid, values = tiers.body(scene, tier, seed=stream(seed, _BODY, 0))
    mean = values.mean(axis=1)
    surface = surface_of(solid, scene)
    owner = solid.surface()[1]
    path = out or Path(f"{loaded.name}.png")
    turntable(surface, path, young_modulus=mean[owner], title=f"{loaded.name}, seed {seed}", device=device)
    lines = [f"{loaded.name}: {len(solid.tets)} tetrahedra, {1e6 * solid.volume():.1f} cm^3, E {mean.min():.3g} to "
             f"{mean.max():.3g} Pa, tier {tier}"]
    volume = tet_volumes(solid.vertices, solid.tets)
    for index, region in enumerate(solid.region_names):
        inside = np.asarray(solid.region) == index
        if inside.any():
            lines.append(f"  {region:<14} E {np.average(mean[inside], weights=volume[inside]):9.3g} Pa  "
                         f"{1e6 * volume[inside].sum():8.1f} cm^3")
    lines.extend(f"note: {sentence}" for sentence in solid.notes)
    return [*lines, f"turntable: {path}"]


def _sensor(scene: Scene, name: str, path: Path, *, device: str) -> list[str]:
    """The free dome of a scene's sensor: a turntable, and its figures."""
    from vsfsim.physics.bubble import sensor as bubble
    from vsfsim.physics.bubble.shape import punyo_rms, stretches
    from vsfsim.physics.elements import gas
    from vsfsim.sensing.surface import Surface
    from vsfsim.sensing.turntable import turntable

    spec = scene.sensor
    assert spec is not None
    model = bubble.build_bubble(spec, where=f"{scene.source} [sensor]")
    mesh = model.mesh
    surface = Surface(mesh.points, mesh.faces, np.zeros(len(mesh.faces), np.int64), None, mesh.points)
    turntable(surface, path, title=f"{name}, free dome", device=device)
    apex = int(mesh.points[:, 2].argmax())
    largest, least = stretches(model)[(mesh.faces == apex).any(axis=1)].mean(axis=0)
    rate = gas.at_rest(model.blocks[2])[2]
    lines = [f"{name}: a bubble of {len(mesh.points)} nodes and {len(mesh.faces)} triangles, mean edge "
             f"{1e3 * model.element_size:.2f} mm; "
             f"read-out mesh of {len(model.read_out.flat)} nodes, {len(model.read_out.faces)} triangles, "
             f"{len(model.read_out.rim)} on the rim",
             f"  rim            {2e3 * spec.semi_axes[0]:.1f} x {2e3 * spec.semi_axes[1]:.1f} mm, E h "
             f"{spec.modulus:.0f} N/m, pre-stretch {spec.pre_stretch:g}",
             f"  free dome      apex {1e3 * mesh.points[apex, 2]:.2f} mm, volume {1e6 * mesh.volume[0]:.2f} mL, at "
             f"{model.pressure:.0f} Pa gauge; stretch at the apex {least:.3f} x {largest:.3f}",
             f"  gas            {1e6 * spec.gas_volume:.1f} mL, gamma {spec.gamma:g}, "
             + (f"sealed: dp/dV {-1e-9 * rate:.3f} kPa/mL" if spec.sealed else "open")]
    if spec.semi_axes == type(spec)().semi_axes:
        lines.append(f"  height map     rms {1e3 * punyo_rms(model):.2f} mm from h = 30.89 mm (1 - rho^2)^0.763, a "
                     f"real Punyo's")
    return [*lines, f"turntable: {path}"]


def _plant(scene: Scene, path: Path, seed: np.random.SeedSequence, title: str, device: str) -> list[str]:
    from vsfsim.generate.effectors.arm import grow
    from vsfsim.generate.plants.surface import plant_surface, triangles_of
    from vsfsim.sensing.turntable import turntable

    plant = grow(scene, seed)
    turntable(plant_surface(plant, pot=False), path, young_modulus=np.repeat(plant.young_modulus[1:],
                                                                             triangles_of(plant)[1:]), title=title,
              device=device)
    lines = [f"{scene.name}: {len(plant.nodes) - 1} segments, {plant.lengths().sum():.2f} m in all, "
             f"{plant.nodes[:, 2].max():.2f} m high, tier rod"]
    for index, region in enumerate(plant.region_names):
        mine = np.flatnonzero(plant.region[1:] == index) + 1
        if len(mine):
            e, r = plant.young_modulus[mine], plant.radius[mine]
            lines.append(f"  {region:<14} {len(mine):4d} segments, E {e.min():9.3g} to {e.max():9.3g} Pa, "
                         f"{'half thickness' if plant.half_width[mine].any() else 'radius'} {1e3 * r.min():.2g} to "
                         f"{1e3 * r.max():.2g} mm")
    lines.extend(f"note: {sentence}" for sentence in plant.notes)
    return [*lines, f"turntable: {path}"]
