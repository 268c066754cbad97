"""`surface-gp`: a Gaussian process over the surface, whose value is how force grows with depth (the process of
Rasmussen and Williams, Gaussian Processes for Machine Learning, 2006, with the coregionalised outputs of Alvarez et
al., Kernels for Vector-Valued Functions, 2012).

The force of a touch at x with axis a and depth d is F = w . phi(d) + noise of deviation s, phi as in `surface_touches`.
The two coefficients w have the mean M z(x, a) and the covariance

    cov(w(x, a), w(x', a')) = B (v_o + v_l exp(-|x - x'|^2 / 2 l^2 - |a - a'|^2 / 2 t^2) + v_n [same touch])

within an object, and none between objects: v_o is what a whole object is stiffer than others, v_l what neighbouring
places share, v_n what no place explains. B, M, v, l, t and s maximise the marginal likelihood of the training objects.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from vsfsim.baselines.converted import converted
from vsfsim.baselines.surface_touches import DEPTH, Projected, SurfaceView, functions, projected, single_number
from vsfsim.baselines.visible_cloud import LearnedArrays, one_thread
from vsfsim.bench.method import Action, Estimate, Reading, Specimen, check_support
from vsfsim.core.errors import MethodError, one_of
from vsfsim.data.records import View

_REACH, _TURN = 0.03, 0.5  # l [m] and t [-] at the start of the search
_STEPS = 60  # of the quasi-Newton search; the likelihood changes by less than 0.1 after 40 on twelve shoes
SHARED = {"both": (0.0, 0.0), "object": (0.0, -40.0), "place": (-40.0, 0.0), "none": (-40.0, -40.0)}
"""Logarithms of v_o and v_l at the start of the search. From -40 none comes back: the likelihood has no slope there."""
_LEAST = 1e-6  # v and the diagonal of B stay above this share of the forces' variance


@dataclass(frozen=True)
class _Object:
    """The touches of an object."""

    inputs: np.ndarray
    """Place [m] and axis [-] (n, 6)."""
    mean: np.ndarray
    """z (n, 3)."""
    factor: np.ndarray
    """R of every touch (n, 2, 2)."""
    value: np.ndarray
    """y (n, 2) [N]."""


@converted
class SurfaceGp(LearnedArrays):
    """A Gaussian process over the surface; settings come from the training objects.

    Args:
        shared: what a touch tells of others: "both", "object" (without v_l), "place" (without v_o) or "none".
    """

    _name = "surface-gp"

    def __init__(self, *, shared: str = "both"):
        self._off = SHARED[one_of(shared, SHARED, "surface-gp: shared", MethodError)]

    def meta_fit(self, specimens: Sequence[Specimen]) -> None:
        """Maximise the marginal likelihood of the training objects.

        Raises:
            MethodError: no training touch passes the visible surface, or a reading has more than one number.
        """
        import torch

        objects, rest, frames = [], 0.0, 0
        for specimen in specimens:
            single_number("surface-gp", (r.action for r in specimen.touches))
            view = SurfaceView(specimen.view)
            rows = [projected(view, reading) for reading in specimen.touches]
            if rows:
                objects.append(_object(view, rows, [r.action for r in specimen.touches]))
                rest, frames = rest + sum(r.rest for r in rows), frames + sum(max(r.frames - 2, 0) for r in rows)
        level = float(np.mean(np.concatenate([o.value.ravel() for o in objects]) ** 2)) if objects else 0.0
        if level == 0.0 or not any(o.factor.any() for o in objects):
            raise MethodError(f"surface-gp: no touch of the {len(specimens)} training objects passes the visible "
                              f"surface with a force. Give touches that meet the objects.")
        tensors = [[torch.as_tensor(a) for a in (o.inputs, o.mean, o.factor, o.value)] for o in objects]
        start = _start(self._off)
        asked = {name: torch.tensor(value, requires_grad=True) for name, value in start.items()}
        search = torch.optim.LBFGS(list(asked.values()), max_iter=_STEPS, line_search_fn="strong_wolfe",
                                   tolerance_change=1e-9)

        def closure() -> Any:
            search.zero_grad()
            noise = level * torch.exp(asked["noise"])
            loss = 0.5 * (frames * torch.log(noise) + rest / noise)
            for inputs, mean, factor, value in tensors:
                loss = loss + _misfit(asked, level, inputs, mean, factor, value)
            loss.backward()
            return loss

        with one_thread():
            search.step(closure)
        learned = {name: value.detach().numpy().copy() for name, value in asked.items()}
        if not all(np.isfinite(v).all() for v in learned.values()):
            raise MethodError("surface-gp: the search for the likeliest process ended at a number that is not finite; "
                              "are the training readings of a sensible size?")
        self._learned = {**learned, "level": np.array(level)}

    def adapt(self, view: View, support: Sequence[Reading]) -> None:
        """Condition the process on the support."""
        check_support(support)
        self._view = SurfaceView(view)
        rows = [projected(self._view, reading) for reading in support]
        self._known = known = _object(self._view, rows, [r.action for r in support])
        table = self._covariances(known.inputs, known.inputs, same=True)
        count = 2 * len(rows)
        inner = np.einsum("iab,ijbc,jdc->iajd", known.factor, table, known.factor).reshape(count, count)
        self._inner = np.linalg.cholesky(inner + self._noise * np.eye(count))
        left = known.value - np.einsum("iab,ib->ia", known.factor, self._means(known.mean))
        self._weights = self._solve(left.reshape(count)).reshape(len(rows), 2)

    def predict(self, touches: Sequence[Action]) -> list[np.ndarray]:
        """Readings (T, 1) of touches not made yet."""
        return [phi @ w[:, None] for phi, w, _ in self._answers(touches)]

    def predict_std(self, touches: Sequence[Action]) -> list[np.ndarray]:
        """Standard deviations (T, 1) of those readings."""
        return [np.sqrt(np.einsum("ta,ab,tb->t", phi, cov, phi) + self._noise)[:, None]
                for phi, _, cov in self._answers(touches)]

    def stiffness(self, points: np.ndarray) -> Estimate:
        """Force at a depth of 10 mm over that depth, pressed from above, at ``points`` (k, 3) [m]: (k,) [N/m]."""
        down = np.broadcast_to([0.0, 0.0, -1.0], points.shape)
        mean, covariance = self._posterior(np.concatenate([points, down], axis=1), _means_of(self._view, points, down))
        return Estimate(np.maximum(mean.sum(axis=1), 0.0) / DEPTH,
                        np.sqrt(np.maximum(covariance.sum(axis=(1, 2)), 0.0)) / DEPTH)

    @property
    def _noise(self) -> float:
        return float(self._learned["level"] * np.exp(self._learned["noise"]))

    def _answers(self, touches: Sequence[Action]) -> list[tuple[np.ndarray, np.ndarray, np.ndarray]]:
        single_number("surface-gp", touches)
        contacts = [self._view.contact(action) for action in touches]
        if not contacts:
            return []
        place, axis = np.stack([c.place for c in contacts]), np.stack([a.axis for a in touches])
        mean, covariance = self._posterior(np.concatenate([place, axis], axis=1), _means_of(self._view, place, axis))
        return [(functions(c.depth), w, v) for c, w, v in zip(contacts, mean, covariance)]

    def _posterior(self, inputs: np.ndarray, mean: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Means (k, 2) and covariances (k, 2, 2) of the coefficients at ``inputs`` (k, 6)."""
        between = np.einsum("ijab,jcb->iajc", self._covariances(inputs, self._known.inputs), self._known.factor)
        found = self._means(mean) + np.einsum("iajc,jc->ia", between, self._weights)
        flat = between.reshape(2 * len(inputs), -1)
        explained = np.einsum("iac,ibc->iab", flat.reshape(len(inputs), 2, -1),
                              self._solve(flat.T).T.reshape(len(inputs), 2, -1))
        own = np.stack([self._covariances(x[None], x[None], same=True)[0, 0] for x in inputs])
        return found, own - explained

    def _solve(self, right: np.ndarray) -> np.ndarray:
        return np.linalg.solve(self._inner.T, np.linalg.solve(self._inner, right))

    def _means(self, mean: np.ndarray) -> np.ndarray:
        return mean @ self._learned["slope"] * np.sqrt(self._learned["level"])

    def _covariances(self, a: np.ndarray, b: np.ndarray, *, same: bool = False) -> np.ndarray:
        """Of the coefficients at (n, 6) and (m, 6): (n, m, 2, 2)."""
        import torch

        asked = {name: torch.as_tensor(value) for name, value in self._learned.items()}
        return _covariance(asked, float(self._learned["level"]), torch.as_tensor(a), torch.as_tensor(b), same).numpy()


def _start(shares: tuple[float, float]) -> dict[str, np.ndarray]:
    """Unconstrained parameters: all in units of the forces' mean square."""
    return {"slope": np.zeros((3, 2)), "diagonal": np.zeros(2), "off": np.zeros(1), "shares": np.array([*shares, 0.0]),
            "reach": np.array(np.log(_REACH)), "turn": np.array(np.log(_TURN)), "noise": np.array(np.log(0.01))}


def _covariance(asked: dict[str, Any], level: float, a: Any, b: Any, same: bool) -> Any:
    import torch

    diagonal = torch.exp(0.5 * asked["diagonal"])
    root = torch.stack([torch.stack([diagonal[0], diagonal.new_zeros(())]),
                        torch.stack([asked["off"][0], diagonal[1]])])
    outputs = level * (root @ root.T + _LEAST * torch.eye(2, dtype=root.dtype))
    share = torch.softmax(asked["shares"], 0)
    scale = torch.cat([torch.exp(-asked["reach"]).expand(3), torch.exp(-asked["turn"]).expand(3)])
    away = ((a[:, None] - b[None]) * scale).square().sum(dim=2)
    places = share[0] + share[1] * torch.exp(-0.5 * away)
    if same:
        places = places + (share[2] + _LEAST) * torch.eye(len(a), dtype=places.dtype)
    return places[:, :, None, None] * outputs


def _misfit(asked: dict[str, Any], level: float, inputs: Any, mean: Any, factor: Any, value: Any) -> Any:
    """Minus the logarithm of the marginal likelihood of an object's projected readings, without its constant."""
    import torch

    count = 2 * len(value)
    table = _covariance(asked, level, inputs, inputs, True)
    inner = torch.einsum("iab,ijbc,jdc->iajd", factor, table, factor).reshape(count, count)
    noise = level * torch.exp(asked["noise"])
    root = torch.linalg.cholesky(inner + noise * torch.eye(count, dtype=inner.dtype))
    left = value - torch.einsum("iab,ib->ia", factor, mean @ asked["slope"] * level**0.5)
    scaled = torch.linalg.solve_triangular(root, left.reshape(count, 1), upper=False)
    return 0.5 * scaled.square().sum() + root.diagonal().log().sum()


def _object(view: SurfaceView, rows: Sequence[Projected], actions: Sequence[Action]) -> _Object:
    place = np.array([row.contact.place for row in rows]).reshape(-1, 3)
    axis = np.array([action.axis for action in actions]).reshape(-1, 3)
    return _Object(np.concatenate([place, axis], axis=1), _means_of(view, place, axis),
                   np.array([row.factor for row in rows]).reshape(-1, 2, 2),
                   np.array([row.value for row in rows]).reshape(-1, 2))


def _means_of(view: SurfaceView, place: np.ndarray, axis: np.ndarray) -> np.ndarray:
    """z (n, 3): a constant, the height over the size of the object, and how far the press goes down [-]."""
    height = (place[:, 2] - view.foot[2]) / max(view.size, 1e-9)
    return np.stack([np.ones(len(place)), height, -axis[:, 2]], axis=1)
