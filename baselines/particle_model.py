"""The particle model of one object: the papers' particles behind a view, and the observation rows of its touches.

The particles and the rows of a touch do not depend on the stiffness (SBML eq. 5), so they are computed once and kept:
in one trial, a touch costs one simulation. `vsfsim.baselines.posterior` estimates the stiffness.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy import sparse
from scipy.spatial import cKDTree

from vsfsim.baselines.sensor_surface import dense_touch
from vsfsim.baselines.visible_cloud import digest, visible_cloud
from vsfsim.bench.method import Action, Reading, check_support
from vsfsim.bench.observations import OBSERVATIONS
from vsfsim.core.errors import MethodError, VsfError
from vsfsim.data.records import View
from vsfsim.vsf.observe import dense_force_rows
from vsfsim.vsf.particles import particles_from_view
from vsfsim.vsf.sticking import stick


@dataclass(frozen=True)
class VsfSettings:
    """Hyper-parameters of the particle model."""

    spacing: float
    """Distance of the particles [m]; the papers take 5 mm for shoes, 10 mm for plants."""
    friction: float
    """Coulomb coefficient of the stick-slip motion [-]."""
    noise_std: float
    """Of a reading, in its unit (of a pressure, in newtons); the weight of the data against the prior."""
    margin: float
    """By which the box around the visible cloud is widened sideways [m]."""
    table_height: float
    """z of the table, down to which the hidden volume is filled [m]."""
    device: str
    """Warp device, "cpu" or "cuda:0"."""
    skin_std: float | None = None
    """Noise of a component of the force on a vertex of a deformable sensor's surface [N]; None: only the readings are
    used, and the surface is not."""
    noise_share: float = 0.0
    """Fraction of a touch's largest reading that is added to ``noise_std`` in quadrature, for all readings of the
    touch, because the particle model errs in proportion [-]."""
    band: float = 0.0
    """Particles further from every visible point are left out [m]; 0 keeps the whole hidden volume, as SBML appendix
    B.2 does. Behind thin branches that volume is mostly air."""
    max_particles: int = 0
    """The most particles, drawn at random from those in the volume; 0 for all. SBML appendix B.2 takes 10,000 to 30,000
    by the size of the object."""
    reach: float = 0.0
    """Width of the neighbourhoods over which spring constants are averages of common ones [m]; 0: they are independent,
    as in the papers. With it a touch says something of springs that it did not move."""
    growth: float = 1.0
    """Power of the summed displacement of the particles with which a reading of one number grows [-]. 1: each spring
    adds its own force, as in the papers, so that the force of a ball grows with the second to third power of its depth.
    A surface that bends answers about in proportion, because one place carries the next; then a reading is the mean
    spring constant under the probe, weighted by the displacements, times their sum [m] to this power."""

    def __post_init__(self) -> None:
        length = "0 or greater, in metres"
        for name, allowed, words in (
                ("max_particles", self.max_particles >= 0, "a number of particles, or 0 for all"),
                ("growth", 0.0 < self.growth <= 1.0, "greater than 0 and at most 1"),
                ("noise_share", 0.0 <= self.noise_share < np.inf, "0 or greater, a fraction"),
                ("band", 0.0 <= self.band < np.inf, length), ("reach", 0.0 <= self.reach < np.inf, length)):
            if not allowed:
                raise MethodError(f"{name} is {getattr(self, name)!r}; it must be {words}.")


@dataclass
class ParticleModel:
    """The particles of one object, and what is computed for them on demand."""

    particles: np.ndarray
    """Rest positions, world (n, 3) [m]."""
    settings: VsfSettings
    """Of the model."""
    cell: float
    """Volume for which one particle stands [m^3]."""
    rows: dict[bytes, sparse.csr_matrix] = field(default_factory=dict)
    """Observation rows (T d, n) by action."""
    surfaces: dict[bytes, tuple[sparse.csr_matrix, np.ndarray]] = field(default_factory=dict)
    """Rows (r, n) and values (r,) of touches with a sensor surface."""
    features: dict[str, np.ndarray] = field(default_factory=dict)
    """Of the particles, by kind."""
    near: sparse.csr_matrix | None = None
    """`knots`, once asked (n, s)."""

    @classmethod
    def behind(cls, view: View, settings: VsfSettings) -> ParticleModel:
        """Particles in the visible surface and the volume it hides (SBML appendix B.2).

        Raises:
            MethodError: the view shows no object, or none of the particles lies in it.
        """
        cloud = visible_cloud(view)
        bounds = np.stack([cloud.min(axis=0) - settings.margin, cloud.max(axis=0) + settings.margin])
        bounds[0, 2] = min(settings.table_height, cloud[:, 2].min())
        # Points up to half a cell before the surface belong to it. Otherwise the first layer could be a whole cell
        # deep, and a shallow press would reach no particle.
        particles = particles_from_view(view, bounds=bounds, spacing=settings.spacing,
                                        tolerance=0.5 * settings.spacing)
        if settings.band and len(particles):
            near = cKDTree(cloud).query(particles, distance_upper_bound=settings.band)[0]
            particles = particles[near <= settings.band]
        volume = len(particles) * settings.spacing**3
        if 0 < settings.max_particles < len(particles):
            rng = np.random.default_rng(np.random.SeedSequence(0))
            particles = particles[np.sort(rng.choice(len(particles), settings.max_particles, replace=False))]
        if not len(particles):
            wider = ", or a wider band" if settings.band else ""
            raise MethodError(f"no particle lies in or behind what the camera sees: the {len(cloud)} visible points "
                              f"span {' x '.join(f'{1e3 * x:.0f}' for x in np.ptp(cloud, axis=0))} mm, "
                              f"and the particles are {1e3 * settings.spacing:g} mm apart. Give a smaller "
                              f"spacing{wider}.")
        return cls(particles, settings, volume / len(particles))

    def knots(self, reach: float) -> sparse.csr_matrix:
        """Weights with which particles average the springs of knots (n, s); the weights of a particle sum to 1.

        The knots are the mean places of the particles in the cells of a grid of ``reach`` [m], the weights Gaussians
        of that width, the same in every call. Where knots are independent, particles a width apart have a correlation
        of about 0.8, and of 0.4 at two.
        """
        if self.near is None:
            points = self.particles
            cell, of = np.unique(np.floor(points / reach).astype(np.int64), axis=0, return_inverse=True)
            members = sparse.csr_matrix((np.ones(len(points)), (of.ravel(), np.arange(len(points)))))
            centres = (members @ points) / np.asarray(members.sum(axis=1))
            apart = cKDTree(points).sparse_distance_matrix(cKDTree(centres), 2.5 * reach, output_type="coo_matrix")
            weights = sparse.csr_matrix((np.exp(-0.5 * (apart.data / reach) ** 2), (apart.row, apart.col)),
                                        shape=(len(points), len(cell)))
            self.near = sparse.csr_matrix(weights.multiply(1.0 / np.asarray(weights.sum(axis=1))))
        return self.near

    def observe(self, action: Action) -> sparse.csr_matrix:
        """W (T d, n) of a touch, frame by frame: readings = W K.

        Raises:
            MethodError: the particle model does not predict this observation, or not with this probe.
        """
        key = digest(action.poses, action.axis, *(() if action.q is None else (action.q,)))
        key += f"{action.probe}{action.observation}".encode()
        if key not in self.rows:
            row = OBSERVATIONS.get(action.observation)
            if row is None:
                raise MethodError(f"the particle model has no observation rows for '{action.observation}'; it knows "
                                  f"{', '.join(OBSERVATIONS)}.")
            try:
                predicted = row.predictor()(self.particles, action, friction=self.settings.friction,
                                            device=self.settings.device)
            except VsfError as error:
                raise MethodError(str(error)) from error
            if self.settings.growth != 1.0 and action.size == 1:
                total: np.ndarray = np.asarray(abs(predicted).sum(axis=1)).ravel()
                scale = np.power(total, self.settings.growth - 1.0, where=total > 0.0, out=np.zeros_like(total))
                predicted = sparse.csr_matrix(sparse.diags_array(scale) @ predicted)
            self.rows[key] = predicted / row.force_per_unit
        return self.rows[key]

    def plain(self, readings: Sequence[Reading]) -> tuple[sparse.csr_matrix, np.ndarray]:
        """All valid rows of some touches in the unit of the readings: W (m, n) and z (m,)."""
        rows = [self.observe(one.action)[np.flatnonzero(np.repeat(one.valid, one.action.size))] for one in readings]
        every = sparse.csr_matrix(sparse.vstack([sparse.csr_matrix((0, len(self.particles))), *rows]))
        return every, np.concatenate([np.zeros(0), *(one.value[one.valid].ravel() for one in readings)])

    def stack(self, readings: Sequence[Reading]) -> tuple[sparse.csr_matrix, np.ndarray]:
        """All valid rows of some touches: W (m, n) and z (m,), in units in which each has the noise of
        `VsfSettings.noise_std`.

        Raises:
            MethodError: as `check_support`.
        """
        check_support(readings)
        blocks, values = [sparse.csr_matrix((0, len(self.particles)))], [np.zeros(0)]
        for reading in readings:
            if self.settings.skin_std is not None and reading.surface is not None:
                rows, known = self._surface_rows(reading)
                weight = self.settings.noise_std / self.settings.skin_std
            else:
                valid = np.flatnonzero(np.repeat(reading.valid, reading.action.size))
                rows, known = self.observe(reading.action)[valid], reading.value[reading.valid].ravel()
                weight = OBSERVATIONS[reading.action.observation].force_per_unit
                weight /= float(self.noise_factor(weight * known))
            blocks.append(weight * rows)
            values.append(weight * known)
        return sparse.csr_matrix(sparse.vstack(blocks)), np.concatenate(values)

    def noise_factor(self, force: np.ndarray) -> np.ndarray:
        """Noise of a touch with readings ``force`` (k,) relative to `VsfSettings.noise_std` [-]."""
        return np.hypot(1.0, self.settings.noise_share * np.abs(force).max(initial=0.0) / self.settings.noise_std)

    def _surface_rows(self, reading: Reading) -> tuple[sparse.csr_matrix, np.ndarray]:
        """Rows (r, n) and values (r,) that carry all that the forces on the surface's vertices say of the stiffnesses
        (Neural VSF eq. 3).

        With W^T W = V s V^T they are sqrt(s) V^T and V^T W^T z / sqrt(s): at most one row for each displaced particle,
        where W has three rows a vertex and frame.
        """
        assert reading.surface is not None
        key = digest(reading.surface.vertices, reading.surface.force, reading.valid)
        if key not in self.surfaces:
            touch = dense_touch(reading)
            if touch is None:
                return sparse.csr_matrix((0, len(self.particles))), np.zeros(0)
            known = ~np.isnan(touch.force).all(axis=(1, 2))
            w = dense_force_rows(stick(self.particles, touch.vertices, touch.triangles), len(self.particles),
                                 touch.triangles, touch.vertices.shape[1])
            w = w[np.flatnonzero(np.repeat(known, touch.force[0].size))]
            moved = np.unique(w.indices)
            part = w[:, moved]
            size, vectors = np.linalg.eigh((part.T @ part).toarray()) if len(moved) else (np.zeros(0), np.zeros((0, 0)))
            keep = size > 1e-12 * max(float(size[-1]) if len(size) else 0.0, 1e-300)
            root, vectors = np.sqrt(size[keep]), vectors[:, keep]
            rows = sparse.csr_matrix(((root[:, None] * vectors.T).ravel(), np.tile(moved, len(root)),
                                      np.arange(len(root) + 1) * len(moved)), shape=(len(root), w.shape[1]))
            self.surfaces[key] = rows, (vectors.T @ (part.T @ touch.force[known].ravel())) / root
        return self.surfaces[key]


@dataclass
class ObjectShelf:
    """Models by view, so that a new shot or seed on the same view finds its particles and rows."""

    settings: VsfSettings
    """Of all models."""
    objects: dict[bytes, ParticleModel] = field(default_factory=dict)
    """By the digest of their views."""

    def __reduce__(self) -> tuple[type[ObjectShelf], tuple[VsfSettings]]:
        """A copy in another process begins empty: trials ask about other views than those that were learned from."""
        return ObjectShelf, (self.settings,)

    def get(self, view: View) -> ParticleModel:
        """The model of the object behind ``view``."""
        key = digest(view.rgb, view.depth, view.mask, view.intrinsics, view.camera_pose)
        if key not in self.objects:
            self.objects[key] = ParticleModel.behind(view, self.settings)
        return self.objects[key]
