"""Some nodes of the two surfaces in contact, padded to one number for all touches, and their links to the other
surface.

``columns`` (k,) are touches. The chosen nodes of both sides stand one after the other, a in all.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch

from vsfsim.physics.contact.pair.links import Links
from vsfsim.physics.contact.pair.sides import Side
from vsfsim.physics.contact.pair.surfaces import PairSurfaces


@dataclass(frozen=True)
class ChosenNodes:
    """Some nodes of one side, padded to the largest number a of any touch."""

    side: Side
    """The side whose nodes they are."""
    at: tuple[torch.Tensor, torch.Tensor]
    """Touches (k, 1) and nodes (k, a)."""
    on: torch.Tensor
    """1, or 0 at padding (k, a) [-]."""

    def of(self, name: str) -> torch.Tensor:
        """The values of the array ``name`` of `Side.state` at these nodes (k, a, ...)."""
        return self.side.state[name][self.at]

    def stiffness(self) -> torch.Tensor:
        """Their penalty stiffness (k, a) [N/m]."""
        return self.side.stiffness[self.at]

    def anchor(self) -> tuple[torch.Tensor, torch.Tensor]:
        """Their anchors: a face (k, a) and shape values (k, a, 6)."""
        return self.side.memory["anchor_face"][self.at], self.side.memory["anchor_shape"][self.at]


def choose(sides: Sequence[Side], columns: torch.Tensor, masks: list[torch.Tensor]) -> list[ChosenNodes]:
    """The nodes of each side that its mask (k, Q) selects; sides without any are left out."""
    out = []
    for side, mask in zip(sides, masks, strict=True):
        most = int(mask.sum(dim=1).amax())
        if most:
            on, order = torch.sort(mask.to(torch.int8), dim=1, descending=True, stable=True)
            out.append(ChosenNodes(side, (columns[:, None], order[:, :most]), on[:, :most].to(torch.float64)))
    return out


def written(chosen: list[ChosenNodes], name: str) -> torch.Tensor:
    """Vectors that the kernels wrote into `Side.state` for all chosen nodes (k, a, 3), 0 at padding."""
    return torch.cat([own.of(name) * own.on[:, :, None] for own in chosen], dim=1)


def links_of(surfaces: PairSurfaces, columns: torch.Tensor, chosen: list[ChosenNodes],
             places: list[tuple[torch.Tensor, torch.Tensor]], directions: list[torch.Tensor],
             slopes: list[torch.Tensor] | None = None) -> Links | None:
    """Links of the chosen nodes to ``places`` on the other side; None if no node is chosen.

    Args:
        places: for each entry of ``chosen`` a face (k, a) and shape values (k, a, 6).
        directions: for each entry of ``chosen`` the directions (k, a, m, 3) in the world.
        slopes: those along which a displacement counts, likewise; None for the same.
    """
    if not chosen:
        return None
    patch = surfaces.patch
    place = patch.place[columns]
    rows = torch.arange(len(columns), device=place.device)[:, None, None]
    width = 1 + max(own.side.faces.shape[2] for own in chosen)
    nodes, weights = [], []
    for own, (face, shape) in zip(chosen, places, strict=True):
        side = own.side
        there = place[rows, side.faces[columns[:, None], face.clamp(min=0).long()].long()]
        node = torch.cat([place.gather(1, side.first + own.at[1])[:, :, None], there], dim=2)
        held = (own.on * (face >= 0))[:, :, None]
        weight = torch.cat([own.on[:, :, None], -shape[:, :, :side.faces.shape[2]] * held], dim=2)
        spare = (0, width - node.shape[2])
        nodes.append(torch.nn.functional.pad(node, spare))
        weights.append(torch.nn.functional.pad(weight, spare))
    turn = surfaces.turn[columns][:, None]
    world = torch.cat(directions, dim=1)
    slope = world if slopes is None else torch.cat(slopes, dim=1)
    return Links.of(patch.split, patch.nodes.shape[1], torch.cat(nodes, dim=1), torch.cat(weights, dim=1), world,
                    world @ turn, slope, slope @ turn)
