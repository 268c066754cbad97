"""`imaml` and `imaml-vision`: non-structured meta-learning (SBML section 4.2 and appendix B.4).

A perceptron maps the robot's action to the reading without a model of the object. The touches of an object adapt its
weights by a few steps of gradient descent from the meta-learned start. `imaml-vision` also receives one vector of the
whole view. The network, the inner and the outer loop have the paper's sizes and rates. The paper's action is 7 joint
angles. Without an arm it is 7 numbers here too: the probe's position, its press direction, and its distance along it.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from vsfsim.baselines.converted import converted
from vsfsim.baselines.visible_cloud import LearnedArrays, digest, one_thread
from vsfsim.bench.method import Action, Reading, Specimen, check_support
from vsfsim.core.errors import MethodError, did_you_mean
from vsfsim.data.records import View
from vsfsim.vsf.features.registry import NAMES, view_token

if TYPE_CHECKING:  # torch is imported where it is used
    import torch

    from vsfsim.baselines.implicit_maml import Network

HIDDEN = (32, 128, 64, 32, 16)
ENCODER = (64, 7)
PRECISIONS = ("float64", "float32")


@converted
class Imaml(LearnedArrays):
    """iMAML without vision.

    Args:
        seed: of the initial weights and of the division of training objects into support and query.
        epochs: passes over the training objects.
        tasks_per_step: training objects of one outer step; 0 for all, which makes one step an epoch. With 1 an epoch
            has as many steps as there are objects (L), each on one of them, in random order.
        outer_rate: of Adam.
        inner_rate, inner_steps: of the gradient descent on the support touches.
        regularisation: lambda.
        cg_damping, cg_steps: of the implicit gradient.
        features: of the view's vector, for `imaml-vision`. weights: file of pretrained weights for the DINOv2 features.
        device: torch device of the training and of the DINOv2 features; touches adapt on the host, where trials can
            be forks. Random numbers are drawn on the host, so that they are the same for every device.
        precision: "float64" or "float32", which takes about half the time where an object has thousands of readings.
    """

    _name, _vision = "imaml", False

    def __init__(self, *, seed: int = 0, epochs: int = 400, tasks_per_step: int = 0, outer_rate: float = 1e-3,
                 inner_rate: float = 1e-3, inner_steps: int = 30, regularisation: float = 2.0,
                 cg_damping: float = 100.0, cg_steps: int = 10, features: str = "local", weights: str = "",
                 device: str = "cpu", precision: str = "float64"):
        if features not in NAMES:
            raise MethodError(f"imaml: features are '{features}'. {did_you_mean(features, NAMES)}")
        if precision not in PRECISIONS:
            raise MethodError(f"imaml: precision is '{precision}'. {did_you_mean(precision, PRECISIONS)}")
        if tasks_per_step < 0:
            raise MethodError(f"imaml: tasks_per_step is {tasks_per_step!r}; it must be a number of training objects, "
                              f"or 0 for all.")
        self.tasks_per_step, self.precision = tasks_per_step, precision
        self.seed, self.epochs, self.outer_rate = seed, epochs, outer_rate
        self.inner_rate, self.inner_steps = inner_rate, inner_steps
        self.regularisation, self.cg_damping, self.cg_steps = regularisation, cg_damping, cg_steps
        self.features, self.weights, self.device = features, weights, device
        self._tokens: dict[bytes, np.ndarray] = {}  # by view: every shot and seed has the same views
        self._at = "cpu"  # device of batches

    @property
    def trials_on_host(self) -> bool:
        """Whether adapting and predicting need no GPU, so that trials may be forks of a process without one."""
        return not (self._vision and self.features.startswith("dinov2"))

    def meta_fit(self, specimens: Sequence[Specimen]) -> None:
        """Learn the start of all adaptations.

        Raises:
            MethodError: there is no training object with two touches, or the readings never vary.
        """
        import torch

        from vsfsim.baselines import implicit_maml as im

        usable = [s for s in specimens if len(s.touches) >= 2]
        if not usable:
            raise MethodError(f"imaml cannot be trained: of {len(specimens)} training objects none has the two touches "
                              f"that make a support and a query set.")
        rows = [[_samples(reading) for reading in s.touches] for s in usable]
        tokens = [self._token(s.view) for s in usable]
        x, y = (np.concatenate([touch[k] for touches in rows for touch in touches]) for k in (0, 1))
        token = np.stack(tokens)
        if not np.isfinite(y).all():
            raise MethodError("imaml: a training reading in a frame marked valid is not finite.")
        if not (y.std(axis=0) > 0.0).all():
            raise MethodError("imaml cannot be trained: the training readings never vary. Give touches that meet "
                              "the objects.")
        scale = {"x_mean": x.mean(axis=0), "x_std": np.maximum(x.std(axis=0), 1e-6), "y_std": y.std(axis=0),
                 "token_mean": token.mean(axis=0), "token_std": np.maximum(token.std(axis=0), 1e-3)}
        self._learned = scale
        start = self._network.start(torch.Generator().manual_seed(self.seed), dtype=self._real())
        self._at = self.device
        theta = start.to(self.device).requires_grad_(True)
        rng = np.random.default_rng(np.random.SeedSequence(self.seed))
        table = self._table([samples for touches in rows for samples in touches])
        first = np.cumsum([0, *(len(touches) for touches in rows)])
        optimiser = torch.optim.Adam([theta], lr=self.outer_rate)
        with one_thread():
            for _ in range(self.epochs):
                for step in self._steps(len(rows), rng):
                    halves = [self._halves(first[i], first[i + 1], rng) for i in step]
                    token = self._view_rows([tokens[i] for i in step])
                    support, query = (table.batch([half[k] for half in halves], token) for k in (0, 1))
                    phi = im.adapt(self._network, theta, support, rate=self.inner_rate, steps=self.inner_steps,
                                   regularisation=self.regularisation)
                    theta.grad = im.implicit_gradient(
                        self._network, phi, support, query, steps=self.cg_steps, regularisation=self.regularisation,
                        damping=self.cg_damping).mean(dim=0)
                    optimiser.step()
        self._at = "cpu"
        if not torch.isfinite(theta).all():
            raise MethodError("imaml diverged in training: its weights are no longer finite. Lower outer_rate or "
                              "inner_rate.")
        self._learned = {**scale, "theta": theta.detach().cpu().numpy()}

    def adapt(self, view: View, support: Sequence[Reading]) -> None:
        """Gradient descent on the support touches, from the meta-learned start."""
        from vsfsim.baselines import implicit_maml as im

        check_support(support)
        self._view_token = self._token(view)
        none = np.zeros((0, len(self._learned["x_mean"]))), np.zeros((0, len(self._learned["y_std"])))
        table = self._table([none, *(_samples(reading) for reading in support)])
        batch = table.batch([np.arange(len(support) + 1)], self._view_rows([self._view_token]))
        self._phi = im.adapt(self._network, self._theta, batch, rate=self.inner_rate, steps=self.inner_steps,
                             regularisation=self.regularisation)

    def predict(self, touches: Sequence[Action]) -> list[np.ndarray]:
        """Readings (T, d) of touches not made yet."""
        import torch

        out, token = [], self._view_rows([self._view_token])
        for action in touches:
            x = (_inputs(action) - self._learned["x_mean"]) / self._learned["x_std"]
            with torch.no_grad():
                answer = self._network(self._phi, torch.as_tensor(x, dtype=self._real())[None], token)[0]
            out.append(answer.double().cpu().numpy() * self._learned["y_std"])
        return out

    @property
    def _network(self) -> Network:
        from vsfsim.baselines.implicit_maml import Network

        sizes = {name: len(value) for name, value in self._learned.items()}
        return Network(sizes["x_mean"], sizes["y_std"], token=sizes["token_mean"], hidden=HIDDEN, encoder=ENCODER)

    @property
    def _theta(self) -> torch.Tensor:
        """The start of all adaptations (P,)."""
        import torch

        return torch.as_tensor(self._learned["theta"], dtype=self._real())

    def _token(self, view: View) -> np.ndarray:
        if not self._vision:
            return np.zeros(0)
        key = digest(view.rgb, view.depth, view.mask, view.intrinsics, view.camera_pose)
        if key not in self._tokens:
            self._tokens[key] = view_token(self.features, view, weights=self.weights,
                                           device=self.device).astype(np.float64)
        return self._tokens[key]

    def _steps(self, count: int, rng: np.random.Generator) -> list[np.ndarray]:
        """The training objects of each outer step of an epoch."""
        if self.tasks_per_step == 0:
            return [np.arange(count)]
        order = rng.permutation(count)
        return [order[start:start + self.tasks_per_step] for start in range(0, count, self.tasks_per_step)]

    def _halves(self, first: int, end: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
        """Numbers of a training object's touches (``first`` to ``end``), divided at random into support (at least one
        touch) and query (at least one)."""
        order = first + rng.permutation(end - first)
        cut = int(rng.integers(1, end - first))
        return order[:cut], order[cut:]

    def _table(self, touches: Sequence[tuple[np.ndarray, np.ndarray]]):
        """The samples of touches, standardised, where the network is."""
        from vsfsim.baselines.implicit_maml import Table

        s = self._learned
        return Table([((x - s["x_mean"]) / s["x_std"], y / s["y_std"]) for x, y in touches], self._real(), self._at)

    def _view_rows(self, tokens: Sequence[np.ndarray]):
        """Standardised vectors of views (B, c), as a tensor where the network is."""
        import torch

        token = np.clip((np.stack(tokens) - self._learned["token_mean"]) / self._learned["token_std"], -6.0, 6.0)
        return torch.as_tensor(token, dtype=self._real(), device=self._at)

    def _real(self):
        import torch

        return getattr(torch, self.precision)


class ImamlVision(Imaml):
    """iMAML whose network also receives one vector of the view (SBML: DINOv2's class token)."""

    _name, _vision, _settings = "imaml-vision", True, ("features",)


def _inputs(action: Action) -> np.ndarray:
    """The action as 7 numbers a frame (T, 7): an arm's joint angles [rad] (SBML appendix B.4); without an arm the
    position [m], the press direction, and the distance along it since the first frame [m]."""
    if action.q is not None:
        return action.q
    position = action.poses[:, :3, 3]
    along = (position - position[:1]) @ action.axis
    return np.concatenate([position, np.broadcast_to(action.axis, position.shape), along[:, None]], axis=1)


def _samples(reading: Reading) -> tuple[np.ndarray, np.ndarray]:
    return _inputs(reading.action)[reading.valid], np.asarray(reading.value[reading.valid], np.float64)
