"""Some nodes of the two surfaces in contact, padded to one number for all touches, and their links to the other
surface."""

from __future__ import annotations

import torch

from vsfsim.physics.contact.pair.links import Links
from vsfsim.physics.contact.pair.surfaces import PairSurfaces


class ChosenNodes:
    """Some nodes of both sides of k touches, one side after the other, a in all; it is false without any.

    Args:
        surfaces: the two surfaces.
        columns: touches (k,).
        masks: which nodes of each side (k, Q) bool.
    """

    on: torch.Tensor
    """Whether an entry is a node, and no padding (k, a) bool."""

    def __init__(self, surfaces: PairSurfaces, columns: torch.Tensor, masks: list[torch.Tensor]):
        self._surfaces, self._columns, self._each = surfaces, columns, []
        on = [torch.zeros_like(columns, dtype=torch.bool)[:, None][:, :0]]
        for side, mask in zip(surfaces.sides, masks, strict=True):
            if most := int(mask.sum(dim=1).amax()):
                chosen, order = torch.sort(mask.to(torch.int8), dim=1, descending=True, stable=True)
                self._each.append((side, (columns[:, None], order[:, :most])))
                on.append(chosen[:, :most] > 0)
        self.on = torch.cat(on, dim=1)

    def __bool__(self) -> bool:
        return bool(self._each)

    def of(self, name: str) -> torch.Tensor:
        """The values of the array ``name`` of `Side` at these nodes (k, a, ...), 0 at padding."""
        values = torch.cat([side.tensors[name][at] for side, at in self._each], dim=1)
        return values * self.on.view(*self.on.shape, *[1] * (values.dim() - 2)).to(values.dtype)

    def links(self, face: str, shape: str, world: torch.Tensor, slope: torch.Tensor | None = None) -> Links:
        """Their links to places on the other side, by the names of the arrays that say where.

        Args:
            face, shape: names of the faces (k, a) and the shape values on them (k, a, 6).
            world: directions in the world (k, a, m, 3).
            slope: those along which a displacement counts, likewise; None for the same.
        """
        patch, turn = self._surfaces.patch, self._surfaces.turn[self._columns]
        place = patch.place[self._columns]
        rows = torch.arange(len(place), device=place.device)[:, None, None]
        there, first = self.of(face).long() - (~self.on).long(), 0
        weight = torch.cat([torch.ones_like(there)[:, :, None], -self.of(shape)], dim=2) * self.on[:, :, None]
        weight[:, :, 1:] *= (there >= 0)[:, :, None]
        node = torch.zeros(weight.shape, dtype=torch.int64, device=place.device)
        for side, at in self._each:
            some = slice(first, first := first + at[1].shape[1])
            corners = side.tensors["faces"].shape[2]
            node[:, some, 0] = place.gather(1, side.first + at[1])
            found = side.tensors["faces"][self._columns[:, None], there[:, some].clamp(min=0)].long()
            node[:, some, 1:1 + corners] = place[rows, found]
        return Links.of(patch.split, patch.nodes.shape[1], node, weight, turn, world, slope)
