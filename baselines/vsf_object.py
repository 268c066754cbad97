"""One object as the baselines see it: the papers' particles behind a view, and the observation rows of its touches.

Both baselines are this model with different priors. The particles, and the rows of a touch, depend on no stiffness
(SBML eq. 5), so they are made once and kept: 4 shots x 10 seeds on one object cost one simulation a touch.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy import sparse
from scipy.spatial import cKDTree

from vsfsim.baselines.locating import Locating, locate
from vsfsim.baselines.seen import seen_cloud
from vsfsim.baselines.skin import skin_touch
from vsfsim.bench.method import Action, Estimate, Reading
from vsfsim.bench.observations import OBSERVATIONS
from vsfsim.core.errors import MethodError, VsfError
from vsfsim.data.records import View
from vsfsim.vsf.estimate.kalman import DiagonalFilter
from vsfsim.vsf.estimate.structured import reading_std, structured_map, structured_std
from vsfsim.vsf.meta.composition import GaussianPrior
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


@dataclass
class VsfObject:
    """The particles of one object, and what is computed for them on demand."""

    particles: np.ndarray
    """Rest positions, world (n, 3) [m]."""
    settings: VsfSettings
    """Of the model."""
    rows: dict[bytes, sparse.csr_matrix] = field(default_factory=dict)
    """Observation rows (T d, n) by action."""
    skins: dict[bytes, tuple[sparse.csr_matrix, np.ndarray]] = field(default_factory=dict)
    """Rows and values of touches with a sensor surface."""
    features: dict[str, np.ndarray] = field(default_factory=dict)
    """Of the particles, by kind."""

    @classmethod
    def behind(cls, view: View, settings: VsfSettings) -> VsfObject:
        """Particles in the visible surface and the volume it hides (SBML appendix B.2).

        Raises:
            MethodError: the view shows no object, or none of the particles lies in it.
        """
        cloud = seen_cloud(view)
        bounds = np.stack([cloud.min(axis=0) - settings.margin, cloud.max(axis=0) + settings.margin])
        bounds[0, 2] = min(settings.table_height, cloud[:, 2].min())
        # Half a cell before the surface still belongs to it; else the first layer would lie up to a cell deep, and a
        # shallow press would meet nothing.
        particles = particles_from_view(view, bounds=bounds, spacing=settings.spacing, device=settings.device,
                                        tolerance=0.5 * settings.spacing)
        if not len(particles):
            raise MethodError(f"no particle lies in or behind what the camera sees: the {len(cloud)} visible points "
                              f"span {' x '.join(f'{1e3 * x:.0f}' for x in np.ptp(cloud, axis=0))} mm, "
                              f"and the particles are {1e3 * settings.spacing:g} mm apart. Give a smaller spacing.")
        return cls(particles, settings)

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
            self.rows[key] = predicted / row.force_per_unit
        return self.rows[key]

    def stack(self, readings: Sequence[Reading]) -> tuple[sparse.csr_matrix, np.ndarray]:
        """All valid rows of some touches: W (m, n) and z (m,), in units in which each has the noise of
        `VsfSettings.noise_std`.

        Raises:
            MethodError: a reading marked valid is not finite.
        """
        blocks, values = [sparse.csr_matrix((0, len(self.particles)))], [np.zeros(0)]
        for index, reading in enumerate(readings):
            value = reading.value[reading.valid]
            if value.shape[1:] != (reading.action.size,):
                raise MethodError(f"touch {index} of the support has readings of {value.shape[1:]} numbers; its action "
                                  f"says {reading.action.size}.")
            if not np.isfinite(value).all():
                raise MethodError(f"touch {index} of the support has a reading that is not finite in a frame "
                                  f"marked valid.")
            if self.settings.skin_std is not None and reading.surface is not None:
                rows, seen = self._skin_rows(reading)
                weight = self.settings.noise_std / self.settings.skin_std
            else:
                rows, seen = self.observe(reading.action)[np.flatnonzero(np.repeat(reading.valid,
                                                                                   reading.action.size))], value.ravel()
                weight = OBSERVATIONS[reading.action.observation].force_per_unit
                weight /= float(self.noise_factor(weight * seen))
            blocks.append(weight * rows)
            values.append(weight * seen)
        return sparse.csr_matrix(sparse.vstack(blocks)), np.concatenate(values)

    def noise_factor(self, force: np.ndarray) -> np.ndarray:
        """By how much the noise of a touch with readings ``force`` (k,) is above `VsfSettings.noise_std` [-]."""
        return np.hypot(1.0, self.settings.noise_share * np.abs(force).max(initial=0.0) / self.settings.noise_std)

    def _skin_rows(self, reading: Reading) -> tuple[sparse.csr_matrix, np.ndarray]:
        """Rows (r, n) and values (r,) that say of the stiffnesses all that the forces on the skin's vertices do (Neural
        VSF eq. 3): with W^T W = V s V^T they are sqrt(s) V^T and V^T W^T z / sqrt(s), as many as particles were moved
        at most, where W has three a vertex and frame."""
        assert reading.surface is not None
        key = digest(reading.surface.vertices, reading.surface.force, reading.valid)
        if key not in self.skins:
            touch = skin_touch(reading)
            if touch is None:
                return sparse.csr_matrix((0, len(self.particles))), np.zeros(0)
            known = ~np.isnan(touch.force).all(axis=(1, 2))
            w = dense_force_rows(stick(self.particles, touch.vertices, touch.triangles), len(self.particles),
                                 touch.triangles, touch.vertices.shape[1])
            w = w[np.flatnonzero(np.repeat(known, touch.force[0].size))]
            moved = np.unique(w.indices)
            part = w[:, moved]
            size, turn = np.linalg.eigh((part.T @ part).toarray()) if len(moved) else (np.zeros(0), np.zeros((0, 0)))
            keep = size > 1e-12 * max(float(size[-1]) if len(size) else 0.0, 1e-300)
            root = np.sqrt(size[keep])
            rows = sparse.csr_matrix(((root[:, None] * turn[:, keep].T).ravel(), np.tile(moved, len(root)),
                                      np.arange(len(root) + 1) * len(moved)), shape=(len(root), w.shape[1]))
            self.skins[key] = rows, (turn[:, keep].T @ (part.T @ touch.force[known].ravel())) / root
        return self.skins[key]


@dataclass
class Posterior:
    """What is known of one object after some touches."""

    model: VsfObject
    """The object."""
    stiffness: np.ndarray
    """MAP estimate of each particle's spring constant (n,) [N/m]."""
    rows: sparse.csr_matrix
    """W of the support (m, n)."""
    prior: GaussianPrior
    """Of the spring constants."""

    @classmethod
    def of(cls, model: VsfObject, support: Sequence[Reading], *, prior_mean: float, prior_var: float) -> Posterior:
        """MAP under one mean [N/m] and variance for all particles."""
        return cls.under(model, support, GaussianPrior.plain(prior_mean, prior_var, len(model.particles)))

    @classmethod
    def under(cls, model: VsfObject, support: Sequence[Reading], prior: GaussianPrior) -> Posterior:
        """MAP by the quadratic program of SBML eq. 16, K >= 0."""
        rows, z = model.stack(support)
        if rows.shape[0] == 0:
            return cls(model, np.maximum(prior.total_mean(), 0.0), rows, prior)
        return cls(model, structured_map(rows, z, noise_std=model.settings.noise_std, prior=prior).mean, rows, prior)

    def touched(self) -> np.ndarray:
        """Particles that the support displaced (n,) bool."""
        return np.diff(self.rows.tocsc().indptr) > 0

    def predict(self, actions: Sequence[Action]) -> list[np.ndarray]:
        """Readings (T, d) of each action."""
        return [(self.model.observe(action) @ self.stiffness).reshape(-1, action.size) for action in actions]

    def predict_std(self, actions: Sequence[Action]) -> list[np.ndarray]:
        """Standard deviations (T, d) of the readings: what is left of the springs', and the noise of a reading."""
        rows = [self.model.observe(action) for action in actions]
        if not rows:
            return []
        # All at once: what the support tells is factored once.
        every = self._reading_std(sparse.vstack(rows))
        out, first = [], 0
        for action, mine in zip(actions, rows):
            unit = OBSERVATIONS[action.observation].force_per_unit
            noise = self.model.settings.noise_std * self.model.noise_factor(unit * (mine @ self.stiffness)) / unit
            out.append(np.hypot(every[first:first + mine.shape[0]], noise).reshape(-1, action.size))
            first += mine.shape[0]
        return out

    def density(self, points: np.ndarray) -> Estimate:
        """Stiffness density around ``points`` (k, 3) [m]: mean and std (k,) [N/m^4].

        Spring constant over the volume of a particle's cell, averaged over the particles within two spacings (the
        nearest one if there is none). The std is the mean of theirs, as if they erred together.
        """
        spacing = self.model.settings.spacing
        std = self._std()
        tree = cKDTree(self.model.particles)
        nearest = tree.query(points)[1]
        near = tree.query_ball_point(points, 2.0 * spacing, return_sorted=True)
        groups = [np.asarray(group if group else [n]) for group, n in zip(near, nearest)]
        volume = spacing**3
        return Estimate(np.array([self.stiffness[g].mean() for g in groups]) / volume,
                        np.array([std[g].mean() for g in groups]) / volume)

    def _reading_std(self, rows: sparse.csr_matrix) -> np.ndarray:
        """Of readings to come, rows (q, n), without their own noise (q,)."""
        return reading_std(self.rows, rows, noise_std=self.model.settings.noise_std, prior=self.prior)

    def _std(self) -> np.ndarray:
        """Of each particle's spring constant (n,) [N/m]."""
        return structured_std(self.rows, noise_std=self.model.settings.noise_std,
                              prior=self.prior) if self.rows.shape[0] else self.prior.total_std()

    def locate(self, vertices: np.ndarray, triangles: np.ndarray, view: View, *, seed: int = 0) -> np.ndarray:
        """Object-to-world transform (4, 4) of a stiff object of known shape, from the touched particles."""
        touched = self.touched()
        return locate(vertices, triangles, self.model.particles[touched], self.stiffness[touched], view,
                      Locating(seed=seed))


@dataclass
class Filtered(Posterior):
    """What the diagonal Kalman filter knows after the same touches, assimilated frame by frame (Neural VSF section
    III-B)."""

    var: np.ndarray
    """Variance of each spring constant (n,) [(N/m)^2]."""

    @classmethod
    def online(cls, model: VsfObject, support: Sequence[Reading], *, prior_mean: float, prior_var: float) -> Filtered:
        """From one mean [N/m] and variance for all particles, touch after touch in the order given."""
        state = DiagonalFilter.start(len(model.particles), mean=prior_mean, var=prior_var)
        blocks = [sparse.csr_matrix((0, len(model.particles)))]
        for index, reading in enumerate(support):
            try:
                rows, z = model.stack([reading])
            except MethodError as error:
                raise MethodError(str(error).replace("touch 0", f"touch {index}")) from error
            state.run(rows, z, noise_std=model.settings.noise_std, size=reading.action.size)
            blocks.append(rows)
        return cls(model, np.maximum(state.mean, 0.0), sparse.csr_matrix(sparse.vstack(blocks)),
                   GaussianPrior.plain(prior_mean, prior_var, len(model.particles)), state.var)

    def _reading_std(self, rows: sparse.csr_matrix) -> np.ndarray:
        return np.sqrt(sparse.csr_matrix(rows).power(2) @ self.var)

    def _std(self) -> np.ndarray:
        return np.sqrt(self.var)


@dataclass
class ObjectShelf:
    """Objects by view, so that a new shot or seed on the same view finds its particles and rows."""

    settings: VsfSettings
    """Of all objects."""
    objects: dict[bytes, VsfObject] = field(default_factory=dict)
    """By the digest of their views."""

    def get(self, view: View) -> VsfObject:
        """The object behind ``view``."""
        key = digest(view.rgb, view.depth, view.mask, view.intrinsics, view.camera_pose)
        if key not in self.objects:
            self.objects[key] = VsfObject.behind(view, self.settings)
        return self.objects[key]


def digest(*arrays: np.ndarray) -> bytes:
    """Of the arrays' bytes: the same arrays give the same."""
    out = hashlib.blake2b()
    for array in arrays:
        out.update(np.ascontiguousarray(array).tobytes())
    return out.digest()
