"""What the points of a contact patch remember of friction when the patch grows."""

import numpy as np

from vsfsim.physics.contact.growth import carry
from vsfsim.physics.contact.patch import Patch


def patch(faces, cuts, rng):
    """A patch of triangles ``faces`` with as many ``cuts`` each; geometry plays no part where no face is cut anew."""
    parts = int(np.sum(np.square(cuts)))
    return Patch(np.array(faces), np.arange(6), np.zeros((parts, 6), int), rng.uniform(1.0, 2.0, (parts, 6)),
                 np.array(cuts), np.zeros(parts, int))


def test_faces_with_the_same_points_keep_their_memory_and_new_ones_have_none():
    rng = np.random.default_rng(0)
    old, new = patch([2, 5, 9], [1, 2, 1], rng), patch([1, 2, 5, 7, 9], [2, 1, 2, 1, 1], rng)
    points = 6 * len(old.part)
    memory = (rng.standard_normal((points + 12, 3)), rng.integers(0, 3, points + 12), rng.uniform(size=points + 12),
              rng.standard_normal((points + 12, 3)))  # the last twelve pad the tensors
    found = carry(old, new, memory, np.zeros((1, 6, 6)), np.zeros((6, 3)), np.zeros((6, 3)), np.eye(3)[None])
    old_of, new_of = (dict(zip(p.faces.tolist(), np.split(np.arange(6 * len(p.part)), 6 * p.starts()[1:]), strict=True))
                      for p in (old, new))
    for face, rows in new_of.items():
        if face in old_of:
            assert all(np.array_equal(there[rows], was[old_of[face]]) for there, was in zip(found, memory, strict=True))
        else:
            assert (found[1][rows] == -1).all()
