"""The scene file: what is pressed, by what, along which path, and seen from where.

TOML becomes a frozen dataclass. Any value may be a distribution, ``{ uniform = [a, b] }``,
``{ loguniform = [a, b] }`` or ``{ choice = [..] }``; `SceneFile.sample` fixes them all with one seed.
"""

from __future__ import annotations

import math
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from vsfsim.core.arm_spec import ArmSpec, parse_arm
from vsfsim.core.bubble import Bubble, parse_sensor, sensor_kind
from vsfsim.core.distribution import ends, sample
from vsfsim.core.errors import SceneError, did_you_mean
from vsfsim.core.material import MaterialField, parse_material
from vsfsim.core.rigid import (
    MAX_BODIES,
    MAX_FRICTION,
    PressSpec,
    RigidBody,
    beside,
    parse_obstacles,
    parse_press,
    parse_probe,
)
from vsfsim.core.shape import Family, MeshFile, ObjectShape, ProbeShape, parse_object_shape
from vsfsim.core.table import Table

TIERS = ("auto", "vsf", "spring", "linear", "fem-coarse", "fem", "fem-fine", "rod")
NEEDS = ("normal-force", "bulging", "large-deformation", "appearance", "contact", "coupling")


@dataclass(frozen=True)
class ObjectSpec:
    """``[object]``.

    shape: what it is. pose: base centre in the world (3,) [m]; yaw: turn about +z [rad].
    fixed: "bottom", "none", or a box (x0, y0, z0, x1, y1, z1) [m] in the object's frame whose nodes are held.
    tier: fidelity, one of `TIERS`. resolution: element size [m] or None for the tier's own.
    poisson_ratio: [-]. density: [kg/m^3]. friction: Coulomb coefficient against rigid bodies [-].
    young_modulus: the field E(x) [Pa]. appearance: table for the family or the renderer.
    """

    shape: ObjectShape
    pose: tuple[float, float, float]
    yaw: float
    fixed: str | tuple[float, ...]
    tier: str
    resolution: float | None
    poisson_ratio: float
    density: float
    friction: float
    young_modulus: MaterialField
    appearance: Mapping[str, Any]


@dataclass(frozen=True)
class TouchSpec:
    """``[touches]``: how a dataset's touches are drawn on the visible cloud.

    count: touches a view. depth: how far the probe goes past first contact [m].
    approach: clearance between the probe and the target point at the start [m].
    force_limit: the press stops short where the rest state's linear response passes this force [N]; a bubble, where a
    flat rigid wall would.
    frames: (free, in, hold, out) readings in each phase. tilt: a bubble comes in along a direction drawn from the cone
    of this half angle about the normal that is seen [rad], so that its flanks touch, too; 0 for the normal itself.
    """

    count: int
    depth: float
    approach: float
    force_limit: float
    frames: tuple[int, int, int, int]
    tilt: float = 0.0


@dataclass(frozen=True)
class CameraSpec:
    """``[camera]``: a pinhole camera that looks at the object.

    width, height: [px]. fov: vertical field of view [rad]. distance: to the look-at point [m].
    azimuth, elevation: direction from the object to the camera [rad].
    noise: of its depth, "none" or "kinect" (`vsfsim.sensing.kinect`).
    """

    width: int
    height: int
    fov: float
    distance: float
    azimuth: float
    elevation: float
    noise: str = "none"


@dataclass(frozen=True)
class DatasetSpec:
    """``[dataset]``: objects: how many. views: of each. splits: number of objects by split name, in order."""

    objects: int
    views: int
    splits: Mapping[str, int]


@dataclass(frozen=True)
class Scene:
    """One concrete scene: every distribution fixed.

    name: from the file. needs: what the signal depends on. gravity: (3,) [m/s^2].
    probe: moves along the path; parts move with it; obstacles stand in the world. source: the file it came from.
    given: tables and keys at the top of the file. sensor: an air-filled bubble that moves along the path in the probe's
    place. arm: what touches instead of the probe. The other fields: see their classes; None where the file has no such
    table. Without an object there are a sensor and obstacles.
    """

    name: str
    needs: tuple[str, ...]
    gravity: tuple[float, float, float]
    object: ObjectSpec | None
    probe: ProbeShape
    parts: tuple[RigidBody, ...]
    obstacles: tuple[RigidBody, ...]
    press: PressSpec | None
    touches: TouchSpec | None
    camera: CameraSpec
    dataset: DatasetSpec | None
    source: Path
    given: frozenset[str] = frozenset()
    sensor: Bubble | None = None
    arm: ArmSpec | None = None
    effector: str = "probe"
    """Name of what touches: "arm" with an [arm], the kind of the [sensor], or else "probe"; one of
    `vsfsim.core.shelf.effectors`."""
    effector_table: Mapping[str, Any] = field(default_factory=dict)
    """The table of the effector as it is written, e.g. [sensor] or [arm]; an effector that has no parser of its own in
    `vsfsim.core` reads its settings from it."""

    @property
    def required_sensor(self) -> Bubble:
        """The bubble of ``[sensor]``.

        Raises:
            SceneError: there is none.
        """
        return self._required(self.sensor, "sensor")

    @property
    def required_arm(self) -> ArmSpec:
        """The arm of ``[arm]``.

        Raises:
            SceneError: there is none.
        """
        return self._required(self.arm, "arm")

    @property
    def required_touches(self) -> TouchSpec:
        """The touches of ``[touches]``.

        Raises:
            SceneError: there are none.
        """
        return self._required(self.touches, "touches")

    def _required(self, found: Any, table: str) -> Any:
        if found is None:
            raise SceneError(f"{self.source}: there is no [{table}]; what was asked for needs one.")
        return found

    @property
    def bodies(self) -> tuple[ProbeShape, ...]:
        """Shapes of all K rigid bodies: the probe, its parts, the obstacles; with a sensor, the obstacles."""
        if self.sensor is not None:
            return tuple(b.shape for b in self.obstacles)
        return (self.probe, *(b.shape for b in (*self.parts, *self.obstacles)))

    @property
    def frictions(self) -> tuple[float, ...]:
        """Coulomb coefficient of each of the K rigid bodies against what they touch, the object or the sensor [-]."""
        if self.sensor is not None:
            return tuple(self.sensor.friction if b.friction is None else b.friction for b in self.obstacles)
        assert self.object is not None
        own = self.object.friction
        return (own, *(own if b.friction is None else b.friction for b in (*self.parts, *self.obstacles)))


@dataclass(frozen=True)
class SceneFile:
    """A scene as written, distributions and all.

    path: where it lies. text: its bytes as text (stored in datasets). tree: the parsed TOML.
    """

    path: Path
    text: str
    tree: Mapping[str, Any]

    @property
    def name(self) -> str:
        """The scene's name."""
        return str(self.tree.get("name", self.path.stem))

    def sample(self, seed: int | np.random.SeedSequence = 0) -> Scene:
        """Fix every distribution.

        Args:
            seed: an integer >= 0 (0 is valid) or a `SeedSequence`; the same seed gives the same scene.

        Raises:
            SceneError: a value out of its range.
        """
        rng = np.random.default_rng(seed)
        return _build(sample(self.tree, rng), self.path)


def load_scene(path: str | Path) -> SceneFile:
    """Read a scene file and refuse at once what could not be built from it.

    Args:
        path: the TOML file.

    Raises:
        SceneError: not readable, not TOML, an unknown key, or a value (or an end of a distribution) out of range.
    """
    path = Path(path)
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise SceneError(f"scene file '{path}' cannot be read: {error}. Give the path of a TOML text file.") from error
    return parse_scene(text, path)


def parse_scene(text: str, path: str | Path) -> SceneFile:
    """Like `load_scene`, from text; ``path`` names it in messages and anchors relative mesh paths."""
    path = Path(path)
    try:
        tree = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise SceneError(f"scene file '{path}' is not valid TOML: {error}.") from error
    scene = SceneFile(path, text, tree)
    # The ends of every distribution (and each choice) must build; a mid-run surprise is worse than a refusal now.
    for end in ends(tree, str(path)):
        _build(end, path)
    return scene


# ---------------------------------------------------------------------------------------------- tables


def _build(tree: Mapping[str, Any], path: Path) -> Scene:
    top = Table(tree, str(path), ("name", "description", "needs", "gravity", "object", "probe", "sensor",
                                  "obstacles", "press", "touches", "camera", "dataset", "arm"))
    if "sensor" in tree and "arm" in tree:
        raise SceneError(f"{path}: there is a [sensor] and an [arm]; a dataset is made by a bubble whose mount is led "
                         f"along straight lines, or by an arm without one. Take one of them out.")
    effector = "arm" if "arm" in tree else sensor_kind(tree["sensor"], path) if "sensor" in tree else "probe"
    sensor = parse_sensor(tree["sensor"], path) if effector == "bubble" else None
    if sensor is not None and "probe" in tree:
        raise SceneError(f"{path}: there is a [sensor] and a [probe]; one of them moves along the path. What a bubble "
                         f"is to touch goes into [object] or [[obstacles]].")
    if "object" not in tree and (sensor is None or not tree.get("obstacles")):
        raise SceneError(f"{path}: there is no [object]; a scene needs one, e.g. shape = {{ box = [0.1, 0.1, 0.05] }}"
                         + (", or [[obstacles]] for the [sensor] to press on." if sensor is not None
                            else ", or a [sensor] and [[obstacles]] for it to press on."))
    if sensor is None and isinstance(tree.get("touches"), Mapping) and tree["touches"].get("tilt"):
        raise SceneError(f"{path} [touches]: tilt is {tree['touches']['tilt']!r}, but there is no [sensor]; a rigid "
                         f"probe comes in along the normal. Take tilt out.")
    if sensor is not None and "touches" in tree and "object" not in tree:
        raise SceneError(f"{path} [touches]: the touches of a dataset are made on an [object]; this scene has none. "
                         f"Add it, or use [press] on the [[obstacles]].")
    needs = tree.get("needs", ["normal-force"])
    if not isinstance(needs, list):
        raise SceneError(f"{path}: needs is {needs!r}; it must be a list of words from {', '.join(NEEDS)}.")
    for need in needs:
        if need not in NEEDS:
            raise SceneError(f"{path}: needs names '{need}'. {did_you_mean(str(need), NEEDS)}")
    probe, parts = parse_probe(tree.get("probe"), path)
    obstacles = parse_obstacles(tree.get("obstacles", []), path)
    if 1 + len(parts) + len(obstacles) > MAX_BODIES:
        raise SceneError(f"{path}: probe, parts and obstacles are {1 + len(parts) + len(obstacles)} rigid bodies; "
                         f"{MAX_BODIES} are allowed. Join some into one mesh.")
    if "touches" in tree and (parts or obstacles or isinstance(probe, MeshFile)):
        what = "a mesh as its probe" if isinstance(probe, MeshFile) else "[[probe.parts]]" if parts else "[[obstacles]]"
        raise SceneError(f"{path} [touches]: the touches of a dataset are made with one simple probe, which a method "
                         f"can read from it; this scene has {what}. Use it with [press], or take it out.")
    return Scene(
        name=str(tree.get("name", path.stem)),
        needs=tuple(needs),
        gravity=top.vector("gravity", (0.0, 0.0, 0.0)),
        object=_object(tree["object"], path) if "object" in tree else None,
        probe=probe,
        parts=parts,
        obstacles=obstacles,
        press=parse_press(tree["press"], path) if "press" in tree else None,
        touches=_touches(tree["touches"], path) if "touches" in tree else None,
        camera=_camera(tree.get("camera", {}), path),
        dataset=_dataset(tree["dataset"], path) if "dataset" in tree else None,
        source=path,
        given=frozenset(tree),
        sensor=sensor,
        arm=parse_arm(tree["arm"], path) if "arm" in tree else None,
        effector=effector,
        effector_table=tree.get("arm", tree.get("sensor", tree.get("probe", {}))),
    )


def _object(node: Any, path: Path) -> ObjectSpec:
    where = f"{path} [object]"
    t = Table(node, where, ("shape", "pose", "yaw", "fixed", "tier", "resolution", "poisson_ratio", "density",
                             "friction", "young_modulus", "appearance"))
    shape = parse_object_shape(t.table.get("shape"), where)
    fixed = t.table.get("fixed", "bottom")
    if isinstance(fixed, str):
        fixed = t.word("fixed", "bottom", ("bottom", "none"))
    else:
        fixed = t.vector("fixed", None, 6)
    material = parse_material(t.table.get("young_modulus"), where)
    if material.base is None and not isinstance(shape, Family):
        raise SceneError(f"{where}: young_modulus is missing; give pascals, e.g. young_modulus = 1e5, or "
                         f"{{ base = 1e5, inclusions = [..] }}.")
    appearance = t.table.get("appearance", {})
    if not isinstance(appearance, Mapping):
        raise SceneError(f"{where}: appearance is {appearance!r}; it must be a table.")
    friction = t.number("friction", 0.0, 0.0, MAX_FRICTION)
    shape = beside(shape, path)  # type: ignore[arg-type,assignment]
    resolution = t.number("resolution", 0.0, 1e-5, 1.0, "m") if "resolution" in t.table else None
    return ObjectSpec(
        shape=shape,
        pose=t.vector("pose", (0.0, 0.0, 0.0)),
        yaw=t.number("yaw", 0.0, -2 * math.pi, 2 * math.pi, "rad"),
        fixed=fixed,
        tier=t.word("tier", "auto", TIERS),
        resolution=resolution,
        poisson_ratio=t.number("poisson_ratio", 0.45, 0.0, 0.4999),
        density=t.number("density", 1000.0, 1e-3, 3e4, "kg/m^3"),
        friction=friction,
        young_modulus=material,
        appearance=appearance,
    )


def _touches(node: Any, path: Path) -> TouchSpec:
    t = Table(node, f"{path} [touches]", ("count", "depth", "approach", "force_limit", "frames", "tilt"))
    where = f"{path} [touches] frames"
    f = Table(t.table.get("frames", {}), where, ("free", "in", "hold", "out"))
    frames = (f.count("free", 2, 1, 1000), f.count("in", 6, 1, 1000), f.count("hold", 1, 0, 1000),
              f.count("out", 3, 0, 1000))
    return TouchSpec(t.count("count", 10, 1, 10_000), t.number("depth", 0.01, 1e-5, 0.5, "m"),
                     t.number("approach", 0.01, 1e-4, 0.5, "m"),
                     t.number("force_limit", 30.0, 1e-3, 1e6, "N"), frames, t.number("tilt", 0.0, 0.0, 1.2, "rad"))


def _camera(node: Any, path: Path) -> CameraSpec:
    t = Table(node, f"{path} [camera]", ("width", "height", "fov", "distance", "azimuth", "elevation", "noise"))
    return CameraSpec(t.count("width", 640, 8, 8192), t.count("height", 480, 8, 8192),
                      t.number("fov", 0.8, 0.05, 2.8, "rad"), t.number("distance", 0.6, 0.01, 100.0, "m"),
                      t.number("azimuth", 0.9, -2 * math.pi, 2 * math.pi, "rad"),
                      t.number("elevation", 0.7, -1.55, 1.55, "rad"),
                      t.word("noise", "none", ("none", "kinect")))


def _dataset(node: Any, path: Path) -> DatasetSpec:
    where = f"{path} [dataset]"
    t = Table(node, where, ("objects", "views", "splits"))
    objects = t.count("objects", 6, 1, 100_000)
    splits = t.table.get("splits", {"test": objects})
    if not isinstance(splits, Mapping) or any(isinstance(n, bool) or not isinstance(n, int) or n < 0
                                              for n in splits.values()):
        raise SceneError(f"{where}: splits is {splits!r}; give the number of objects of each, e.g. "
                         f"{{ train = 4, test = 2 }}.")
    if sum(splits.values()) != objects:
        raise SceneError(f"{where}: splits add up to {sum(splits.values())}, but there are {objects} objects; make "
                         f"them equal.")
    return DatasetSpec(objects, t.count("views", 1, 1, 1000), dict(splits))
