"""The values of one frame, with the checks that decide whether it counts."""

from __future__ import annotations

import numpy as np
import torch

from vsfsim.physics.contact.body_samples import has_edges
from vsfsim.physics.contact.rigid_contact import RigidContact
from vsfsim.physics.mesh.resolved import BARE, ROUND, SHARE, UNFELT, corner_det_f, mesh_error, rotation
from vsfsim.physics.solve.elasticity import LinearElasticity
from vsfsim.physics.solve.frames import OF_AN_EQUILIBRIUM, Reason
from vsfsim.physics.solve.newton import Equilibrium, State

Rows = dict[str, np.ndarray]
"""The values of one frame by the fields of `Frames`, (B, ...) each."""


def report(balance: Equilibrium, state: State) -> Rows:
    """The values of one frame from the state of all touches.

    Args:
        balance: the batch.
        state: of all touches.
    """
    contact, every = balance.contact, balance.every
    batch, accept = len(every), balance.options.tolerance
    acting, internal = state["contact"], state["internal"]
    on_object = acting.view(-1, 3, batch).sum(dim=0).T
    held = ((internal - balance.load - acting) * (1.0 - balance.free)).view(-1, 3, batch).sum(dim=0).T
    weight = balance.load.view(-1, 3).sum(dim=0)
    local = contact.local_energy(every)
    unbalanced = (held + on_object + weight).norm(dim=1)
    largest = torch.maximum(held.norm(dim=1), on_object.norm(dim=1)).clamp(min=balance.floor)
    values = {
        "force": -on_object, "reaction": held, "residual": state["measure"],
        "body_force": contact.on_bodies(every), "body_moment": contact.moment_on_bodies(every),
        "force_balance": unbalanced / largest, "energy": state["energy"] + local,
        "min_det_f": balance.elasticity.det(every, balance.u),
        "penetration": contact.penetration(every), "slipping": contact.slipping(every),
    }
    values["contact_points"], values["contact_radius"], each, share = contact.resolution(every)
    out = {key: value.cpu().numpy() for key, value in values.items()}
    names = ("mesh_error", "law_error", "support_error", "corner_det_f", "rotation")
    part = (local / state["energy"].clamp(min=1e-300)).cpu().numpy()[:, None]
    error = resolution(balance, each.cpu().numpy(), share.cpu().numpy(), part, out["body_force"])
    out |= zip(names, error, strict=True)
    # a body between contact points that no point feels yet: the force lacks all of itself
    out["mesh_error"][(out["penetration"] > UNFELT * balance.model.element_size) & (out["mesh_error"] == 0.0)] = 1.0
    reason = balance.reason.copy()
    # with friction the limit renewed last counts; without, this is the state that Newton's method left
    reason[(reason == Reason.NONE) & ~(out["residual"] <= accept)] = Reason.STALLED
    if contact.springs is not None:
        reason[contact.springs.unbalanced(on_object).cpu().numpy() & (reason == Reason.NONE)] = Reason.MOUNT
    out["reason"], out["converged"] = reason, reason == Reason.NONE
    out["unbalanced_force"] = np.where(out["converged"][:, None], 0.0, out["force"])
    for name in OF_AN_EQUILIBRIUM:
        out[name][~out["converged"]] = np.nan
    out["iterations"], out["cg_iterations"] = balance.newton.copy(), balance.cg.copy()
    return out


def resolution(balance: Equilibrium, radius: np.ndarray, share: np.ndarray, local: np.ndarray,
               force: np.ndarray) -> tuple[np.ndarray, ...]:
    """Estimated error of the force by mesh and law [-], its parts by small strain and by the supports [-], least det F
    at corners of elements in contact [-], and largest rotation of an element [rad], (B,) each; NaN of what is no solid
    under rigid bodies.

    A box that ends inside elements holds the body by the nodes in it, further back than it says. The error is the share
    of the energy that is where the box would let nothing move: 3 gap / length of a cantilever, as by beam theory.

    Args:
        balance: the batch.
        radius: of the contact with each body over the edge of the elements there (B, K) [-].
        share: of each body's way that is local indentation (B, K) [-].
        local: energy of the local indentation over that of the elements (B, 1) [-].
        force: on each body (B, K, 3) [N].
    """
    model, batch, every = balance.model, len(radius), balance.every.int()
    solid = all(block.kind == "tet10" for block in model.blocks)
    if not (solid and isinstance(balance.contact, RigidContact)):
        return tuple(np.full((5, batch), np.nan))
    u = balance.u.cpu().numpy().reshape(-1, 3, batch)
    corner = [corner_det_f(model.mesh, patch.nodes, u[:, :, b]) for b, patch in enumerate(balance.contact.patches)]
    small = np.where(balance.contact.local_indentation.acts(), ROUND if model.mesh.curvature().any() else SHARE, BARE)
    edges = np.array([has_edges(shape) for shape in balance.contact.bodies.shapes])
    error, (law, support) = mesh_error(radius, force, share, edges, small, local), np.zeros((2, batch))
    if model.inside_box is not None:
        inside = balance.elasticity.energy_in(model.inside_box, every, balance.u)
        support = np.where(error > 0.0, inside, 0.0)
    if isinstance(balance.elasticity, LinearElasticity) and error.any():
        law = np.where(error > 0.0, balance.elasticity.law_error(every, balance.u), 0.0)
    return np.hypot(np.hypot(error, law), support), law, support, np.array(corner), rotation(model.mesh, u)
