"""What the points of a contact patch remember of friction when the patch grows."""

from types import SimpleNamespace

import numpy as np
import torch

from vsfsim.physics.contact.body_points import NONE, pad
from vsfsim.physics.contact.growth import remember
from vsfsim.physics.contact.patch import make_patch, shape_tables

FACES = np.array([[0, 1, 2, 4, 5, 6], [1, 3, 2, 7, 8, 5]])
CORNERS = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]])
REST = np.vstack([CORNERS, [(CORNERS[a] + CORNERS[b]) / 2 for a, b in ((0, 1), (1, 2), (2, 0), (1, 3), (3, 2))]])
TABLE, ROWS = shape_tables(6, (1, 2))


def padded(faces, cuts):
    faces, mesh = np.array(faces), SimpleNamespace(faces=FACES)
    patch = make_patch(mesh, faces, np.full(len(faces), 0.5), np.full(len(faces), 1e5), np.array(cuts), ROWS)
    points = SimpleNamespace(met=[NONE], body=np.zeros(0, int), spot=np.zeros((0, 3)), stiffness=lambda _: ((), (), ()))
    return pad([patch], FACES, 1, points, TABLE)


def state(points, rng):
    count = points.key.shape[1]
    return (torch.as_tensor(rng.standard_normal((1, count, 3))), torch.zeros((1, count), dtype=torch.int32),
            torch.as_tensor(rng.uniform(size=(1, count))), torch.as_tensor(rng.standard_normal((1, count, 3))))


def test_points_that_stay_keep_their_memory_cut_ones_share_it_and_new_ones_have_none():
    rng = np.random.default_rng(0)
    old, new, cut = padded([0], [1]), padded([0, 1], [1, 1]), padded([0], [2])
    kept, moved = state(old, rng), torch.as_tensor(0.01 * rng.standard_normal((27, 1)))
    found, finer = state(new, rng), state(cut, rng)
    remember(found, kept, (old, new), [0], REST, moved, np.eye(3)[None, None])
    assert all(torch.equal(mine[0, :6], was[0]) for mine, was in zip(found, kept, strict=True))
    assert (found[1][0, 6:] == -1).all() and not found[2][0, 6:].any()
    remember(finer, kept, (old, cut), [0], REST, moved, np.eye(3)[None, None])
    at = REST + moved.numpy().reshape(-1, 3)
    slip_old, slip_new = (p.places(0, at) - m[0][0].numpy() for p, m in ((old, kept), (cut, finer)))
    near = np.linalg.norm(cut.places(0, REST)[:, None] - old.places(0, REST)[None], axis=2).argmin(axis=1)
    assert np.allclose(slip_new, slip_old[near])
    assert np.allclose(finer[2][0].numpy() / cut.stiffness.ravel(), (kept[2][0].numpy() / old.stiffness.ravel())[near])
