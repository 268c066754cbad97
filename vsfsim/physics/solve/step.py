"""What becomes of Newton's direction: corrected for the contact at its end."""

from __future__ import annotations

import torch

from vsfsim.physics import clock
from vsfsim.physics.contact.interface import Contact

_CORRECTED, _DESCENDS = 0.3, 1e-3  # of the slope along a direction that its correction must keep; with friction
_OF_STEP = 0.01  # error of that correction with friction, over the length of the step
# unknowns of a patch from which on a condensed problem costs more than the linear system whose step it corrects
_LARGE = 1500


def correct(contact: Contact, columns: torch.Tensor, u: torch.Tensor, direction: torch.Tensor, stiffness: torch.Tensor,
            residual: torch.Tensor) -> torch.Tensor:
    """Correct Newton's step for the contact at its end: it was found for the points that touch at its beginning.

    The condensed problem removes the difference between the true contact forces at the end of the step and the
    linearised ones. Where the contact stays the same this changes nothing. The body responds as at rest in it, so a
    body that has become stiffer is corrected too far: where that takes away most of the descent along the
    direction, the direction stays as it is. After the deadline of the frame nothing is corrected.
    """
    if clock.now() > contact.deadline:
        return direction
    at = contact.dof[columns].clamp(min=0).T
    mask = contact.mask[columns]
    change = direction.gather(0, at).T * mask
    base = u[:, columns].gather(0, at).T * mask + change
    pushed = contact.nodal(columns) - (stiffness @ change[:, :, None])[:, :, 0]
    slides = contact.has_friction and contact.solid  # Newton's own step may throw points past their anchors
    fine = _OF_STEP * change.abs().amax(dim=1) / base.abs().amax(dim=1).clamp(min=1e-9)
    # 2 to 4 directions serve large patches as well as one another, 10 cost half of a frame (cells 8f428925ce77 and
    # 68c57cd61969 of the stability map)
    large = contact.solid and base.shape[1] > _LARGE
    with clock.measure("contact"):
        force, error = contact.condensed(columns, base, pushed, iterations=4 if large else 30,
                                         tolerance=fine if slides else 1e-3 if large else 1e-5)
    useful = (error < 0.1) & (force != 0.0).any(dim=1)
    if bool(useful.any()):
        corrected = direction.clone()
        corrected[:, useful] += contact.response.patch(columns[useful], force[useful])
        falls = ((residual * corrected).sum(dim=0)
                 >= (_DESCENDS if slides else _CORRECTED) * (residual * direction).sum(dim=0))
        direction = torch.where(falls, corrected, direction)
    return direction
