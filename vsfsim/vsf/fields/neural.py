"""The continuous VSF: stiffness as a function of position, fitted to dense contact forces (Neural VSF section III-D).

The force on a vertex at time t is a line integral along its path v(tau) (eq. 5),

    f(t) = sum_i -K(v(tau_i)) (v(t) - v(tau_i)) s(tau_i) . dv(tau_i)

with s its oriented area. It is linear in the values of K at known points, see `line_integrals`. A field is fitted by
minimising eq. 6 with Adam: the sum of |f - f_hat| over a batch of B observations plus a free-space term lambda * mean K
at random points of the volume.

There are two fields: `NerfField`, the papers' (sinusoidal encoding, 8 layers, a skip), and `GridField`, ours, a sum of
trilinear grids of rising resolution, which needs a few dozen operations a point instead of tens of thousands.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import nn
from torch.nn import functional

from vsfsim.core.errors import NoStiffnessError, VsfError
from vsfsim.vsf.fields.line_integrals import Forces, SurfaceTouch


class NerfField(nn.Module):
    """K(p) by an 8-layer perceptron on a sinusoidal encoding, the encoding once more at the fifth layer.

    Args:
        bounds: corners of the volume (2, 3) [m].
        unit: scale of the stiffness density [N/m^4].
        width: numbers of a layer; 64 gives the paper's 100 kB.
        octaves: of the encoding.
    """

    def __init__(self, bounds: np.ndarray, unit: float, *, width: int = 64, octaves: int = 6):
        super().__init__()
        self.register_buffer("bounds", torch.as_tensor(np.asarray(bounds), dtype=torch.float32))
        self.unit, self.octaves = float(unit), octaves
        size = 3 + 6 * octaves
        self.layers = nn.ModuleList([nn.Linear(size if i == 0 else width + (size if i == 4 else 0), width)
                                     for i in range(8)])
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

    The coarse grids hold what neighbours share and the fine ones the detail, so the field is smooth where the data do
    not contradict it.

    Args:
        bounds: corners of the volume (2, 3) [m].
        unit: scale of the stiffness density [N/m^4].
        cell: edge of the finest cells [m]; None for a 24th of the longest edge.
        levels: number of grids.
    """

    def __init__(self, bounds: np.ndarray, unit: float, *, cell: float | None = None, levels: int = 4):
        super().__init__()
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
        total = self.bias + sum(functional.grid_sample(grid, x, align_corners=True, padding_mode="border").reshape(-1)
                                for grid in self.grids)
        return functional.softplus(total)


FIELDS: dict[str, Callable[..., nn.Module]] = {"nerf": NerfField, "grid": GridField}


@dataclass(frozen=True)
class Fitting:
    """Settings of `fit`; the defaults are the papers'."""

    iterations: int = 2000
    """Steps of Adam."""
    batch: int = 1000
    """Observations in a step, B of eq. 6."""
    samples: int = 100
    """Pieces of the line integral of eq. 5."""
    rate: float = 2e-4
    """Learning rate of Adam [-]."""
    free_space: float = 1e-2
    """lambda of eq. 6, on K over the field's unit."""
    free_points: int = 1000
    """Random points of the free-space term, n_reg."""
    seed: int = 0
    """Of initial weights and batches."""


def fit(kind: str, touches: Sequence[SurfaceTouch], bounds: np.ndarray,
        settings: Fitting | None = None, *, device: str = "cpu", **field: object) -> nn.Module:
    """Fit a stiffness field to contact forces.

    Args:
        kind: one of `FIELDS`.
        touches: at least one; all with forces on the vertices, or all with their total only.
        bounds: corners of the volume (2, 3) [m].
        settings: of the training; a batch of totals has as many vertices as a batch of forces on vertices.
        device: torch device.
        field: settings of the field's constructor.

    Returns:
        The field, whose `unit` times its output is a stiffness density [N/m^4].

    Raises:
        VsfError: an unknown kind, or touches that cannot be used.
    """
    if kind not in FIELDS:
        raise VsfError(f"vsf.neural: there is no field '{kind}'; allowed: {', '.join(FIELDS)}.")
    s = settings or Fitting()
    forces = Forces.of(touches, device=device)
    size = max(1, s.batch // forces.cost())
    generator = torch.Generator().manual_seed(s.seed)
    unit = _unit(forces, generator, size)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(s.seed)
        model = FIELDS[kind](bounds, unit, **field).to(device)
    corner = torch.as_tensor(np.asarray(bounds), dtype=torch.float32, device=device)
    optimiser = torch.optim.Adam(model.parameters(), lr=s.rate, foreach=True)
    for _ in range(s.iterations):
        # drawn on the host, so that they are the same for every device
        which = torch.randint(len(forces.index), (size,), generator=generator).to(device)
        free = torch.rand((s.free_points, 3), generator=generator).to(device)
        points, factor, force = forces.rows(which, s.samples)
        value = model(torch.cat([points.reshape(-1, 3), corner[0] + free * (corner[1] - corner[0])]))
        # The field is zero outside its bounding box.
        inside = ((points >= corner[0]) & (points <= corner[1])).all(dim=2)
        predicted = ((value[:-s.free_points].reshape(inside.shape) * inside)[..., None] * factor * unit).sum(dim=1)
        # The constant keeps the gradient of |f - f_hat| finite where both are 0.
        misfit = ((force - predicted).square().sum(dim=1) + 1e-12).sqrt().sum()
        loss = misfit + s.free_space * value[-s.free_points:].mean()
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
    if not all(bool(torch.isfinite(p).all()) for p in model.parameters()):
        raise VsfError(f"vsf.neural: the {kind} field diverged: its weights are no longer finite. Lower the rate, "
                       f"{s.rate:g} now.")
    return model.eval()


@torch.no_grad()
def predict_totals(model: nn.Module, touch: SurfaceTouch, *, samples: int) -> np.ndarray:
    """Total force of a touch against its axis in every frame (T,) [N]; ``touch.force`` is not used."""
    device = model.bounds.device
    query = Forces.of([dataclasses.replace(touch, force=np.zeros(len(touch.vertices)))], device=str(device))
    points, factor, _ = query.rows(torch.arange(len(query.index), device=device), samples)
    inside = ((points >= model.bounds[0]) & (points <= model.bounds[1])).all(dim=2)
    value = torch.cat([model(part) for part in points.reshape(-1, 3).split(200_000)]).reshape(inside.shape)
    force = ((value * inside)[..., None] * factor * model.unit).sum(dim=(1, 2)).double().cpu().numpy()
    return np.concatenate([[0.0], force])


@torch.no_grad()
def density(model: nn.Module, points: np.ndarray) -> np.ndarray:
    """Stiffness density at ``points`` (k, 3) [m]: (k,) [N/m^4]."""
    device = model.bounds.device
    parts = torch.tensor(np.asarray(points), dtype=torch.float32, device=device).split(200_000)
    return np.concatenate([np.zeros(0), *((model(part).double() * model.unit).cpu().numpy() for part in parts)])


def _unit(forces: Forces, generator: torch.Generator, size: int) -> float:
    """The uniform stiffness density that fits the forces best in the least squares sense [N/m^4]."""
    which = torch.randint(len(forces.index), (20 * size,), generator=generator).to(forces.index.device)
    _, factor, force = forces.rows(which, 20)
    total = factor.sum(dim=1)
    unit = float((total * force).sum()) / max(float((total * total).sum()), 1e-300)
    if not unit > 0.0:
        raise NoStiffnessError("vsf.neural: the contact forces are all zero, or pull; a stiffness cannot be estimated. "
                               "Are the forces those of the object on the sensor?")
    return unit
