"""Rotations as rotation vectors: axis times angle [rad], right-handed; (0, 0, pi / 2) is a quarter turn about +z."""

from __future__ import annotations

import math

import numpy as np


def rotation_matrix(vector: np.ndarray | tuple[float, ...]) -> np.ndarray:
    """Matrix (3, 3) of a rotation vector (3,) [rad] (Rodrigues)."""
    v = np.asarray(vector, float)
    angle = float(np.linalg.norm(v))
    if angle == 0.0:
        return np.eye(3)
    x, y, z = v / angle
    k = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.eye(3) + np.sin(angle) * k + (1.0 - np.cos(angle)) * (k @ k)


def rotation_vector(matrix: np.ndarray) -> np.ndarray:
    """Rotation vector (3,) [rad] of a matrix (3, 3), its angle from 0 to pi; through the quaternion, exact to rounding
    near both ends."""
    # as Python's numbers: nine of them are not worth numpy's overhead, and inverse kinematics asks a hundred times a
    # pose
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = np.asarray(matrix, float).tolist()
    # the largest of the four squares makes the others safe to divide (Shepperd 1978)
    squares = (1 + xx + yy + zz, 1 + xx - yy - zz, 1 - xx + yy - zz, 1 - xx - yy + zz)
    a, b, c = zy - yz, xz - zx, yx - xy
    d, e, f = yx + xy, xz + zx, zy + yz
    rows = ((squares[0], a, b, c), (a, squares[1], d, e), (b, d, squares[2], f), (c, e, f, squares[3]))
    q = np.array(rows[squares.index(max(squares))])
    q /= math.sqrt(q.dot(q))
    if q[0] < 0.0:
        q = -q
    axis = q[1:]
    sine = math.sqrt(axis.dot(axis))
    if sine == 0.0:
        return np.zeros(3)
    return 2.0 * np.arctan2(sine, q[0]) * axis / sine


def between(first: np.ndarray, last: np.ndarray, share: float) -> np.ndarray:
    """The rotation (3, 3) at ``share`` (0..1) of the shortest way from ``first`` to ``last`` (3, 3), at constant
    angular velocity."""
    return first @ rotation_matrix(share * rotation_vector(first.T @ last))


def pose_errors(estimate: np.ndarray, truth: np.ndarray) -> tuple[float, float]:
    """Distance between the origins [m] and angle of the relative rotation [rad] of two transforms (4, 4)."""
    turn = estimate[:3, :3].T @ truth[:3, :3]
    return float(np.linalg.norm(estimate[:3, 3] - truth[:3,
                                                        3])), float(np.arccos(np.clip(0.5 * (np.trace(turn) - 1.0),
                                                                                      -1.0, 1.0)))
