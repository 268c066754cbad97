"""The equilibrium of an object under its weight alone, from which all touches begin."""

from __future__ import annotations

import numpy as np
import torch

from vsfsim.physics import clock
from vsfsim.physics.solve.frames import Reason
from vsfsim.physics.solve.newton import Equilibrium

_LEAST = 1 / 256  # the smallest part of the load
_AWAY = 1e3  # how far the bodies are meanwhile [m], on the side of a plane that is solid


def apply(balance: Equilibrium, pose: np.ndarray) -> None:
    """Find the equilibrium under the load alone, in parts that are as large as they converge.

    Args:
        balance: the batch; all its displacements are set.
        pose: poses of the bodies (B, K, 4, 4), free of the object.
    """
    model, contact, options = balance.model, balance.contact, balance.options
    if not model.load.any():
        return
    deadline = clock.now() + options.seconds * len(balance.every)
    first, whole = balance.every[:1], balance.load
    away = pose.copy()
    away[..., :3, 3] -= _AWAY * pose[..., :3, 2]
    contact.begin_step(away, balance.u)
    contact.move(away, balance.every)
    linear = model.preconditioner.solve((model.load * model.free)[:, None])
    slope = torch.as_tensor(linear, dtype=torch.float64, device=balance.device)
    done, part, u = 0.0, 1.0, torch.zeros_like(slope)
    while done < 1.0 and part >= _LEAST and clock.now() < deadline:
        share = min(part, 1.0 - done)
        balance.load = (done + share) * whole
        balance.u[:, :1] = u + share * slope
        balance.reset_counts()
        state = balance.evaluate(first)
        balance.solve(first, state, options.tolerance, deadline)
        # out of time the first frame goes on, unless the body at rest (1) is nearer to the balance
        late = balance.reason[0] == Reason.TIME and done + share == 1.0 and float(state["measure"][0]) < 1.0
        if balance.reason[0] == Reason.NONE or late:
            slope, u = (balance.u[:, :1] - u) / share, balance.u[:, :1].clone()
            done, part = done + share, 2.0 * part
        else:
            part = 0.5 * share
    balance.load = whole
    balance.u[:] = u
    balance.factors.forget()
