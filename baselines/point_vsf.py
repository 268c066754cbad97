"""`point-vsf`: the volumetric stiffness field without an informed prior (SBML tables 1 and 2, row "VSF all-shot");
`dense-vsf`: the same from the forces on a deformable sensor's surface.

The model is independent springs on particles (SBML appendix A). Their constants are the MAP estimate with K >= 0
(eq. 16) under a zero mean and a variance so large that the data alone decide. The papers give it all touches. Here it
runs at every shot and shows what the touches contain by themselves; before the first touch it predicts 0.
"""

from __future__ import annotations

from collections.abc import Sequence

from vsfsim.baselines.particle_model import ObjectShelf, VsfSettings
from vsfsim.baselines.posterior import Filtered, Posterior, PosteriorAnswers
from vsfsim.bench.method import Reading, Specimen
from vsfsim.core.errors import MethodError, did_you_mean
from vsfsim.data.records import View

ESTIMATORS = ("batch", "filter")


class PointVsf(PosteriorAnswers):
    """Learns nothing from training objects.

    Args:
        spacing: distance of the particles [m] (SBML appendix B.2: 5 mm for shoes).
        friction: Coulomb coefficient of the stick-slip motion [-]; 0 fits scenes without friction.
        noise_std: of a reading [N]. It includes what the particle model cannot explain, which is more than the sensor's
            0.15 N: with 0.15 N the Gaussian prior's error on fewshot-shoes-mini-v1 no longer falls with every touch.
        prior_std: of a spring constant [N/m]; the default is some hundred times the constant of a particle of
            a shoe's upper.
        margin: widening of the box around the visible cloud [m].
        table_height: z of the table the object stands on [m].
        noise_share: fraction of a touch's largest reading by which the particle model errs besides [-].
        band: particles further from every visible point are left out [m]; 0 keeps the whole hidden volume.
        device: Warp device.
        estimator: "batch", the quadratic program, or "filter", the diagonal Kalman filter, which assimilates one frame
            after the other (Neural VSF section III-B).
    """

    def __init__(self, *, spacing: float = 0.005, friction: float = 0.0, noise_std: float = 1.0,
                 prior_std: float = 1000.0, margin: float = 0.01, table_height: float = 0.0, noise_share: float = 0.0,
                 band: float = 0.0, device: str = "cpu", estimator: str = "batch"):
        if estimator not in ESTIMATORS:
            raise MethodError(f"point-vsf: estimator is '{estimator}'. {did_you_mean(estimator, ESTIMATORS)}")
        self.prior_std, self.estimator = prior_std, estimator
        self.shelf = ObjectShelf(VsfSettings(spacing, friction, noise_std, margin, table_height, device,
                                             noise_share=noise_share, band=band))

    def meta_fit(self, specimens: Sequence[Specimen]) -> None:
        """Nothing to learn."""

    def adapt(self, view: View, support: Sequence[Reading]) -> None:
        """Fit the springs to the support touches."""
        self._view = view
        estimate = Filtered.online if self.estimator == "filter" else Posterior.of
        self.posterior = estimate(self.shelf.get(view), support, prior_mean=0.0, prior_var=self.prior_std**2)


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
                 band: float = 0.0, device: str = "cpu"):
        if not skin_std > 0.0:
            raise MethodError(f"dense-vsf: skin_std is {skin_std!r}; it must be greater than 0, in newtons.")
        super().__init__(spacing=spacing, friction=friction, noise_std=noise_std, prior_std=prior_std, margin=margin,
                         table_height=table_height, noise_share=noise_share, band=band, device=device)
        self.shelf = ObjectShelf(VsfSettings(spacing, friction, noise_std, margin, table_height, device, skin_std,
                                             noise_share, band))
