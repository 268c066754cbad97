"""`point-vsf`: the volumetric stiffness field without an informed prior (SBML tables 1 and 2, row "VSF all-shot");
`dense-vsf`: the same from the forces on a deformable sensor's surface.

The model is independent springs on particles (SBML appendix A). Their constants are the MAP estimate with K >= 0
(eq. 16) under a zero mean and a variance so large that the data alone decide. The papers give it all touches. Here it
runs at every shot and shows what the touches contain by themselves; before the first touch it predicts 0.
"""

from __future__ import annotations

from collections.abc import Sequence

from vsfsim.baselines.converted import converted
from vsfsim.baselines.known_object import PoseSearch
from vsfsim.baselines.particle_model import ObjectShelf, VsfSettings
from vsfsim.baselines.posterior import Filtered, Posterior, PosteriorAnswers
from vsfsim.bench.method import Reading, Specimen
from vsfsim.core.errors import MethodError, did_you_mean
from vsfsim.data.records import View

ESTIMATORS = ("batch", "filter")


@converted
class PointVsf(PosteriorAnswers):
    """Learns nothing from training objects.

    Args:
        spacing: distance of the particles [m] (SBML appendix B.2: 5 mm for shoes).
        friction: Coulomb coefficient of the stick-slip motion [-]; 0 fits scenes without friction.
        noise_std: of a reading [N]. It includes what the particle model cannot explain, which is more than the sensor's
            0.15 N.
        prior_std: of a spring constant [N/m]; the default is some hundred times the constant of a particle of
            a shoe's upper.
        margin: widening of the box around the visible cloud [m].
        table_height: z of the table the object stands on [m].
        noise_share: fraction of a touch's largest reading by which the particle model errs besides [-].
        band: particles further from every visible point are left out [m]; 0 keeps the whole hidden volume.
        reach: width of the neighbourhoods in which spring constants are alike [m]; 0: independent, as in the papers.
        growth: power of the summed displacement with which a reading grows, see
            `vsfsim.baselines.particle_model.VsfSettings` [-]; 1 as in the papers.
        max_particles: the most particles, drawn at random from those in the volume; 0 for all.
        device: Warp device.
        estimator: "batch", the quadratic program, or "filter", the diagonal Kalman filter, which assimilates one frame
            after the other (Neural VSF section III-B).
        replay: of the filter: earlier frames that are replayed after each new one, drawn at random; the authors'
            published package (uiuc-iml/openvsf) replays 10.
        pose: how `locate` finds a known object, see `vsfsim.baselines.known_object`: "outline", or "registration", the
            papers' procedure in six degrees of freedom (Neural VSF section III-E).
    """

    def __init__(self, *, spacing: float = 0.005, friction: float = 0.0, noise_std: float = 1.0,
                 prior_std: float = 1000.0, margin: float = 0.01, table_height: float = 0.0, noise_share: float = 0.0,
                 band: float = 0.0, reach: float = 0.0, growth: float = 1.0, max_particles: int = 0,
                 device: str = "cpu",
                 estimator: str = "batch", replay: int = 0, pose: str = "outline"):
        if estimator not in ESTIMATORS:
            raise MethodError(f"point-vsf: estimator is '{estimator}'. {did_you_mean(estimator, ESTIMATORS)}")
        if replay < 0 or (replay and estimator != "filter"):
            raise MethodError(f"point-vsf: replay is {replay!r} with estimator '{estimator}'; it must be 0 or greater, "
                              f"and belongs to the filter. Give --set estimator=filter, or leave replay away.")
        if reach and estimator == "filter":
            raise MethodError(f"point-vsf: reach is {reach!r} with estimator 'filter', whose springs are independent. "
                              f"Give --set estimator=batch, or leave reach away.")
        self.prior_std, self.estimator, self.replay = prior_std, estimator, replay
        self._search = PoseSearch(pose=pose)
        self.shelf = ObjectShelf(VsfSettings(spacing, friction, noise_std, margin, table_height, device,
                                             noise_share=noise_share, band=band, reach=reach, growth=growth,
                                             max_particles=max_particles))

    def meta_fit(self, specimens: Sequence[Specimen]) -> None:
        """Nothing to learn."""

    def adapt(self, view: View, support: Sequence[Reading]) -> None:
        """Fit the springs to the support touches."""
        self._view = view
        model, prior = self.shelf.get(view), {"prior_mean": 0.0, "prior_var": self.prior_std**2}
        if self.estimator == "filter":
            self.posterior = Filtered.online(model, support, replay=self.replay, **prior)
        else:
            self.posterior = Posterior.of(model, support, **prior)


@converted
class DenseVsf(PointVsf):
    """The point VSF from dense contact forces (Neural VSF section III-C).

    Where a deformable sensor measures the force on each vertex of its surface, those forces are the observations.
    Without a surface it is `point-vsf`, which is the paper's pressure-only baseline.

    Args:
        skin_std: noise of a component of the force on a vertex, the sensor's and the model's [N]; the others as of
            `PointVsf`.
    """

    def __init__(self, *, spacing: float = 0.005, friction: float = 0.0, noise_std: float = 1.0, skin_std: float = 0.05,
                 prior_std: float = 1000.0, margin: float = 0.01, table_height: float = 0.0, noise_share: float = 0.0,
                 band: float = 0.0, max_particles: int = 0, device: str = "cpu", pose: str = "outline"):
        if not skin_std > 0.0:
            raise MethodError(f"dense-vsf: skin_std is {skin_std!r}; it must be greater than 0, in newtons.")
        super().__init__(spacing=spacing, friction=friction, noise_std=noise_std, prior_std=prior_std, margin=margin,
                         table_height=table_height, noise_share=noise_share, band=band, device=device, pose=pose)
        self.shelf = ObjectShelf(VsfSettings(spacing, friction, noise_std, margin, table_height, device, skin_std,
                                             noise_share, band, max_particles))
