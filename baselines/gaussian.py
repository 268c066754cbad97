"""`gaussian` and `gaussian-zero`: the vanilla VSF with a naive Gaussian prior (SBML section 4.2 and appendix C.1).

Vision gives the particles but not the prior: all particles of all objects share one mean and one variance. Both come
from the training objects: each is fitted with all of its touches and an uninformed prior (as `point-vsf` does), and the
spring constants of the touched particles of all of them are pooled. The stiff particles raise the mean, which tends to
overestimate. The paper therefore has a second variant that sets the mean to zero and keeps the variance.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from vsfsim.baselines.converted import converted
from vsfsim.baselines.particle_model import ObjectShelf, ParticleModel, VsfSettings
from vsfsim.baselines.posterior import Posterior, PosteriorAnswers
from vsfsim.baselines.visible_cloud import LearnedArrays
from vsfsim.bench.method import Reading, Specimen
from vsfsim.core.errors import MethodError
from vsfsim.data.records import View


@converted
class GaussianAverage(PosteriorAnswers, LearnedArrays):
    """Prior mean: the average spring constant of the training objects' touched particles.

    Args:
        spacing: distance of the particles [m] (SBML appendix B.2: 5 mm for shoes).
        friction: Coulomb coefficient of the stick-slip motion [-]; 0 fits scenes without friction.
        noise_std: of a reading [N]. It includes what the particle model cannot explain, which is more than the sensor's
            0.15 N: with 0.15 N the Gaussian prior's error on fewshot-shoes-mini-v1 no longer falls with every touch.
        fit_std: prior standard deviation of a spring constant in the fits of the training objects [N/m]; large, so that
            their touches decide.
        margin: widening of the box around the visible cloud [m].
        table_height: z of the table the object stands on [m].
        noise_share: fraction of a touch's largest reading by which the particle model errs besides [-].
        band: particles further from every visible point are left out [m]; 0 keeps the whole hidden volume.
        reach: width of the neighbourhoods in which spring constants are alike [m]; 0: independent, as in the papers.
        growth: power of the summed displacement with which a reading grows, see
            `vsfsim.baselines.particle_model.VsfSettings` [-]; 1 as in the papers.
        max_particles: the most particles, drawn at random from those in the volume; 0 for all.
        device: Warp device.
    """

    _name, _zero_mean = "gaussian", False

    def __init__(self, *, spacing: float = 0.005, friction: float = 0.0, noise_std: float = 1.0,
                 fit_std: float = 1000.0, margin: float = 0.01, table_height: float = 0.0, noise_share: float = 0.0,
                 band: float = 0.0, reach: float = 0.0, growth: float = 1.0, max_particles: int = 0,
                 device: str = "cpu"):
        self.fit_std = fit_std
        self.shelf = ObjectShelf(VsfSettings(spacing, friction, noise_std, margin, table_height, device,
                                             noise_share=noise_share, band=band, reach=reach, growth=growth,
                                             max_particles=max_particles))

    def meta_fit(self, specimens: Sequence[Specimen]) -> None:
        """Estimate the prior's mean [N/m] and variance [(N/m)^2].

        Raises:
            MethodError: there is no training object, or none of their touches reached a particle.
        """
        pooled = [np.zeros(0)]
        for specimen in specimens:
            model = ParticleModel.behind(specimen.view, self.shelf.settings)
            posterior = Posterior.of(model, specimen.touches, prior_mean=0.0, prior_var=self.fit_std**2)
            pooled.append(posterior.stiffness[posterior.touched()])
        values = np.concatenate(pooled)
        if values.size == 0 or values.var() == 0.0:
            raise MethodError(f"the Gaussian prior cannot be estimated: {len(specimens)} training objects with "
                              f"{values.size} touched particles. Give a train split whose touches meet the objects.")
        self._learned = {"mean": 0.0 * values.mean() if self._zero_mean else values.mean(), "variance": values.var()}

    def adapt(self, view: View, support: Sequence[Reading]) -> None:
        """Start from the prior and fit the springs to the support touches."""
        mean, variance = float(self._learned["mean"]), float(self._learned["variance"])
        self._view = view
        self.posterior = Posterior.of(self.shelf.get(view), support, prior_mean=mean, prior_var=variance)


class GaussianZero(GaussianAverage):
    """Prior mean: zero; the variance is that of `GaussianAverage`."""

    _name, _zero_mean = "gaussian-zero", True
