"""The faces that two deformable surfaces may meet at, against all distances."""

import numpy as np
import pytest
import trimesh
import warp as wp

from vsfsim.physics.contact.pair import kernels
from vsfsim.physics.runtime import real


@pytest.mark.parametrize("within", [0.3, 10.0])
def test_candidates_are_the_nearest_faces_nearest_first(within, device):
    rng = np.random.default_rng(0)
    points, faces = rng.uniform(size=(20, 3)), np.arange(120).reshape(40, 3)
    corners = rng.uniform(size=(40, 1, 3)) + 0.2 * rng.standard_normal((40, 3, 3))
    k = kernels.kernels()
    x = wp.array(np.concatenate([corners.reshape(-1, 3), points])[None], dtype=k.vec3, device=device)
    side, stiffness = k.Side(), np.ones((1, 20))
    stiffness[0, 7] = 0.0  # a node that meets nothing
    side.first, side.corners = 120, 3
    for name, values, dtype in (("stiffness", stiffness, real), ("faces", faces[None], wp.int32),
                                ("count", [40], wp.int32),
                                ("candidates", np.full((1, 20, kernels.CANDIDATES), 5), wp.int32)):
        setattr(side, name, wp.array(values, dtype=dtype, device=device))
    wp.launch(k.search, dim=(20, 1), device=device,
              inputs=[side, wp.array([0], dtype=wp.int32, device=device), within, x])
    found = side.candidates
    for q, row in enumerate(found.numpy()[0]):
        far = np.linalg.norm(trimesh.triangles.closest_point(corners, np.tile(points[q], (40, 1))) - points[q], axis=1)
        nearest = [face for face in np.argsort(far) if far[face] < within and q != 7][:kernels.CANDIDATES]
        assert row.tolist() == nearest + [-1] * (kernels.CANDIDATES - len(nearest))
