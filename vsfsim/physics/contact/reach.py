"""What of an object's boundary rigid bodies can reach on their way, and how finely contact samples it there."""

from __future__ import annotations

import numpy as np
import torch

from vsfsim.physics.contact.bodies import RigidBodies
from vsfsim.physics.contact.body_samples import has_edges
from vsfsim.physics.contact.patch import CUTS, smooth_radius
from vsfsim.physics.model import Model

_A_PRIORI = 4  # most cuts of a quadratic face before a body was found between its points
_SHARP = 2  # cuts of a quadratic face under a body with edges, whose own points do the rest, see `body_points`
_BULGE = 0.15  # of the depth: margin for surface that bulges up
# share of the depth of a mount that its spring is taken to give way; that of shoes-v3 gives way by more. What a body
# that comes further meets becomes part of the patch when it does
_BEHIND = 0.3


def plan(bodies: RigidBodies, model: Model, poses: np.ndarray, cuts: int, *, local: bool,
         by_place: bool, sprung: bool, device: str) -> tuple[np.ndarray, np.ndarray]:
    """What rigid bodies can reach of an object's boundary on their way, and how finely contact samples it.

    The six points of a part leave holes of radius 0.25 edge / cuts. Over such a hole a ball of radius R is (0.25 edge /
    cuts)^2 / (2 R) deep, which these parts hold under 2 % of an edge. A body with edges has flat sides, which need few
    points, and its edges have points of their own. The more of both there are from the beginning, the less the force of
    a punch depends on where the object was when more were added. Under the mesh of a smooth body faces are cut where it
    is found between the points.

    Args:
        bodies: the rigid bodies (K).
        model: the object.
        poses: all poses to come (T, B, K, 4, 4); where springs carry the bodies (``sprung``), those of their mounts,
            and the bodies stay behind.
        cuts: least number of parts along the edge of a face.
        local: whether round bodies sink in locally, see `local_indentation`: their contact is small.
        by_place: whether by what the object lacks where it is touched: a footprint takes about ten points.
        device: Warp device.

    Returns:
        Whether each boundary face may come into contact (B, f) bool, and the number of parts along its edge (B, f).
    """
    mesh, surface = model.mesh, model.mesh.surface_nodes()
    rest = torch.as_tensor(mesh.points[surface], device=device)[:, None]
    each = np.stack([bodies.nearest(poses, rest, body=k).cpu().numpy() for k in range(len(bodies))])

    def reachable(gap: np.ndarray) -> np.ndarray:
        """Faces (B, f) bool by the least gaps (s, B) [m], with a margin for surface that bulges up."""
        nearest = np.full((len(mesh.points), gap.shape[1]), np.inf)
        nearest[surface] = gap
        behind = _BEHIND if sprung else 0.0
        margin = (_BULGE * (1.0 - behind) - behind) * (-gap.min(axis=0)).clip(min=0.0) + 0.1 * model.element_size
        return (nearest[mesh.faces].min(axis=1) < margin).T

    within = reachable(each.min(axis=0))
    out = np.full(within.shape, cuts)
    if mesh.faces.shape[1] == 6:
        edge = np.sqrt(2.0 * mesh.face_area())
        for shape, gap in zip(bodies.shapes, each, strict=True):
            wanted, radius = np.array(_SHARP if has_edges(shape) else 1), smooth_radius(shape)
            if 0.0 < radius < np.inf:
                holes = 4.0 * edge / radius if by_place else np.sqrt((2.2 if local else 1.6) * edge / radius)
                wanted = np.array(CUTS)[np.searchsorted(CUTS, np.minimum(holes, _A_PRIORI) - 1e-9)]
            out = np.maximum(out, np.where(reachable(gap), wanted, 1))
    return within, out
