"""Rotations as rotation vectors: axis times angle [rad], right-handed; (0, 0, pi / 2) is a quarter turn about +z.

A thin layer over scipy's `Rotation` for the arrays that the project uses. It is imported inside the functions,
because its import takes longer than that of all else that a command of the benchmark needs.
"""

from __future__ import annotations

import numpy as np


def rotation_matrix(vector: np.ndarray | tuple[float, ...]) -> np.ndarray:
    """Matrices (..., 3, 3) of rotation vectors (..., 3) [rad]."""
    from scipy.spatial.transform import Rotation

    vector = np.asarray(vector, float)
    return Rotation.from_rotvec(vector.reshape(-1, 3)).as_matrix().reshape(*vector.shape, 3)


def rotation_vector(matrix: np.ndarray) -> np.ndarray:
    """Rotation vectors (..., 3) [rad] of matrices (..., 3, 3), with angles from 0 to pi."""
    from scipy.spatial.transform import Rotation

    matrix = np.asarray(matrix, float)
    return Rotation.from_matrix(matrix.reshape(-1, 3, 3)).as_rotvec().reshape(matrix.shape[:-1])


def between(first: np.ndarray, last: np.ndarray, share: float) -> np.ndarray:
    """The rotations (..., 3, 3) at ``share`` (0 to 1) of the shortest way from ``first`` to ``last`` (..., 3, 3), at
    constant angular velocity."""
    return first @ rotation_matrix(share * rotation_vector(np.swapaxes(first, -1, -2) @ last))


def pose_errors(estimate: np.ndarray, truth: np.ndarray) -> tuple[float, float]:
    """Distance between the origins [m] and angle of the relative rotation [rad] of two transforms (4, 4).

    The angle comes from the trace, which also exists for an estimate that is not exactly a rotation.
    """
    relative = estimate[:3, :3].T @ truth[:3, :3]
    cosine = np.clip(0.5 * (np.trace(relative) - 1.0), -1.0, 1.0)
    return float(np.linalg.norm(estimate[:3, 3] - truth[:3, 3])), float(np.arccos(cosine))
