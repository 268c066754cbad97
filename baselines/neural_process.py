"""`cnp`: a conditional neural process over touches of a surface (Garnelo et al., Conditional Neural Processes, 2018).

A touch is described by what vision tells of its place (`features`, position, axis) and by two coefficients of its force
over depth (`surface_touches`). One network encodes each touch of the support; their mean, and their mean weighted by
nearness to the place that is asked, go with the description of the query into a second network, whose two outputs are
the query's coefficients. Both are trained together on random supports of the training objects, and several such pairs
of networks are averaged.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from vsfsim.baselines.converted import converted
from vsfsim.baselines.surface_touches import SurfaceView, functions, projected, single_number
from vsfsim.baselines.visible_cloud import LearnedArrays, one_thread
from vsfsim.bench.method import Action, Reading, Specimen, check_support
from vsfsim.core.errors import MethodError, did_you_mean
from vsfsim.data.records import View
from vsfsim.vsf.features.registry import NAMES, particle_features

_SPACING = 0.005  # pixels within this of a place describe it [m]
_CLIP = 4.0  # standardised descriptions stay within this many deviations: a test object may lie far outside


@converted
class NeuralProcess(LearnedArrays):
    """A conditional neural process over touches.

    Args:
        features: of a touched place; a name of `vsfsim.vsf.features.registry`.
        weights: file of pretrained weights, for features of DINOv2.
        hidden: width of the networks.
        steps: of Adam, each on one random support of every training object.
        rate: of Adam.
        decay: of the weights, in place of a test on objects kept back.
        networks: pairs of networks, of which the mean counts.
        reach: at which the nearness of a touch starts in training [m].
        spread: of the logarithm of a factor on all forces of a training object, drawn for every support: a few objects
            would not teach that a touch tells how stiff the others are.
        seed: of the networks and supports.
        device: "cpu" or "cuda:0", where the networks are trained.
    """

    _name = "cnp"

    def __init__(self, *, features: str = "local", weights: str = "", hidden: int = 64, steps: int = 800,
                 rate: float = 1e-3, decay: float = 0.1, networks: int = 2, reach: float = 0.03, spread: float = 1.0,
                 seed: int = 0, device: str = "cpu"):
        if features not in NAMES:
            raise MethodError(f"cnp: features are '{features}'. {did_you_mean(features, NAMES)}")
        if min(hidden, steps, networks) < 1 or rate <= 0.0 or reach <= 0.0 or min(decay, spread) < 0.0:
            raise MethodError(f"cnp: hidden {hidden}, steps {steps} and networks {networks} must be at least 1, rate "
                              f"{rate:g} and reach {reach:g} positive, decay {decay:g} and spread {spread:g} not "
                              f"negative.")
        self.features, self.weights, self.hidden, self.steps, self.rate = features, weights, hidden, steps, rate
        self.decay, self.networks, self.reach, self.spread = decay, networks, reach, spread
        self.seed, self.device = seed, device

    def meta_fit(self, specimens: Sequence[Specimen]) -> None:
        """Train the networks.

        Raises:
            MethodError: no training object has two touches with a force, or the weights end at no finite number.
        """
        usable = [s for s in specimens if len(s.touches) >= 2]
        for specimen in usable:
            single_number("cnp", (r.action for r in specimen.touches))
        rows = [self._touches(SurfaceView(s.view), s.touches) for s in usable]
        force = np.concatenate([y[:, :2].ravel() for _, y in rows]) if rows else np.zeros(0)
        if not force.any():
            raise MethodError(f"cnp cannot be trained: of {len(specimens)} training objects none has two touches that "
                              f"press into the visible surface.")
        x = np.concatenate([x for x, _ in rows])
        state = {"mean": x.mean(axis=0), "std": np.maximum(x.std(axis=0), 1e-6),
                 "scale": np.array(np.sqrt(np.mean(force**2)))}
        longest = max(len(x) for x, _ in rows)
        inputs, outputs, there = (np.zeros((len(rows), longest, *shape)) for shape in ((x.shape[1],), (6,), ()))
        for k, (a, b) in enumerate(rows):
            inputs[k, :len(a)], there[k, :len(a)] = _standard(state, a), 1.0
            outputs[k, :len(a)] = b / state["scale"]
            outputs[k, :len(a), 2:] = b[:, 2:]  # R has no unit
        with one_thread():
            for k in range(self.networks):
                state |= self._train(k, inputs, outputs, there)
        if not all(np.isfinite(value).all() for value in state.values()):
            raise MethodError("cnp diverged in training: its weights are not finite. Lower the rate.")
        self._learned = state

    def adapt(self, view: View, support: Sequence[Reading]) -> None:
        """Keep the touches of the support."""
        check_support(support)
        self._view = SurfaceView(view)
        x, y = self._touches(self._view, support)
        self._x, self._y = _standard(self._learned, x), y
        self._y[:, :2] /= self._learned["scale"]

    def predict(self, touches: Sequence[Action]) -> list[np.ndarray]:
        """Readings (T, 1) of touches not made yet."""
        import torch

        single_number("cnp", touches)
        if not touches:
            return []
        contacts = [self._view.contact(action) for action in touches]
        asked = _standard(self._learned, self._describe(self._view, np.stack([c.place for c in contacts]),
                                                      np.stack([a.axis for a in touches])))
        given = torch.ones(1, 1, len(self._x), dtype=torch.float64)
        support = torch.as_tensor(self._x)[None], torch.as_tensor(self._y)[None], given
        with torch.no_grad():
            found = sum(_answer(self._weights_of(k), *support, torch.as_tensor(asked)[None])[0]
                        for k in range(self.networks)).numpy() / self.networks
        return [functions(c.depth) @ w[:, None] * self._learned["scale"] for c, w in zip(contacts, found)]

    def _weights_of(self, k: int) -> dict[str, Any]:
        import torch

        start = f"{k}."
        return {name.removeprefix(start): torch.as_tensor(value) for name, value in self._learned.items()
                if name.startswith(start)}

    def _touches(self, view: SurfaceView, readings: Sequence[Reading]) -> tuple[np.ndarray, np.ndarray]:
        """Descriptions (n, p), and y and R of each touch (n, 2 + 4)."""
        rows = [projected(view, reading) for reading in readings]
        y = np.array([[*row.value, *row.factor.ravel()] for row in rows]).reshape(-1, 6)
        return self._describe(view, np.array([row.contact.place for row in rows]).reshape(-1, 3),
                              np.array([r.action.axis for r in readings]).reshape(-1, 3)), y

    def _describe(self, view: SurfaceView, place: np.ndarray, axis: np.ndarray) -> np.ndarray:
        """Place over the size of the object, place [m], axis, and what vision tells there (n, p)."""
        if len(place) == 0:
            return np.zeros((0, len(self._learned["mean"])))
        seen = particle_features(self.features, view.view, place, spacing=_SPACING, weights=self.weights)
        return np.concatenate([(place - view.foot) / max(view.size, 1e-9), place, axis, seen], axis=1)

    def _train(self, k: int, inputs: np.ndarray, outputs: np.ndarray, there: np.ndarray) -> dict[str, np.ndarray]:
        import torch

        generator = torch.Generator().manual_seed(int(np.random.SeedSequence([self.seed, k]).generate_state(1)[0]))
        x, read, known = (torch.as_tensor(a, device=self.device) for a in (inputs, outputs, there))
        theta = {name: value.to(self.device).requires_grad_(True)
                 for name, value in _weights(x.shape[2], self.hidden, self.reach, generator).items()}
        adam = torch.optim.AdamW(list(theta.values()), lr=self.rate, weight_decay=self.decay)
        fall = torch.optim.lr_scheduler.CosineAnnealingLR(adam, self.steps)
        count = known.sum(dim=1)
        factor = read[:, :, 2:].reshape(*read.shape[:2], 2, 2)
        for _ in range(self.steps):
            adam.zero_grad()
            stiffer = torch.exp(self.spread * torch.randn(len(x), 1, 1, generator=generator, dtype=torch.float64))
            y = torch.cat([read[:, :, :2] * stiffer.to(x.device), read[:, :, 2:]], dim=2)
            # a support of 0 to n - 1 touches, every size as likely
            size = torch.floor(torch.rand(len(x), generator=generator, dtype=torch.float64).to(x.device) * count)
            order = torch.rand(known.shape, generator=generator, dtype=torch.float64).to(x.device) + 2.0 * (1.0 - known)
            given = (order.argsort(dim=1).argsort(dim=1) < size[:, None]).double() * known
            answer = _answer(theta, x, y, given[:, None].expand(-1, x.shape[1], -1), x)
            off = (torch.einsum("oiab,oib->oia", factor, answer) - y[:, :, :2]).square().sum(dim=2)
            query = known - given
            norm = (y[:, :, :2].square().sum(dim=2) * known).sum(dim=1) / count
            (((off * query).sum(dim=1) / query.sum(dim=1)) / norm.clamp(min=1e-12)).mean().backward()
            adam.step()
            fall.step()
        return {f"{k}.{name}": value.detach().cpu().numpy() for name, value in theta.items()}


def _standard(state: dict[str, np.ndarray], x: np.ndarray) -> np.ndarray:
    return np.clip((x - state["mean"]) / state["std"], -_CLIP, _CLIP)


def _weights(inputs: int, hidden: int, reach: float, generator: Any) -> dict[str, Any]:
    """Of both networks, and the logarithm of the nearness (in standardised places, of about 0.1 m)."""
    import torch

    def layer(rows: int, columns: int) -> Any:
        return torch.randn(rows, columns, generator=generator, dtype=torch.float64) / np.sqrt(rows)

    zero = torch.zeros(hidden, dtype=torch.float64)
    return {"e1": layer(inputs + 6, hidden), "f1": zero.clone(), "e2": layer(hidden, hidden), "f2": zero.clone(),
            "d1": layer(inputs + 2 * hidden + 2, hidden), "g1": zero.clone(), "d2": layer(hidden, hidden),
            "g2": zero.clone(), "d3": 0.1 * layer(hidden, 2), "g3": torch.zeros(2, dtype=torch.float64),
            "near": torch.tensor(np.log(reach / 0.1), dtype=torch.float64)}


def _answer(theta: dict[str, Any], x: Any, y: Any, given: Any, asked: Any) -> Any:
    """Coefficients (o, m, 2) at the queries ``asked`` (o, m, p), from touches ``x`` (o, n, p) with readings ``y``
    (o, n, 6) of which ``given`` (o, m or 1, n) count."""
    import torch

    code = torch.relu(torch.cat([x, y], dim=2) @ theta["e1"] + theta["f1"]) @ theta["e2"] + theta["f2"]
    given = given.expand(-1, asked.shape[1], -1)
    away = (asked[:, :, None, 3:6] - x[:, None, :, 3:6]).square().sum(dim=3) * torch.exp(-2.0 * theta["near"])
    near = given * torch.exp(-0.5 * away)
    whole, close = given.sum(dim=2, keepdim=True), near.sum(dim=2, keepdim=True)
    decoder = torch.cat([asked, given @ code / (whole + 1.0), near @ code / (close + 0.1), whole / (whole + 1.0),
                         close / (close + 0.1)], dim=2)
    inner = torch.relu(decoder @ theta["d1"] + theta["g1"])
    return torch.relu(inner @ theta["d2"] + theta["g2"]) @ theta["d3"] + theta["g3"]
