"""The hyperfoam law of `vsfsim/physics/laws/hyperfoam.py`, written anew: its energy, stress and moduli from F^T F.

    Psi = sum_i 2 mu_i / alpha_i^2 [ tr C^(alpha_i / 2) - 3 + (J^(-alpha_i beta_i) - 1) / beta_i ],    C = F^T F
    S = 2 dPsi/dC = sum_i 2 mu_i / alpha_i [ C^(alpha_i / 2 - 1) - J^(-alpha_i beta_i) C^-1 ],    P = F S

(Storakers 1986; for beta_i = 0 the last term of Psi is -alpha_i ln J.) Powers of C are differentiated by the divided
differences of its eigenvalues (Daleckii and Krein 1965). NumPy only: nothing of `vsfsim` is used.
"""

from __future__ import annotations

import numpy as np


def energy(f: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """Psi (...,) [Pa] of deformation gradients (..., 3, 3) [-]; ``rows`` (k, 3) are mu [Pa], alpha and beta."""
    w, j = np.linalg.eigvalsh(np.swapaxes(f, -1, -2) @ f), np.linalg.det(f)
    out = np.zeros(j.shape)
    for mu, alpha, beta in rows:
        volume = -alpha * np.log(j) if beta == 0.0 else (j ** (-alpha * beta) - 1.0) / beta
        out += 2.0 * mu / alpha**2 * ((w ** (0.5 * alpha)).sum(axis=-1) - 3.0 + volume)
    return out


def stress(f: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """The first Piola-Kirchhoff stress (..., 3, 3) [Pa]."""
    return f @ _second(*_parts(f), rows)


def moduli(f: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """Its derivative dP_ij / dF_kl (..., 3, 3, 3, 3) [Pa]."""
    w, n, j, inverse = _parts(f)
    second, across = _second(w, n, j, inverse, rows), np.swapaxes(f, -1, -2)
    near = np.abs(w[..., :, None] - w[..., None, :]) < 1e-6 * w[..., :, None]
    gap = np.where(near, 1.0, w[..., :, None] - w[..., None, :])
    middle = 0.5 * (w[..., :, None] + w[..., None, :])
    out = np.zeros((*f.shape, 3, 3))
    for k in range(3):
        for m in range(3):
            change = np.zeros_like(f)
            change[..., k, m] = 1.0
            dc = np.swapaxes(change, -1, -2) @ f + across @ change
            turned = np.swapaxes(n, -1, -2) @ dc @ n
            volume = 0.5 * np.einsum("...ij,...ji->...", inverse, dc)[..., None, None]
            ds = np.zeros_like(f)
            for mu, alpha, beta in rows:
                p = 0.5 * alpha - 1.0
                slope = np.where(near, p * middle ** (p - 1.0), (w[..., :, None] ** p - w[..., None, :] ** p) / gap)
                size = (j ** (-alpha * beta))[..., None, None]
                ds += 2.0 * mu / alpha * (n @ (slope * turned) @ np.swapaxes(n, -1, -2)
                                          + size * (alpha * beta * volume * inverse + inverse @ dc @ inverse))
            out[..., k, m] = change @ second + f @ ds
    return out


def _parts(f: np.ndarray) -> tuple[np.ndarray, ...]:
    """Eigenvalues and eigenvectors of C, J and the inverse of C."""
    c = np.swapaxes(f, -1, -2) @ f
    return *np.linalg.eigh(c), np.linalg.det(f), np.linalg.inv(c)


def _second(w: np.ndarray, n: np.ndarray, j: np.ndarray, inverse: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """The second Piola-Kirchhoff stress (..., 3, 3) [Pa]."""
    out = np.zeros_like(inverse)
    for mu, alpha, beta in rows:
        power = (n * (w ** (0.5 * alpha - 1.0))[..., None, :]) @ np.swapaxes(n, -1, -2)
        out += 2.0 * mu / alpha * (power - (j ** (-alpha * beta))[..., None, None] * inverse)
    return out
