"""The stiffness of a particle model after some touches: the MAP estimate or a Kalman filter, and what both predict."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy import sparse
from scipy.spatial import cKDTree

from vsfsim.baselines.converted import converted
from vsfsim.baselines.known_object import PoseSearch, locate
from vsfsim.baselines.particle_model import ParticleModel
from vsfsim.bench.method import Action, Estimate, Reading, check_support
from vsfsim.bench.observations import OBSERVATIONS
from vsfsim.data.records import View
from vsfsim.vsf.estimate.kalman import DiagonalFilter
from vsfsim.vsf.estimate.map import map_estimate
from vsfsim.vsf.estimate.structured import reading_std, structured_map
from vsfsim.vsf.meta.calibration import Missed, Width
from vsfsim.vsf.meta.composition import GaussianPrior


@dataclass
class Posterior:
    """What is known of one object after some touches."""

    model: ParticleModel
    """The object."""
    stiffness: np.ndarray
    """MAP estimate of each particle's spring constant (n,) [N/m]."""
    rows: sparse.csr_matrix
    """W of the support (m, n)."""
    prior: GaussianPrior
    """Of the spring constants."""
    width: Width | None = field(default=None, kw_only=True)
    """Of predicted readings; None for the noise of the settings."""

    @classmethod
    def of(cls, model: ParticleModel, support: Sequence[Reading], *, prior_mean: float, prior_var: float) -> Posterior:
        """MAP under one mean [N/m] and variance for all particles."""
        return cls.under(model, support, GaussianPrior.plain(prior_mean, prior_var, len(model.particles)))

    @classmethod
    def under(cls, model: ParticleModel, support: Sequence[Reading], prior: GaussianPrior) -> Posterior:
        """MAP by the quadratic program of SBML eq. 16, K >= 0; with `VsfSettings.reach`, of springs that are alike."""
        if model.settings.reach:
            return cls._alike(model, support, prior)
        rows, z = model.stack(support)
        if rows.shape[0] == 0:
            return cls(model, np.maximum(prior.total_mean(), 0.0), rows, prior)
        return cls(model, structured_map(rows, z, noise_std=model.settings.noise_std, prior=prior), rows, prior)

    @classmethod
    def _alike(cls, model: ParticleModel, support: Sequence[Reading], prior: GaussianPrior) -> Posterior:
        """MAP of springs that deviate from the prior's means together with those near them.

        K = diag(h) B phi with phi >= 0 of the knots, h the prior's means and phi around 1, or h = 1 and phi around 0
        where these are 0. The variance of phi is the one with which the springs have the prior's variance in the mean.
        """
        mean, weights = np.maximum(prior.total_mean(), 0.0), model.knots(model.settings.reach)
        around = float(mean.any())
        shape = np.maximum(mean, 1e-3 * mean.max()) if around else np.ones(len(mean))
        scaled = sparse.csr_matrix(sparse.diags_array(shape) @ weights)
        count = weights.shape[1]
        common = np.full(count, float((prior.total_std() ** 2).sum() / scaled.power(2).sum()))
        known = GaussianPrior(around * shape, np.zeros(len(mean)), scaled, np.zeros(count), common)
        rows, z = model.stack(support)
        if rows.shape[0] == 0:
            return cls(model, around * shape, rows, known)
        knots = map_estimate(sparse.csr_matrix(rows @ scaled), z, noise_std=model.settings.noise_std,
                             prior_mean=np.full(count, around), prior_var=common)
        return cls(model, scaled @ knots, rows, known)

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
        # All rows at once, so that the support is factored once.
        every = self._reading_std(sparse.vstack(rows))
        out, first = [], 0
        for action, mine in zip(actions, rows):
            predicted, springs = mine @ self.stiffness, every[first:first + mine.shape[0]]
            if self.width is not None:
                std = self.width.std(predicted, springs)
            else:
                unit = OBSERVATIONS[action.observation].force_per_unit
                noise = self.model.settings.noise_std * self.model.noise_factor(unit * predicted) / unit
                std = np.hypot(springs, noise)
            out.append(std.reshape(-1, action.size))
            first += mine.shape[0]
        return out

    def missed(self, readings: Sequence[Reading]) -> Missed:
        """What is measured, what is predicted and what the springs leave open in further touches."""
        every, measured = self.model.plain(readings)
        predicted = every @ self.stiffness
        return Missed(measured - predicted, predicted, self._reading_std(every))

    def density(self, points: np.ndarray) -> Estimate:
        """Stiffness density around ``points`` (k, 3) [m]: mean and std (k,) [N/m^4].

        Spring constant over the volume of a particle's cell, averaged over the particles within two spacings (the
        nearest one if there is none). The std is the mean of theirs, as if they erred together.
        """
        spacing = self.model.settings.spacing
        tree = cKDTree(self.model.particles)
        nearest = tree.query(points)[1]
        near = tree.query_ball_point(points, 2.0 * spacing, return_sorted=True)
        groups = [np.asarray(group if group else [n]) for group, n in zip(near, nearest)]
        cell, used = self.model.cell, np.unique(np.concatenate([nearest, *groups]))
        std = np.zeros(len(self.stiffness))
        std[used] = self._reading_std(sparse.identity(len(std), format="csr")[used])
        return Estimate(np.array([self.stiffness[g].mean() for g in groups]) / cell,
                        np.array([std[g].mean() for g in groups]) / cell)

    def _reading_std(self, rows: sparse.csr_matrix) -> np.ndarray:
        """Of readings to come, rows (q, n), without their own noise (q,)."""
        return reading_std(self.rows, rows, noise_std=self.model.settings.noise_std, prior=self.prior)


@dataclass
class Filtered(Posterior):
    """What the diagonal Kalman filter knows after the same touches, assimilated frame by frame (Neural VSF section
    III-B)."""

    var: np.ndarray
    """Variance of each spring constant (n,) [(N/m)^2]."""

    @classmethod
    def online(cls, model: ParticleModel, support: Sequence[Reading], *, prior_mean: float,
               prior_var: float, replay: int = 0) -> Filtered:
        """From one mean [N/m] and variance for all particles, touch after touch in the order given; after each frame
        ``replay`` earlier ones are replayed."""
        check_support(support)
        state = DiagonalFilter.start(len(model.particles), mean=prior_mean, var=prior_var)
        blocks = [sparse.csr_matrix((0, len(model.particles)))]
        for reading in support:
            rows, z = model.stack([reading])
            state.run(rows, z, noise_std=model.settings.noise_std, size=reading.action.size, replay=replay)
            blocks.append(rows)
        return cls(model, np.maximum(state.mean, 0.0), sparse.csr_matrix(sparse.vstack(blocks)),
                   GaussianPrior.plain(prior_mean, prior_var, len(model.particles)), state.var)

    def _reading_std(self, rows: sparse.csr_matrix) -> np.ndarray:
        return np.sqrt(sparse.csr_matrix(rows).power(2) @ self.var)


@converted
class PosteriorAnswers:
    """What every particle method answers: the answers of the posterior that its `adapt` left."""

    _view: View
    posterior: Posterior
    _search = PoseSearch()

    def predict(self, touches: Sequence[Action]) -> list[np.ndarray]:
        """Readings (T, d) of touches not made yet."""
        return self.posterior.predict(touches)

    def predict_std(self, touches: Sequence[Action]) -> list[np.ndarray]:
        """Standard deviations (T, d) of those readings."""
        return self.posterior.predict_std(touches)

    def stiffness(self, points: np.ndarray) -> Estimate:
        """Stiffness density at ``points`` (k, 3) [m]: (k,) [N/m^4]."""
        return self.posterior.density(points)

    def locate(self, vertices: np.ndarray, triangles: np.ndarray) -> np.ndarray:
        """Object-to-world transform (4, 4) of a stiff object of known shape."""
        touched = self.posterior.touched()
        return locate(vertices, triangles, self.posterior.model.particles[touched], self.posterior.stiffness[touched],
                      self._view, self._search)
