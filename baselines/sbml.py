"""`sbml`: structured Bayesian meta-learning on the VSF model (SBML, eq. 10-16, appendices A and B).

A small network maps visual features of the particles to the mean and variance of their spring constants. It is learned
offline on the training objects by maximum likelihood of their readings, with the springs marginalised out (eq. 15). On
a new object the network's output is the prior, and touches update it (eq. 16, K >= 0).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import astuple, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial import cKDTree

from vsfsim.baselines.converted import converted
from vsfsim.baselines.known_object import PoseSearch
from vsfsim.baselines.particle_model import ObjectShelf, ParticleModel, VsfSettings
from vsfsim.baselines.posterior import Posterior, PosteriorAnswers
from vsfsim.baselines.visible_cloud import LearnedArrays, visible_cloud
from vsfsim.bench.method import Reading, Specimen
from vsfsim.bench.observations import OBSERVATIONS
from vsfsim.core.errors import MethodError, did_you_mean
from vsfsim.data.records import View
from vsfsim.vsf.features.interface import Normaliser
from vsfsim.vsf.features.registry import NAMES, particle_features
from vsfsim.vsf.meta.calibration import Felt, Held, Level, Missed, Shares, Width, blended, pattern_scale
from vsfsim.vsf.meta.composition import STRUCTURES, Composition, GaussianPrior

if TYPE_CHECKING:  # torch is imported where it is used
    from vsfsim.vsf.meta.prior import MetaPrior, MetaTask, Spread, Training


@converted
class Sbml(PosteriorAnswers, LearnedArrays):
    """SBML with a prior learned by `meta_fit`.

    Args:
        structure: HE, HE+HO or HE+SEG (section 4.5).
        features: local, place, xyzrgb, dinov2-s or dinov2-b, see `vsfsim.vsf.features.registry`.
        weights: file of pretrained weights for the DINOv2 features; "" looks in the usual caches.
        prior: folder that `save` wrote, to use instead of learning from the training objects; "" learns.
        seed: of the initial weights, the order of training, dropout and the validation objects.
        networks: number of networks in the prior. One is the paper's. Several are each stopped on another part of the
            training objects, and their level and the width of predicted readings (`vsfsim.vsf.meta.calibration`) are
            found on objects that they did not learn from; ``validation`` is then one part of that many.
        common_std: with several networks of structure HE, standard deviation of a component common to all particles of
            an object while they learn, over the mean of the fitted springs [-].
        rate, epochs, patience, dropout, output, second: of the training, see `vsfsim.vsf.meta.prior`.
        validation: fraction of the training objects that are used for early stopping only (at least one of two or
            more).
        spacing: distance of the particles [m] (appendix B.2: 5 mm for shoes, 10 mm for plants).
        friction: Coulomb coefficient of the stick-slip motion [-].
        noise_std: of a reading, in its unit. The error of the particle model is some newtons and common to a whole
            touch, while eq. 15 treats its ten readings as independent; 3 N is 1 N times sqrt(10).
        noise_share: fraction of a touch's largest reading by which the particle model errs besides (in eq. 15 and 16).
            With 0, as in the paper, stiff objects determine the mean, which then lies far above most objects.
        fit_std: prior standard deviation of a spring constant in the fits that give the initial uncertainty [N/m].
        margin: widening of the box around the visible cloud [m].
        table_height: z of the table the object stands on [m].
        band: particles further from every visible point are left out [m]; 0 keeps the whole hidden volume.
        reach: with several networks of structure HE, springs deviate from what the networks say together with all
            others and with those within about this distance [m], and by themselves; how much, and the noise of a
            reading, is found on objects that the networks did not learn from (`vsfsim.vsf.meta.calibration.Shares`).
            0: by a common factor and by themselves, with the noise of the settings.
        growth: power of the summed displacement with which a reading grows, see
            `vsfsim.baselines.particle_model.VsfSettings` [-]; 1 as in the paper.
        max_particles: the most particles, drawn at random from those in the volume; 0 for all.
        device: "cpu" or "cuda:0", where the prior is learned, and of the DINOv2 features; touches adapt on the host,
            where trials can be forks.
    """

    _name = "sbml"
    _settings = ("structure", "features", "output", "second", "networks", "reach")

    def __init__(self, *, structure: str = "HE", features: str = "local", weights: str = "", prior: str = "",
                 seed: int = 0, networks: int = 1, common_std: float = 0.5, rate: float = 1e-4, epochs: int = 400,
                 patience: int = 40, dropout: float = 0.1, output: str = "softplus", second: str = "std",
                 validation: float = 0.25, spacing: float = 0.005, friction: float = 0.0, noise_std: float = 3.0,
                 noise_share: float = 0.0, fit_std: float = 1000.0, margin: float = 0.01, table_height: float = 0.0,
                 band: float = 0.0, reach: float = 0.0, growth: float = 1.0, max_particles: int = 0,
                 device: str = "cpu"):
        if structure not in STRUCTURES:
            raise MethodError(f"sbml: structure is '{structure}'. {did_you_mean(structure, STRUCTURES)}")
        if features not in NAMES:
            raise MethodError(f"sbml: features are '{features}'. {did_you_mean(features, NAMES)}")
        for name, value, allowed, words in (
                ("validation", validation, 0.0 <= validation < 1.0, "a fraction from 0 to under 1"),
                ("noise_std", noise_std, noise_std > 0.0, "greater than 0"),
                ("networks", networks, networks >= 1, "at least 1"),
                ("common_std", common_std, common_std >= 0.0, "0 or greater"),
                ("reach", reach, 0.0 <= reach < np.inf, "0 or greater, in metres")):
            if not allowed:
                raise MethodError(f"sbml: {name} is {value!r}; it must be {words}.")
        self.structure, self.features, self.weights, self.prior, self.seed = structure, features, weights, prior, seed
        self.second, self.networks, self.common_std, self.reach = second, networks, common_std, reach
        self.rate, self.epochs, self.patience, self.dropout, self.output = rate, epochs, patience, dropout, output
        self.validation, self.fit_std, self.noise_std, self.device = validation, fit_std, noise_std, device
        self.shelf = ObjectShelf(VsfSettings(spacing, friction, noise_std, margin, table_height, "cpu",
                                             noise_share=noise_share, band=band, growth=growth,
                                             max_particles=max_particles))
        self._search = PoseSearch(seed=seed)
        self._priors: dict[int, GaussianPrior] = {}  # by object on the shelf, which keeps them alive
        self._normaliser: Normaliser | None = None
        self._trained: list[MetaPrior] = []
        self._level, self._naive = Level(), (0.0, 1.0)  # weights; naive mean [N/m] and variance [(N/m)^2]
        self._shares: Shares | None = None  # of the springs, and the noise of a reading; None without ``reach``
        self._width: Width | None = None  # of predicted readings; None for noise_std and noise_share
        self.training: list[Training] = []
        """How the training of each network went."""

    @property
    def trials_on_host(self) -> bool:
        """Whether adapting and predicting need no GPU, so that trials may be forks of a process without one."""
        return not self.features.startswith("dinov2")

    def meta_fit(self, specimens: Sequence[Specimen]) -> None:
        """Learn the prior from the training objects (eq. 15).

        Raises:
            MethodError: there is no training object, or none of their touches reached a particle.
        """
        self._priors.clear()
        if self.prior:
            self.load(Path(self.prior))
            return
        from vsfsim.vsf.meta.prior import train

        if not specimens:
            raise MethodError("sbml cannot learn a prior: there is no training object. Give a train split, or the "
                              "folder of a saved prior (--set prior=FOLDER).")
        shelf = self.shelf if self.device == "cpu" else ObjectShelf(replace(self.shelf.settings, device=self.device))
        models = [shelf.get(s.view) for s in specimens]
        raw = [self._features(model, s.view) for model, s in zip(models, specimens)]
        self._normaliser = Normaliser.of(raw)
        parts = [Composition.of(self.structure, self._normaliser(f)) for f in raw]
        fits = [self._fit(model, specimen) for model, specimen in zip(models, specimens)]
        spread = _spread(fits, parts)
        common = self.networks > 1 and self.structure == "HE" and self.common_std > 0.0
        known = [Composition.of("HE+HO", self._normaliser(f)) for f in raw] if common else parts
        tasks = [self._task(model, specimen, self._normaliser(f), part)
                 for model, specimen, f, part in zip(models, specimens, raw, known)]
        self._trained, self.training, self._shares, self._width, held_out, own = [], [], None, None, [], []
        for number, held in enumerate(self._held_out([object_of(s) for s in specimens])):
            seed = self.seed if number == 0 else int(np.random.SeedSequence(
                self.seed, spawn_key=(2, number)).generate_state(1)[0])
            network = self._build(raw[0].shape[1], spread, seed, self.common_std * spread.mean if common else 0.0)
            network.to(self.device)
            self.training.append(train(network, [t for i, t in enumerate(tasks) if i not in held],
                                       [t for i, t in enumerate(tasks) if i in held], rate=self.rate,
                                       epochs=self.epochs, patience=self.patience, seed=seed))
            self._trained.append(network)
            if self.networks > 1 and held:
                rest = _pooled([fit for i, fit in enumerate(fits) if i not in held])
                for i in sorted(held):
                    prior = network.of(self._normaliser(raw[i]), parts[i])
                    mean = prior.total_mean()
                    rows, z = models[i].stack(specimens[i].touches)
                    scale = pattern_scale(mean, self._near(models[i], specimens[i].view), rest.mean())
                    given = (mean, scale * mean, np.full(len(mean), rest.mean()))
                    held_out.append(Held(z, rows @ np.stack(given, axis=1)))
                    own.append((models[i], specimens[i], prior))
        self._level = Level.of(held_out) if held_out else Level()
        self._naive = spread.mean, spread.std**2
        self._trained = [network.cpu() for network in self._trained]
        if own and self.reach and self.structure == "HE":
            self._level = replace(self._level, std=0.0)
            self._shares = Shares.of([self._felt(*given) for given in own])
        if own:
            self._width = Width.of([one for given in own for one in self._missed(*given)])

    def adapt(self, view: View, support: Sequence[Reading]) -> None:
        """Prior from the view, then the support touches (eq. 16)."""
        if not self._trained or self._normaliser is None:
            raise MethodError("sbml has no prior yet; call meta_fit or load first.")
        model = self.shelf.get(view)
        if id(model) not in self._priors:
            features = self._normaliser(self._features(model, view))
            part = Composition.of(self.structure, features)
            found = [network.of(features, part) for network in self._trained]
            self._priors[id(model)] = found[0] if self.networks == 1 else self._blended(found, model, view)
        self._view = view
        self.posterior = Posterior.under(self._as_noisy(model), support, self._priors[id(model)])
        self.posterior.width = self._width

    def save(self, folder: Path) -> None:
        """Write the prior to a folder, which is made if missing."""
        if not self._trained or self._normaliser is None:
            raise MethodError("sbml has no prior to save yet; call meta_fit first.")
        weights = {f"{number}.{name}": value.cpu().numpy() for number, network in enumerate(self._trained)
                   for name, value in network.state_dict().items()}
        self._learned = {"mean": self._normaliser.mean, "std": self._normaliser.std, "naive": np.array(self._naive),
                         "unit": np.array(self._trained[0].unit), "level": np.array(astuple(self._level)),
                         "width": np.array(astuple(self._width) if self._width else ()),
                         "shares": np.array(astuple(self._shares) if self._shares else ()), **weights}
        super().save(folder)

    def load(self, folder: Path) -> None:
        """Read a prior that `save` wrote.

        Raises:
            MethodError: there is none, or it was learned with another structure or other features.
        """
        import torch

        from vsfsim.vsf.meta.prior import Spread

        super().load(folder)
        found = dict(self._learned)
        self._priors.clear()
        self._normaliser = Normaliser(found.pop("mean"), found.pop("std"))
        self._naive, unit = tuple(found.pop("naive").tolist()), float(found.pop("unit"))
        self._level, width = Level(*found.pop("level").tolist()), found.pop("width").tolist()
        self._width = Width(*width) if width else None
        self._shares = Shares(*shares) if (shares := found.pop("shares").tolist()) else None
        self._trained = []
        for number in dict.fromkeys(name.partition(".")[0] for name in found):
            network = self._build(len(self._normaliser.mean), Spread(unit, unit), self.seed)
            network.load_state_dict({name.partition(".")[2]: torch.as_tensor(value) for name, value in found.items()
                                     if name.startswith(f"{number}.")})
            self._trained.append(network)

    def _blended(self, priors: Sequence[GaussianPrior], model: ParticleModel, view: View) -> GaussianPrior:
        found = blended(priors, self._level, self._near(model, view), naive_mean=self._naive[0],
                        naive_var=self._naive[1])
        if self._shares is None:
            return found
        return self._shares.prior(found, model.knots(self.reach), self._naive[0])

    def _missed(self, model: ParticleModel, specimen: Specimen, prior: GaussianPrior) -> list[Missed]:
        """Readings of a training object under the prior of the one network that took no step on it: all before any
        touch, and the second half of them after the first."""
        blend, half = self._blended([prior], model, specimen.view), len(specimen.touches) // 2
        model = self._as_noisy(model)
        return [Posterior.under(model, specimen.touches[:k], blend).missed(specimen.touches[k:]) for k in (0, half)]

    def _as_noisy(self, model: ParticleModel) -> ParticleModel:
        """The same particles and rows, with the noise that was found. The model itself is shared between trainings."""
        if self._shares is None:
            return model
        return replace(model, settings=replace(model.settings, noise_std=self._shares.noise, noise_share=0.0))

    def _felt(self, model: ParticleModel, specimen: Specimen, prior: GaussianPrior) -> Felt:
        """All touches of a training object, in newtons as the noise of the settings, under the same prior."""
        rows, readings = model.plain(specimen.touches)
        force = OBSERVATIONS[specimen.touches[0].action.observation].force_per_unit
        return Felt.of(force * rows, force * readings, self._blended([prior], model, specimen.view),
                       model.knots(self.reach), self._naive[0])

    def _near(self, model: ParticleModel, view: View) -> np.ndarray:
        """Particles within two spacings of the visible surface, where touches reach (n,) bool."""
        far = 2.0 * self.shelf.settings.spacing
        tree = cKDTree(visible_cloud(view), compact_nodes=False)
        return tree.query(model.particles, distance_upper_bound=1.001 * far)[0] <= far

    def _build(self, size: int, spread: Spread, seed: int, level_std: float = 0.0) -> MetaPrior:
        import torch

        from vsfsim.vsf.meta.prior import MetaPrior

        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            return MetaPrior(size, shared=self.structure != "HE", spread=spread, dropout=self.dropout,
                             output=self.output, second=self.second, level_std=level_std)

    def _features(self, model: ParticleModel, view: View) -> np.ndarray:
        key = f"{self.features} {self.weights}"
        if key not in model.features:
            model.features[key] = particle_features(self.features, view, model.particles,
                                                    spacing=self.shelf.settings.spacing, weights=self.weights,
                                                    device=self.device)
        return model.features[key]

    def _task(self, model: ParticleModel, specimen: Specimen, features: np.ndarray, part: Composition) -> MetaTask:
        import torch

        from vsfsim.vsf.estimate.evidence import Evidence
        from vsfsim.vsf.meta.prior import MetaTask

        rows, z = model.stack(specimen.touches)
        counts = [int(t.valid.sum()) * t.action.size for t in specimen.touches]
        evidence = Evidence.of(rows, z, noise_std=self.shelf.settings.noise_std, membership=part.membership,
                               touch=np.repeat(np.arange(len(counts)), counts), device=self.device)
        own, of_part = (torch.as_tensor(np.asarray(x, np.float32), device=self.device)
                        for x in (features[evidence.touched], part.features))
        return MetaTask(own, of_part, evidence)

    def _fit(self, model: ParticleModel, specimen: Specimen) -> tuple[np.ndarray, np.ndarray]:
        """Particles that an object's touches moved (k,) int, and the spring constants fitted to them (k,) [N/m], as
        for the naive Gaussian prior (section 3.3, "initialisation")."""
        fit = Posterior.of(model, specimen.touches, prior_mean=0.0, prior_var=self.fit_std**2)
        touched = np.flatnonzero(fit.touched())
        return touched, fit.stiffness[touched]

    def _held_out(self, objects: Sequence[str]) -> list[set[int]]:
        """Which training views each network does not learn from; views of one object stay together, unless there is no
        other object."""
        if len(set(objects)) == 1:
            objects = [str(number) for number in range(len(objects))]
        names = list(dict.fromkeys(objects))
        if len(names) < 2 or self.validation == 0.0:
            return [set()]
        order = np.random.default_rng(np.random.SeedSequence(self.seed, spawn_key=(1,))).permutation(len(names))
        if self.networks > 1:
            parts = [order[start::min(self.networks, len(names))] for start in range(min(self.networks, len(names)))]
        else:
            parts = [order[:max(1, round(self.validation * len(names)))]]
        return [{i for i, name in enumerate(objects) if name in {names[k] for k in part}} for part in parts]


def object_of(specimen: Specimen) -> str:
    """The object of a view: its name without the number of the view."""
    return specimen.name.rpartition("-v")[0] or specimen.name


def _pooled(fits: Sequence[tuple[np.ndarray, np.ndarray]]) -> np.ndarray:
    return np.concatenate([np.zeros(0), *(values for _, values in fits)])


def _spread(fits: Sequence[tuple[np.ndarray, np.ndarray]], parts: Sequence[Composition]) -> Spread:
    """Statistics of the spring constants fitted to each training object."""
    from vsfsim.vsf.meta.prior import Spread

    values, means = _pooled(fits), []
    if values.size == 0 or values.std() == 0.0:
        raise MethodError(f"sbml cannot learn a prior: {len(fits)} training objects with {values.size} "
                          f"touched particles. Give a train split whose touches meet the objects.")
    for (touched, stiffness), part in zip(fits, parts):
        share = part.membership[touched]
        count = np.asarray(share.sum(axis=0)).ravel()
        means += list((share.T @ stiffness)[count > 0] / count[count > 0])
    return Spread(float(values.mean()), float(values.std()), float(np.std(means)) if len(means) > 1 else 0.0)
