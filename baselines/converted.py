"""Settings that follow the size of a contact and the scale of the readings.

A preset states what its lengths and forces were chosen for, ``made_for = [length, reading]``: medians over the training
touches of the radius of the contact [m] and of the largest reading [unit of the readings]. The radius is that of Hertz
(Johnson, Contact Mechanics, 1985, section 4.2), the root of the probe's half width times the depth past the visible
surface: the places that a touch tells of lie that far apart, whatever the probe. A method that is `converted` sees
everything in those units: views, paths, probes and points are multiplied by a factor of length, readings by one of
reading, and its answers are divided again. So the same settings serve a ball of 3 mm on 1 N and one of 30 mm on 10 N.
The factors are powers of two: nothing is rounded, and data within a factor of 1.4 of those that the settings were made
for stay as they are. They come from the training objects alone; without training objects, and without ``made_for``,
nothing is converted.
"""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, TypeVar

import numpy as np

from vsfsim.bench.method import Action, Estimate, Reading, Specimen, Surface
from vsfsim.core.dome import Dome
from vsfsim.core.errors import MethodError
from vsfsim.core.shape import Box, Capsule, Cylinder, Plane, ProbeShape, Sphere
from vsfsim.data.records import View
from vsfsim.vsf.surface_contact import surface_contact

T = TypeVar("T")


@dataclass(frozen=True)
class Units:
    """Factors from the data to what the settings were made for."""

    length: float = 1.0
    """On every length [-]."""
    reading: float = 1.0
    """On every reading [-]."""

    @classmethod
    def of(cls, specimens: Sequence[Specimen], made_for: Sequence[float]) -> Units:
        """From training objects. A probe without a size (an arm, a half-space, a mesh) leaves lengths as they are, and
        so does a length of 0; readings of 0 leave readings as they are."""
        touches = [(specimen.view, touch) for specimen in specimens for touch in specimen.touches if touch.valid.any()]
        found = [[contact_radius(view, touch) for view, touch in touches],
                 [float(np.abs(touch.value[touch.valid]).max()) for _, touch in touches]]
        middle = [float(np.median(x)) if x and np.isfinite(x).all() else 0.0 for x in found]
        factors = [2.0 ** round(np.log2(wanted / here)) if wanted > 0.0 and here > 0.0 else 1.0
                   for wanted, here in zip(made_for, middle)]
        return cls(*factors)

    def view(self, view: View) -> View:
        """A view of the same pixels, further away or nearer."""
        return replace(view, depth=view.depth * np.float32(self.length), camera_pose=self.poses(view.camera_pose))

    def poses(self, poses: np.ndarray) -> np.ndarray:
        """Transforms (..., 4, 4) with longer translations."""
        out = np.array(poses, float)
        out[..., :3, 3] *= self.length
        return out

    def action(self, action: Action) -> Action:
        """The same press of a larger probe."""
        mount = None if action.mount_stiffness is None else action.mount_stiffness * self.reading / self.length
        return replace(action, poses=self.poses(action.poses), probe=enlarged(action.probe, self.length),
                       mount_stiffness=mount)

    def touch(self, reading: Reading) -> Reading:
        """A touch with its readings, and the surface of a sensor."""
        surface = reading.surface and Surface(reading.surface.vertices * self.length,
                                              reading.surface.force * self.reading)
        return Reading(self.action(reading.action), reading.value * self.reading, reading.valid, surface)


def contact_radius(view: View, touch: Reading) -> float:
    """Of a touch at its deepest [m]: sqrt(R d), R the half width of the probe and d its depth past the visible surface;
    0 for a probe without a size that can be changed, and where nothing is seen."""
    half = half_width(touch.action.probe)
    if half == 0.0 or not view.mask.any():
        return 0.0
    depth = surface_contact(view.points(), touch.action.poses, touch.action.probe).depth
    return float(np.sqrt(half * depth[touch.valid].max()))


def half_width(probe: ProbeShape) -> float:
    """Of a probe across its press [m]: a radius where it is round; 0 for one without a size that can be changed."""
    if isinstance(probe, Sphere | Capsule | Cylinder):
        return probe.radius
    if isinstance(probe, Box):
        return 0.5 * min(probe.size[:2])
    return probe.reach if isinstance(probe, Dome) else 0.0


@functools.lru_cache(maxsize=64)
def enlarged(probe: ProbeShape, by: float) -> ProbeShape:
    """A probe with all lengths multiplied.

    Raises:
        MethodError: it is an arm or a mesh from a file.
    """
    if by == 1.0 or isinstance(probe, Plane):
        return probe
    if isinstance(probe, Dome):
        return Dome.of(probe.points * by, probe.faces)
    if half_width(probe) == 0.0:
        raise MethodError(f"a probe of the kind {type(probe).__name__.lower()} has one size, so that made_for cannot "
                          f"change its lengths; give made_for a length of 0.")
    sizes = {field.name: getattr(probe, field.name) for field in fields(probe)}  # each a length, or lengths
    longer: dict[str, Any] = {name: tuple(by * x for x in size) if isinstance(size, tuple) else by * size
                              for name, size in sizes.items()}
    return type(probe)(**longer)


def converted(method: type[T]) -> type[T]:
    """A class of a method, or of a part of one, whose constructor takes ``made_for`` besides its own settings, and
    whose functions see the data in the units of that."""
    for name, made in _FUNCTIONS.items():
        if name in vars(method):
            setattr(method, name, _outermost(vars(method)[name], made))
    own: Callable[..., None] = method.__init__
    if "__init__" in vars(method) or any(name in vars(method) for name in ("meta_fit", "adapt")):
        method.__init__ = _with_made_for(own)  # type: ignore[method-assign]
    return method


def _with_made_for(own: Callable[..., None]) -> Callable[..., None]:
    @functools.wraps(own)
    def build(self: Any, *, made_for: Sequence[float] | None = None, **settings: Any) -> None:
        made_for = made_for or ()
        if len(made_for) not in (0, 2) or not all(0.0 <= x < np.inf for x in made_for):
            raise MethodError(f"made_for is {list(made_for)}; give the contact's radius [m] and the readings' scale "
                              f"for which the settings are, both 0 or greater, or nothing.")
        if made_for or not hasattr(self, "_made_for"):  # a derived class has set it already
            self._made_for, self._units = tuple(made_for), Units()
        own(self, **settings)

    known = [] if own is object.__init__ else [p for p in inspect.signature(own).parameters.values()
                                               if p.name not in ("self", "made_for")]
    this = inspect.Parameter("self", inspect.Parameter.POSITIONAL_ONLY)
    given = inspect.Parameter("made_for", inspect.Parameter.KEYWORD_ONLY, default=None)
    build.__signature__ = inspect.Signature([this, *known, given])  # type: ignore[attr-defined]
    return build


def _outermost(own: Callable[..., Any], made: Callable[..., Any]) -> Callable[..., Any]:
    """``own`` with conversion, unless another function of the method calls it, whose data are converted already."""
    @functools.wraps(own)
    def run(self: Any, *operands: Any) -> Any:
        if not getattr(self, "_made_for", ()):
            return own(self, *operands)
        held, self._made_for = self._made_for, ()
        try:
            if own.__name__ == "meta_fit":
                self._units = Units.of(operands[0], held)
            return made(self._units, functools.partial(own, self), *operands)
        except MethodError as error:
            raise MethodError(f"{error} (The settings are for made_for = {list(held)}: lengths were multiplied by "
                              f"{self._units.length:g} and readings by {self._units.reading:g}.)") from error
        finally:
            self._made_for = held

    return run


def _meta_fit(units: Units, own: Callable[..., None], specimens: Sequence[Specimen]) -> None:
    own([Specimen(s.name, units.view(s.view), tuple(map(units.touch, s.touches))) for s in specimens])


def _adapt(units: Units, own: Callable[..., None], view: View, support: Sequence[Reading]) -> None:
    own(units.view(view), [units.touch(reading) for reading in support])


def _predict(units: Units, own: Callable[..., list[np.ndarray]], touches: Sequence[Action]) -> list[np.ndarray]:
    return [answer / units.reading for answer in own([units.action(action) for action in touches])]


def _stiffness(units: Units, own: Callable[..., Estimate], points: np.ndarray) -> Estimate:
    return own(points * units.length)


def _locate(units: Units, own: Callable[..., np.ndarray], vertices: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    return replace(units, length=1.0 / units.length).poses(own(vertices * units.length, triangles))


_FUNCTIONS: dict[str, Callable[..., Any]] = {"meta_fit": _meta_fit, "adapt": _adapt, "predict": _predict,
                                             "predict_std": _predict, "stiffness": _stiffness, "locate": _locate}
