"""`sbml`: structured Bayesian meta-learning on the VSF model (SBML, eq. 10-16, appendices A and B).

A small network maps visual features of the particles to the mean and variance of their spring constants. It is learned
offline on the training objects by maximum likelihood of their readings, with the springs marginalised out (eq. 15). On
a new object the network's output is the prior, and touches update it (eq. 16, K >= 0).
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from vsfsim.baselines.particle_model import ObjectShelf, ParticleModel, VsfSettings
from vsfsim.baselines.posterior import Posterior, PosteriorAnswers
from vsfsim.bench.method import Reading, Specimen
from vsfsim.core.errors import MethodError, did_you_mean
from vsfsim.data.records import View
from vsfsim.vsf.features.interface import Normaliser
from vsfsim.vsf.features.registry import NAMES, particle_features
from vsfsim.vsf.meta.composition import STRUCTURES, Composition, GaussianPrior


class Sbml(PosteriorAnswers):
    """SBML with a prior learned by `meta_fit`.

    Args:
        structure: HE, HE+HO or HE+SEG (section 4.5).
        features: local, local-thick, local-full, xyzrgb, dinov2-s or dinov2-b, see `vsfsim.vsf.features.registry`.
        weights: file of pretrained weights for the DINOv2 features; "" looks in the usual caches.
        prior: folder that `save` wrote, to use instead of learning from the training objects; "" learns.
        seed: of the initial weights, the order of training, dropout and the validation objects.
        rate, epochs, patience, dropout, output, second: of the training, see `vsfsim.vsf.meta.prior`.
        validation: fraction of the training objects that are used for early stopping only (at least one of two or
            more).
        spacing: distance of the particles [m] (appendix B.2: 5 mm for shoes, 10 mm for plants).
        friction: Coulomb coefficient of the stick-slip motion [-].
        noise_std: of a reading, in its unit. The error of the particle model is some newtons and common to a whole
            touch, while eq. 15 treats its ten readings as independent; 3 N is 1 N times sqrt(10). docs/methods.md has
            figures.
        noise_share: fraction of a touch's largest reading by which the particle model errs besides (in eq. 15 and 16).
            With 0, as in the paper, stiff objects determine the mean, which then lies far above most objects;
            docs/studies.md has figures.
        fit_std: prior standard deviation of a spring constant in the fits that give the initial uncertainty [N/m].
        margin: widening of the box around the visible cloud [m].
        table_height: z of the table the object stands on [m].
        band: particles further from every visible point are left out [m]; 0 keeps the whole hidden volume.
        device: "cpu" or "cuda:0", for Warp and torch.
    """

    def __init__(self, *, structure: str = "HE", features: str = "local", weights: str = "", prior: str = "",
                 seed: int = 0, rate: float = 1e-4, epochs: int = 400, patience: int = 40, dropout: float = 0.1,
                 output: str = "softplus", second: str = "std", validation: float = 0.25, spacing: float = 0.005,
                 friction: float = 0.0, noise_std: float = 3.0, noise_share: float = 0.0, fit_std: float = 1000.0,
                 margin: float = 0.01, table_height: float = 0.0, band: float = 0.0, device: str = "cpu"):
        if structure not in STRUCTURES:
            raise MethodError(f"sbml: structure is '{structure}'. {did_you_mean(structure, STRUCTURES)}")
        if features not in NAMES:
            raise MethodError(f"sbml: features are '{features}'. {did_you_mean(features, NAMES)}")
        if not 0.0 <= validation < 1.0:
            raise MethodError(f"sbml: validation is {validation!r}; it must be a fraction from 0 to under 1.")
        if not (noise_std > 0.0 and noise_share >= 0.0):
            raise MethodError(f"sbml: noise_std is {noise_std!r} (greater than 0) and noise_share {noise_share!r} (0 "
                              f"or greater).")
        self.structure, self.features, self.weights, self.prior, self.seed = structure, features, weights, prior, seed
        self.second = second
        self.rate, self.epochs, self.patience, self.dropout, self.output = rate, epochs, patience, dropout, output
        self.validation, self.fit_std, self.noise_std, self.device = validation, fit_std, noise_std, device
        self.shelf = ObjectShelf(VsfSettings(spacing, friction, noise_std, margin, table_height, device,
                                             noise_share=noise_share, band=band))
        self._search_seed = seed
        self._priors: dict[int, GaussianPrior] = {}  # by object on the shelf, which keeps them alive
        self._normaliser: Normaliser | None = None
        self._network = None

    def meta_fit(self, specimens: Sequence[Specimen]) -> None:
        """Learn the prior from the training objects (eq. 15).

        Raises:
            MethodError: there is no training object, or none of their touches reached a particle.
        """
        self._priors.clear()
        if self.prior:
            self.load(Path(self.prior))
            return
        from vsfsim.vsf.meta.prior import MetaPrior, train

        if not specimens:
            raise MethodError("sbml cannot learn a prior: there is no training object. Give a train split, or the "
                              "folder of a saved prior (--set prior=FOLDER).")
        models = [self.shelf.get(s.view) for s in specimens]
        raw = [self._features(model, s.view) for model, s in zip(models, specimens)]
        self._normaliser = Normaliser.of(raw)
        parts = [Composition.of(self.structure, self._normaliser(f)) for f in raw]
        spread = self._spread(models, specimens, parts)
        tasks = [self._task(*row) for row in zip(models, specimens, raw, parts)]
        held = self._held_out(len(tasks))
        self._network = self._build(MetaPrior, raw[0].shape[1], spread)
        self.training = train(self._network, [t for i, t in enumerate(tasks) if i not in held],
                              [t for i, t in enumerate(tasks) if i in held],
                              rate=self.rate, epochs=self.epochs, patience=self.patience, seed=self.seed)

    def adapt(self, view: View, support: Sequence[Reading]) -> None:
        """Prior from the view, then the support touches (eq. 16)."""
        if self._network is None or self._normaliser is None:
            raise MethodError("sbml has no prior yet; call meta_fit or load first.")
        model = self.shelf.get(view)
        if id(model) not in self._priors:
            features = self._normaliser(self._features(model, view))
            self._priors[id(model)] = self._network.of(features, Composition.of(self.structure, features))
        self._view = view
        self.posterior = Posterior.under(model, support, self._priors[id(model)])

    def share(self, other: Sbml) -> None:
        """Use the particles, rows and features of ``other``, which has the same settings."""
        self.shelf = other.shelf

    def save(self, folder: Path) -> None:
        """Write the prior to a folder, which is made if missing: prior.json, and prior.npz with the weights."""
        if self._network is None or self._normaliser is None:
            raise MethodError("sbml has no prior to save yet; call meta_fit first.")
        table = {"structure": self.structure, "features": self.features, "output": self.output, "second": self.second,
                 "size": len(self._normaliser.mean), "unit": self._network.unit}
        folder.mkdir(parents=True, exist_ok=True)
        (folder / "prior.json").write_text(json.dumps(table, indent=1) + "\n")
        np.savez(folder / "prior.npz", mean=self._normaliser.mean, std=self._normaliser.std,
                 **{f"net.{name}": value.cpu().numpy() for name, value in self._network.state_dict().items()})

    def load(self, folder: Path) -> None:
        """Read a prior that `save` wrote.

        Raises:
            MethodError: there is none, or it was learned with another structure or other features.
        """
        import torch

        from vsfsim.vsf.meta.prior import MetaPrior, Spread

        try:
            table = json.loads((folder / "prior.json").read_text())
            with np.load(folder / "prior.npz") as file:
                arrays = dict(file)
        except (OSError, ValueError) as error:
            raise MethodError(f"sbml: no prior can be read from '{folder}': {error}. Give a folder that "
                              f"`save` wrote.") from error
        table.setdefault("second", "std")  # of a folder that is older than this parameter
        for key in ("structure", "features", "output", "second"):
            if table.get(key) != getattr(self, key):
                raise MethodError(f"sbml: the prior in '{folder}' was learned with {key} '{table.get(key)}', not "
                                  f"'{getattr(self, key)}'. Give --set {key}={table.get(key)}.")
        self._priors.clear()
        self._normaliser = Normaliser(arrays.pop("mean"), arrays.pop("std"))
        self._network = self._build(MetaPrior, table["size"], Spread(table["unit"], table["unit"]))
        self._network.load_state_dict({name.removeprefix("net."): torch.as_tensor(value) for name,
                                       value in arrays.items()})

    def _build(self, kind: type, size: int, spread):
        import torch

        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(self.seed)
            return kind(size, shared=self.structure != "HE", spread=spread, dropout=self.dropout,
                        output=self.output, second=self.second).to(self.device)

    def _features(self, model: ParticleModel, view: View) -> np.ndarray:
        key = f"{self.features} {self.weights}"
        if key not in model.features:
            model.features[key] = particle_features(self.features, view, model.particles,
                                                    spacing=self.shelf.settings.spacing, weights=self.weights,
                                                    device=self.device)
        return model.features[key]

    def _task(self, model: ParticleModel, specimen: Specimen, raw: np.ndarray, part: Composition):
        import torch

        from vsfsim.vsf.estimate.evidence import Evidence
        from vsfsim.vsf.meta.prior import MetaTask

        rows, z = model.stack(specimen.touches)
        counts = [int(t.valid.sum()) * t.action.size for t in specimen.touches]
        evidence = Evidence.of(rows, z, noise_std=self.shelf.settings.noise_std, membership=part.membership,
                               touch=np.repeat(np.arange(len(counts)), counts), device=self.device)
        features = self._normaliser(raw)[evidence.touched]
        return MetaTask(*(torch.as_tensor(np.asarray(x, np.float32), device=self.device)
                          for x in (features, part.features)), evidence)

    def _spread(self, models: Sequence[ParticleModel], specimens: Sequence[Specimen], parts: Sequence[Composition]):
        """Spread of the spring constants fitted to each training object, as in the naive Gaussian prior (section 3.3,
        "initialisation")."""
        from vsfsim.vsf.meta.prior import Spread

        pooled, means = [np.zeros(0)], []
        for model, specimen, part in zip(models, specimens, parts):
            fit = Posterior.of(model, specimen.touches, prior_mean=0.0, prior_var=self.fit_std**2)
            touched = fit.touched()
            pooled.append(fit.stiffness[touched])
            share = part.membership[np.flatnonzero(touched)]
            count = np.asarray(share.sum(axis=0)).ravel()
            means += list((share.T @ fit.stiffness[touched])[count > 0] / count[count > 0])
        values = np.concatenate(pooled)
        if values.size == 0 or values.std() == 0.0:
            raise MethodError(f"sbml cannot learn a prior: {len(specimens)} training objects with {values.size} "
                              f"touched particles. Give a train split whose touches meet the objects.")
        return Spread(float(values.mean()), float(values.std()), float(np.std(means)) if len(means) > 1 else 0.0)

    def _held_out(self, count: int) -> set[int]:
        if count < 2 or self.validation == 0.0:
            return set()
        order = np.random.default_rng(np.random.SeedSequence(self.seed, spawn_key=(1,))).permutation(count)
        return {int(i) for i in order[:max(1, round(self.validation * count))]}
