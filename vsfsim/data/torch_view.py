"""A dataset as a `torch.utils.data.Dataset`, for a `DataLoader` with any number of workers.

```python
import torch
import vsfsim

touches = vsfsim.load("datasets/try").split("train").torch()
loader = torch.utils.data.DataLoader(touches, batch_size=4, num_workers=2, collate_fn=touches.collate)
for batch in loader:
    force, valid = batch["normal_force"], batch["valid"]     # (4, T) N, (4, T) bool
```

Files are opened for the time of one read, so that workers share nothing, forked or spawned. A worker keeps the object
views it read last: touches of one view in a row read its file once.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import torch
import torch.utils.data

from vsfsim.core.errors import DatasetError, one_of
from vsfsim.data.records import ObjectView, Touch

ITEMS = ("touch", "view", "object")
PER_FRAME = ("time", "pose", "force", "normal_force")
"""Fields of a touch that every dataset has, each with one row a frame."""
OPTIONAL = ("q", "torque", "pressure", "moment", "reaction")
"""Further fields that may be asked for by name, besides the names of `Touch.channels`."""
KEPT = 4
"""Object views that a worker keeps in memory."""


class TorchView(torch.utils.data.Dataset):
    """Touches, or views, of a dataset as dictionaries of tensors.

    An item of kind "touch" has ``name`` (text), ``touch`` (its number), ``axis`` (3,), ``target`` (3,) [m], and by
    frame ``time`` (T,) [s], ``pose`` (T, 4, 4) [m], ``force`` (T, 3) [N], ``normal_force`` (T,) [N], ``valid`` (T,)
    bool; readings of frames that did not converge are NaN. An item of kind "view", or a touch with ``images=True``, has
    ``rgb`` (3, H, W) uint8, ``depth`` (1, H, W) [m], ``mask`` (1, H, W) bool, ``intrinsics`` (3, 3) [px] and
    ``camera_pose`` (4, 4) [m]. An item of kind "object" has these and ``touches``, the fields of its n touches as one
    batch (n, T, ...); a batch of objects has a list of them. Numbers are float32. There is no truth in an item.

    Args:
        dataset: a `vsfsim.data.dataset.Dataset`, whole or a part of it.
        item: "touch", "view" or "object".
        images: whether a touch comes with the image of its object.
        fields: further readings of a touch, e.g. ("pressure",) or ("torque",).
        transform: called with each item; what it returns is the item.

    Raises:
        DatasetError: another kind of item, or a field that the first touch does not have.
    """

    def __init__(self, dataset: Any, item: str = "touch", *, images: bool = False, fields: Sequence[str] = (),
                 transform: Callable[[dict[str, Any]], Any] | None = None):
        one_of(item, ITEMS, "torch: item", DatasetError)
        self.dataset, self.item, self.images = dataset.blind(), item, images
        self.fields, self.transform = tuple(fields), transform
        self._views: OrderedDict[str, ObjectView] = OrderedDict()
        self._index = [(entry.name, touch) for entry in dataset.entries
                       for touch in range(entry.touches if item == "touch" else 1)]
        if self.fields and self._index:
            first = self._view(self._index[0][0]).touches[0]
            known = [name for name in (*OPTIONAL, *first.channels) if first.channel(name) is not None]
            for name in self.fields:
                one_of(name, known, f"a field of the touches in {dataset.path}", DatasetError)

    def __len__(self) -> int:
        return len(self._index)

    def __getitem__(self, index: int) -> Any:
        name, number = self._index[index]
        view = self._view(name)
        out: dict[str, Any] = {"name": name}
        if self.item == "touch":
            out |= {"touch": number, **self._touch(view.touches[number])}
        if self.item != "touch" or self.images:
            out |= _images(view)
        if self.item == "object":
            out["touches"] = self.collate([self._touch(touch) for touch in view.touches])
        return out if self.transform is None else self.transform(out)

    def __repr__(self) -> str:
        return f"TorchView({len(self)} {self.item}{'es' if self.item == 'touch' else 's'} of {self.dataset!r})"

    def __getstate__(self) -> Mapping[str, Any]:
        return {**self.__dict__, "_views": OrderedDict()}  # A spawned worker reads its own.

    def collate(self, items: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
        """A batch: tensors stacked, and touches with fewer frames than the longest filled up, readings with NaN,
        ``valid`` with False, times and poses with those of their last frame. Texts and numbers become lists and a
        tensor.

        Args:
            items: of this dataset.
        """
        out: dict[str, Any] = {}
        for key, first in items[0].items():
            column = [item[key] for item in items]
            if isinstance(first, torch.Tensor):
                frames = max(len(tensor) for tensor in column) if key in (*PER_FRAME, "valid", *self.fields) else None
                out[key] = torch.stack([tensor if frames is None else _filled(key, tensor, frames)
                                        for tensor in column])
            else:
                out[key] = torch.tensor(column) if isinstance(first, int) else column
        return out

    def _view(self, name: str) -> ObjectView:
        if name not in self._views:
            self._views[name] = self.dataset.load(name)
            while len(self._views) > KEPT:
                self._views.popitem(last=False)
        self._views.move_to_end(name)
        return self._views[name]

    def _touch(self, touch: Touch) -> dict[str, torch.Tensor]:
        valid = torch.from_numpy(np.array(touch.converged, bool))
        out = {"time": _real(touch.time), "pose": _real(touch.mount_pose), "axis": _real(touch.axis),
               "target": _real(touch.target), "valid": valid}
        for name, values in (("force", touch.force), ("normal_force", touch.normal_force()),
                             *((name, touch.channel(name)) for name in self.fields)):
            out[name] = _real(values)
            out[name][~valid] = float("nan")
        return out


def _real(values: Any) -> torch.Tensor:
    return torch.from_numpy(np.array(values, np.float32))


def _images(view: ObjectView) -> dict[str, torch.Tensor]:
    shown = view.view
    return {"rgb": torch.from_numpy(np.array(shown.rgb.transpose(2, 0, 1))), "depth": _real(shown.depth[None]),
            "mask": torch.from_numpy(np.array(shown.mask[None], bool)), "intrinsics": _real(shown.intrinsics),
            "camera_pose": _real(shown.camera_pose)}


def _filled(key: str, tensor: torch.Tensor, frames: int) -> torch.Tensor:
    missing = frames - len(tensor)
    if key in ("time", "pose"):
        tail = tensor[-1:].expand(missing, *tensor.shape[1:])
    else:  # no valid frame, and no reading
        tail = tensor.new_full((missing, *tensor.shape[1:]), False if key == "valid" else float("nan"))
    return torch.cat([tensor, tail])
