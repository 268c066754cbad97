"""The continuous VSF: stiffness as a function of position, fitted to dense contact forces (Neural VSF section III-D).

The force on a vertex that has come along its way v(tau) up to time t is a line integral over what it swept (eq. 5),

    f(t) = sum_i -K(v(tau_i)) (v(t) - v(tau_i)) s(tau_i) . dv(tau_i)

with s its oriented area: linear in the values of K at known points. A field is fitted by minimising eq. 6, the sum of |f - f_hat| over a
batch of B observations plus a free-space term lambda * mean K at random points of the volume, with Adam.

Two fields share all of this: `NerfField`, the papers' (sinusoidal encoding, 8 layers, a skip), and `GridField`, ours: a sum of trilinear grids
of rising resolution, which needs a few dozen operations a point instead of tens of thousands.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import nn
from torch.nn import functional

from vsfsim.vsf.dynamics import VsfError
from vsfsim.vsf.palpation import DenseTouch, oriented_areas


class NerfField(nn.Module):
    """K(p) by an 8-layer perceptron on a sinusoidal encoding, the encoding once more at the fifth layer.

    Args:
        bounds: corners of the volume (2, 3) [m]. unit: scale of the stiffness density [N/m^4]. width: of a layer; 64 gives the
            paper's 100 kB. octaves: of the encoding.
    """

    def __init__(self, bounds: np.ndarray, unit: float, *, width: int = 64, octaves: int = 6):
        super().__init__()
        self.kind, self.settings = "nerf", {"width": width, "octaves": octaves}
        self.register_buffer("bounds", torch.as_tensor(np.asarray(bounds), dtype=torch.float32))
        self.unit, self.octaves = float(unit), octaves
        size = 3 + 6 * octaves
        self.layers = nn.ModuleList([nn.Linear(size if i == 0 else width + (size if i == 4 else 0), width) for i in range(8)])
        self.out = nn.Linear(width, 1)

    def forward(self, points: torch.Tensor) -> torch.Tensor:
        """Stiffness density over the unit at ``points`` (k, 3) [m]: (k,), > 0."""
        x = 2.0 * (points - self.bounds[0]) / (self.bounds[1] - self.bounds[0]) - 1.0
        phase = x[:, None, :] * (np.pi * 2.0 ** torch.arange(self.octaves, device=x.device))[:, None]
        code = torch.cat([x, torch.sin(phase).flatten(1), torch.cos(phase).flatten(1)], dim=1)
        h = code
        for i, layer in enumerate(self.layers):
            h = torch.relu(layer(torch.cat([h, code], dim=1) if i == 4 else h))
        return functional.softplus(self.out(h)[:, 0])


class GridField(nn.Module):
    """K(p) = softplus of a sum of trilinear grids, each twice as fine as the one before.

    The coarse grids carry what neighbours share, the fine ones the detail, so that the field is as smooth as the data let it be.

    Args:
        bounds: corners of the volume (2, 3) [m]. unit: scale of the stiffness density [N/m^4]. cell: edge of the finest cells [m];
            None for a 24th of the longest edge. levels: of grids.
    """

    def __init__(self, bounds: np.ndarray, unit: float, *, cell: float | None = None, levels: int = 4):
        super().__init__()
        self.kind, self.settings = "grid", {"cell": cell, "levels": levels}
        edges = np.asarray(bounds[1], float) - np.asarray(bounds[0], float)
        cell = float(edges.max()) / 24.0 if cell is None else cell
        self.register_buffer("bounds", torch.as_tensor(np.asarray(bounds), dtype=torch.float32))
        self.unit = float(unit)
        shapes = [[max(2, round(edge / cell / 2**level) + 1) for edge in edges[::-1]] for level in range(levels)]
        self.grids = nn.ParameterList([nn.Parameter(torch.zeros(1, 1, *shape)) for shape in shapes])
        self.bias = nn.Parameter(torch.zeros(()))

    def forward(self, points: torch.Tensor) -> torch.Tensor:
        """Stiffness density over the unit at ``points`` (k, 3) [m]: (k,), > 0."""
        x = (2.0 * (points - self.bounds[0]) / (self.bounds[1] - self.bounds[0]) - 1.0).reshape(1, 1, 1, -1, 3)
        total = self.bias + sum(functional.grid_sample(grid, x, align_corners=True, padding_mode="border").reshape(-1) for grid in self.grids)
        return functional.softplus(total)


FIELDS: dict[str, Callable[..., nn.Module]] = {"nerf": NerfField, "grid": GridField}


@dataclass(frozen=True)
class Observations:
    """All (touch, frame, vertex) of some touches, ready for batches. way: vertex positions (T, N, 3) of each touch; area: oriented (T, N, 3);
    force: (T, N, 3). index: (touch, frame, vertex) of every observation (M, 3)."""

    way: list[torch.Tensor]
    area: list[torch.Tensor]
    force: list[torch.Tensor]
    index: torch.Tensor

    @classmethod
    def of(cls, touches: Sequence[DenseTouch], *, device: str = "cpu") -> Observations:
        """From touches; frame 0 has no way behind it and is left out.

        Raises:
            VsfError: no touch, fewer than two frames, or values that are not finite.
        """
        if not touches:
            raise VsfError("vsf.neural: there is no touch with contact forces on a surface; a rigid force sensor cannot be used here.")
        index = []
        for k, touch in enumerate(touches):
            if not (np.isfinite(touch.vertices).all() and np.isfinite(touch.force).all()) or touch.vertices.shape != touch.force.shape or len(touch.force) < 2:
                raise VsfError(f"vsf.neural: touch {k} has vertices {touch.vertices.shape} and forces {touch.force.shape}; both must be finite and (T, N, 3) with T of at least 2.")
            frames, count = touch.force.shape[:2]
            t, v = np.meshgrid(np.arange(1, frames), np.arange(count), indexing="ij")
            index.append(np.stack([np.full(t.size, k), t.ravel(), v.ravel()], axis=1))

        def tensor(x: np.ndarray) -> torch.Tensor:
            return torch.as_tensor(np.asarray(x), dtype=torch.float32, device=device)

        return cls([tensor(t.vertices) for t in touches], [tensor(oriented_areas(t.vertices, t.triangles)) for t in touches], [tensor(t.force) for t in touches],
                   torch.as_tensor(np.concatenate(index), device=device))

    def rows(self, which: torch.Tensor, samples: int) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Points (b, S, 3) [m], factors (b, S, 3) [m^4] and forces (b, 3) [N] of observations ``which``: f_hat = sum_S K(point) factor.

        The way from frame 0 to t is cut into ``samples`` pieces of equal time; each is taken at its middle.
        """
        parts: list[tuple[torch.Tensor, ...]] = []
        order = []
        chosen = self.index[which]
        for touch in torch.unique(chosen[:, 0]).tolist():
            at = torch.nonzero(chosen[:, 0] == touch)[:, 0]
            frame, vertex = chosen[at, 1], chosen[at, 2]
            way, area = self.way[touch], self.area[touch]
            grid = torch.linspace(0.0, 1.0, samples + 1, device=way.device)
            ends = _along(way, frame[:, None] * grid, vertex)
            points = 0.5 * (ends[:, 1:] + ends[:, :-1])
            middle = _along(area, frame[:, None] * (0.5 * (grid[1:] + grid[:-1])), vertex)
            volume = (middle * (ends[:, 1:] - ends[:, :-1])).sum(dim=2)
            parts.append((points, -(ends[:, -1:] - points) * volume[..., None], self.force[touch][frame, vertex]))
            order.append(at)
        back = torch.argsort(torch.cat(order))
        return tuple(torch.cat([part[k] for part in parts])[back] for k in range(3))


def _along(values: torch.Tensor, time: torch.Tensor, vertex: torch.Tensor) -> torch.Tensor:
    """Values (T, N, 3) of vertices (b,) at fractional frames (b, S): (b, S, 3)."""
    low = time.floor().long().clamp(0, len(values) - 2)
    part = (time - low)[..., None]
    return (1.0 - part) * values[low, vertex[:, None]] + part * values[low + 1, vertex[:, None]]


@dataclass(frozen=True)
class Fitting:
    """Settings of `fit`. iterations, batch, samples, rate: of eq. 5 and 6 and of Adam [-]. free_space: lambda, on K over the field's unit. free_points: n_reg.
    seed: of initial weights and batches."""

    iterations: int = 2000
    batch: int = 1000
    samples: int = 100
    rate: float = 2e-4
    free_space: float = 1e-2
    free_points: int = 1000
    seed: int = 0


def fit(kind: str, touches: Sequence[DenseTouch], bounds: np.ndarray, settings: Fitting | None = None, *, device: str = "cpu",
        progress: Callable[[int, int, str], None] | None = None, **field: object) -> nn.Module:
    """Fit a stiffness field to dense contact forces.

    Args:
        kind: "nerf" or "grid". touches: at least one. bounds: corners of the volume (2, 3) [m]. settings: of the training.
        device: torch device. progress: called with (iteration, of how many, loss). field: settings of the field's constructor.

    Returns:
        The field, whose `unit` times its output is a stiffness density [N/m^4].

    Raises:
        VsfError: an unknown kind, or touches that cannot be used.
    """
    if kind not in FIELDS:
        raise VsfError(f"vsf.neural: there is no field '{kind}'; allowed: {', '.join(FIELDS)}.")
    s = settings or Fitting()
    seen = Observations.of(touches, device=device)
    generator = torch.Generator().manual_seed(s.seed)
    unit = _unit(seen, generator, s)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(s.seed)
        model = FIELDS[kind](bounds, unit, **field).to(device)
    optimiser = torch.optim.Adam(model.parameters(), lr=s.rate)
    corner = torch.as_tensor(np.asarray(bounds), dtype=torch.float32, device=device)
    # The force that a field of 1 would make, so that the loss has the size of the relative error.
    for iteration in range(s.iterations):
        which = torch.randint(len(seen.index), (s.batch,), generator=generator).to(device)
        points, factor, force = seen.rows(which, s.samples)
        free = corner[0] + torch.rand(s.free_points, 3, generator=generator).to(device) * (corner[1] - corner[0])
        value = model(torch.cat([points.reshape(-1, 3), free]))
        # Off its samples' box a field is not defined: what lies outside the volume has no stiffness.
        inside = ((points >= corner[0]) & (points <= corner[1])).all(dim=2)
        predicted = ((value[:-s.free_points].reshape(inside.shape) * inside)[..., None] * factor * unit).sum(dim=1)
        # A hair inside the root keeps the gradient of |f - f_hat| finite where both are 0.
        misfit = ((force - predicted).square().sum(dim=1) + 1e-12).sqrt().sum()
        loss = misfit + s.free_space * value[-s.free_points:].mean()
        optimiser.zero_grad(set_to_none=True)
        loss.backward()
        optimiser.step()
        if progress is not None and iteration % 50 == 0:
            progress(iteration, s.iterations, f"{float(misfit.detach()) / s.batch:.3g} N a vertex")
    return model.eval()


@torch.no_grad()
def density(model: nn.Module, points: np.ndarray) -> np.ndarray:
    """Stiffness density at ``points`` (k, 3) [m]: (k,) [N/m^4]."""
    device = model.bounds.device
    parts = torch.as_tensor(np.asarray(points), dtype=torch.float32, device=device).split(200_000)
    return np.concatenate([np.zeros(0), *((model(part).double() * model.unit).cpu().numpy() for part in parts)])


def save_field(model: nn.Module, path: str | Path) -> None:
    """Write a field as .npz, its weights in half precision (a relative 5e-4 of each): a `NerfField` takes under 100 kB."""
    arrays = {f"weight.{name}": value.cpu().numpy().astype(np.float32 if name == "bounds" else np.float16) for name, value in model.state_dict().items()}
    with open(path, "wb") as file:
        np.savez_compressed(file, kind=model.kind, unit=model.unit, **{f"set.{k}": v for k, v in model.settings.items() if v is not None}, **arrays)


def load_field(path: str | Path) -> nn.Module:
    """Read what `save_field` wrote.

    Raises:
        VsfError: no such file, or not a field.
    """
    try:
        with np.load(path) as file:
            given = {name: file[name] for name in file.files}
        kind = str(given["kind"])
        settings = {name.removeprefix("set."): value.item() for name, value in given.items() if name.startswith("set.")}
        state = {name.removeprefix("weight."): torch.as_tensor(value).float() for name, value in given.items() if name.startswith("weight.")}
        model = FIELDS[kind](state["bounds"].numpy(), float(given["unit"]), **settings)
        model.load_state_dict(state)
    except (OSError, ValueError, KeyError, RuntimeError) as error:
        raise VsfError(f"vsf.neural: no field can be read from '{path}': {error}. Give a file that `save_field` wrote.") from error
    return model.eval()


def _unit(seen: Observations, generator: torch.Generator, s: Fitting) -> float:
    """The one stiffness density that explains the forces best, in the least squares sense [N/m^4]."""
    which = torch.randint(len(seen.index), (20 * s.batch,), generator=generator).to(seen.index.device)
    _, factor, force = seen.rows(which, 20)
    total = factor.sum(dim=1)
    unit = float((total * force).sum()) / max(float((total * total).sum()), 1e-300)
    if not unit > 0.0:
        raise VsfError("vsf.neural: the contact forces are all zero, or pull; a stiffness cannot be estimated. Are the forces those of the object on the sensor?")
    return unit
