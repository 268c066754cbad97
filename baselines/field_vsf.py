"""`neural-vsf` and `grid-vsf`: the continuous VSF, fitted to one object's touches (Neural VSF section III-D).

Where the sensor has a surface, the observations are the contact forces on its vertices (eq. 5 and 6). A rigid probe
measures its total force only. Its own surface is then used, and the observation is the sum over it along the press, as
in the papers' pressure-only baseline. `neural-vsf` is the papers' network, `grid-vsf` our fast field.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from vsfsim.baselines.converted import converted
from vsfsim.baselines.known_object import PoseSearch, locate, touched_points
from vsfsim.baselines.sensor_surface import dense_touch
from vsfsim.baselines.visible_cloud import visible_cloud
from vsfsim.bench.method import Action, Estimate, Reading, Specimen, check_support
from vsfsim.bench.observations import OBSERVATIONS
from vsfsim.core.dome import Dome
from vsfsim.core.errors import MethodError, NoStiffnessError, VsfError
from vsfsim.core.shape import Sphere
from vsfsim.data.records import View

_RINGS = 4  # of the mesh of a ball's front: 61 vertices
_ZERO = 1e-9  # readings below this, in the task's unit, count as zero


@converted
class NeuralVsf:
    """The papers' 8-layer network.

    Args:
        iterations, batch, samples, rate, free_space: of the training, see `vsfsim.vsf.fields.neural.Fitting`. The
            paper's iterations, batch 1,000, samples 100 and rate 2e-4 take minutes an object on a CPU.
        octaves: of the encoding, whose finest wave is 2^(1 - octaves) of the box's edge. The papers do not give the
            number; 6 is ours. Where a frame has only one force, 2 find buried ropes far better.
        margin: by which the box of the field is wider than the visible cloud [m].
        table_height: z of the table [m].
        depth: greatest depth of the points at which `locate` evaluates the field [m].
        seed: of weights and batches.
        skin: fit the forces on a sensor's vertices where there are readings of them; False: the total only, the
            pressure-only baseline.
        device: torch device.
        pose: how `locate` finds a known object: "outline", or "registration", the papers' procedure in six degrees of
            freedom (section III-E).
    """

    _kind = "nerf"

    def __init__(self, *, iterations: int = 1000, batch: int = 1000, samples: int = 100, rate: float = 2e-4,
                 free_space: float = 1e-2, octaves: int = 6, margin: float = 0.01, table_height: float = 0.0,
                 depth: float = 0.012, seed: int = 0, skin: bool = True, device: str = "cpu",
                 pose: str = "outline"):
        from vsfsim.vsf.fields.neural import Fitting

        if min(iterations, batch, samples, octaves) < 1 or not rate > 0.0:
            raise MethodError(f"{self._kind}: iterations {iterations}, batch {batch}, samples {samples} and octaves "
                              f"{octaves} must be at least 1 and rate {rate} greater than 0.")
        self._fitting = Fitting(iterations=iterations, batch=batch, samples=samples, rate=rate, free_space=free_space,
                                seed=seed)
        self.margin, self.table_height, self.depth = margin, table_height, depth
        self.seed, self.skin, self.device = seed, skin, device
        self._search = PoseSearch(seed=seed, pose=pose)
        self._field: dict[str, float] = {"octaves": octaves}
        self._model = None

    def meta_fit(self, specimens: Sequence[Specimen]) -> None:
        """Nothing to learn."""

    def adapt(self, view: View, support: Sequence[Reading]) -> None:
        """Fit the field. It is zero everywhere without touches, and where all readings are zero.

        Raises:
            MethodError: a reading marked valid is not finite, the view is empty, or there is no surface and the probe
                is not a ball.
        """
        from vsfsim.vsf.fields.neural import fit

        cloud = visible_cloud(view)
        bounds = np.stack([cloud.min(axis=0) - self.margin, cloud.max(axis=0) + self.margin])
        bounds[0, 2], bounds[1, 2] = min(self.table_height, cloud[:, 2].min()), cloud[:, 2].max()
        self._view, self._support, self._model = view, list(support), None
        check_support(support)
        if not any((np.abs(r.value[r.valid]) > _ZERO).any() for r in support):
            return
        dense = self.skin and all(r.surface is not None for r in support)
        found = [dense_touch(r) if dense else _total(r) for r in support if r.valid[1:].any()]
        touches = [touch for touch in found if touch is not None]
        if not touches:
            return
        try:
            self._model = fit(self._kind, touches, bounds, self._fitting, device=self.device, **self._field)
        except NoStiffnessError:
            self._model = None  # nothing stiff was met, and the noise happens to pull
        except VsfError as error:
            raise MethodError(str(error)) from error

    def predict(self, touches: Sequence[Action]) -> list[np.ndarray]:
        """Readings (T, 1) of touches not made yet.

        Raises:
            MethodError: the probe is neither a ball nor a bubble's dome, or its readings are not forces along the press
            (or, of a dome, its pressure).
        """
        from vsfsim.vsf.fields.neural import predict_totals

        asked = [_surface_of(action, np.zeros(len(action.time))) for action in touches]
        if self._model is None:
            return [np.zeros((len(action.time), 1)) for action in touches]
        return [predict_totals(self._model, touch, samples=self._fitting.samples)[:, None]
                / OBSERVATIONS[action.observation].force_per_unit
                for action, touch in zip(touches, asked, strict=True)]

    def stiffness(self, points: np.ndarray) -> Estimate:
        """Stiffness density at ``points`` (k, 3) [m]: (k,) [N/m^4]; no standard deviation."""
        from vsfsim.vsf.fields.neural import density

        none = np.zeros(len(points))
        return Estimate(none if self._model is None else density(self._model, points), none)

    def locate(self, vertices: np.ndarray, triangles: np.ndarray) -> np.ndarray:
        """Object-to-world transform (4, 4) of a stiff object of known shape."""
        points = touched_points(self._view, self._support, depth=self.depth)
        return locate(vertices, triangles, points, self.stiffness(points).mean, self._view, self._search)


@converted
class GridVsf(NeuralVsf):
    """Our field: a sum of trilinear grids, fitted in a few hundred steps at a higher rate.

    Args:
        cell: edge of the finest grid's cells [m]; the others as of `NeuralVsf`, which has octaves instead.
        device: "cpu". A GPU adds the gradients of the cells in no fixed order, and the same touches gave other answers.
    """

    _kind = "grid"

    def __init__(self, *, iterations: int = 250, batch: int = 1000, samples: int = 16, rate: float = 0.1,
                 free_space: float = 1e-2, cell: float = 0.004, margin: float = 0.01, table_height: float = 0.0,
                 depth: float = 0.012, seed: int = 0, skin: bool = True, device: str = "cpu",
                 pose: str = "outline"):
        if not cell > 0.0:
            raise MethodError(f"grid-vsf: cell is {cell!r}; it must be greater than 0, in metres.")
        if device != "cpu":
            raise MethodError(f"grid-vsf: device is {device!r}, but it runs on the CPU only: a GPU adds the gradients "
                              f"of the cells in no fixed order, so that the same touches give other answers. Leave out "
                              f"device=; a fit takes about ten seconds.")
        super().__init__(iterations=iterations, batch=batch, samples=samples, rate=rate, free_space=free_space,
                         margin=margin, table_height=table_height, depth=depth, seed=seed, skin=skin, device=device,
                         pose=pose)
        self._field = {"cell": cell}


def _total(reading: Reading):
    if reading.value.shape[1:] != (1,):
        raise MethodError(f"the readings have {reading.value.shape[1:]} numbers a frame; without a sensor's surface "
                          f"the field is fitted to one force a frame.")
    return _surface_of(reading.action, np.where(reading.valid, reading.value[:, 0], np.nan))


def _surface_of(action: Action, force: np.ndarray):
    """The front half of a ball, or the free dome of a bubble, along its path; ``force``: the readings (T,) in their
    unit."""
    from vsfsim.vsf.fields.line_integrals import SurfaceTouch, dome

    if not isinstance(action.probe, (Sphere, Dome)):
        raise MethodError(f"the probe is a {type(action.probe).__name__.lower()}; the continuous VSF knows the surface "
                          f"of a ball and of a bubble's dome, or needs a sensor with contact forces on its vertices.")
    if action.observation not in OBSERVATIONS or not OBSERVATIONS[action.observation].along_press:
        known = " or ".join(f"'{name}'" for name, row in OBSERVATIONS.items() if row.along_press)
        raise MethodError(f"the readings are '{action.observation}'; without a sensor's surface the continuous VSF "
                          f"needs {known}.")
    force = force * OBSERVATIONS[action.observation].force_per_unit
    if isinstance(action.probe, Dome):
        places = np.einsum("tij,nj->tni", action.poses[:, :3, :3], action.probe.points) + action.poses[:, None, :3, 3]
        return SurfaceTouch(places, np.array(action.probe.faces), force, np.asarray(action.axis))
    shape, triangles = dome(radius=action.probe.radius, height=action.probe.radius, rings=_RINGS)
    shape = shape - [0.0, 0.0, action.probe.radius]
    side = np.cross(action.axis, np.eye(3)[int(np.argmin(np.abs(action.axis)))])
    side /= np.linalg.norm(side)
    # The apex of the shape, at -z, points along the press.
    turn = np.stack([side, np.cross(-action.axis, side), -action.axis], axis=1)
    return SurfaceTouch(shape @ turn.T + action.poses[:, None, :3, 3], triangles, force, np.asarray(action.axis))
