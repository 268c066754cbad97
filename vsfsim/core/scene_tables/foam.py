"""Foams by name: parameters of the hyperfoam law (Ogden and Storåkers), each with its source.

    Psi = sum_i 2 mu_i / alpha_i^2 [ l1^alpha_i + l2^alpha_i + l3^alpha_i - 3 + (J^(-alpha_i beta_i) - 1) / beta_i ]

in the form of Abaqus; beta = nu / (1 - 2 nu) for one term.
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Foam:
    """One foam."""

    mu: tuple[float, ...]
    """Shear moduli of the terms [Pa]."""
    alpha: tuple[float, ...]
    """Exponents of the principal stretches [-]."""
    beta: tuple[float, ...]
    """Exponents of the volume, over alpha [-]."""
    source: str
    """Where the parameters are from."""

    @property
    def lame(self) -> tuple[float, float]:
        """(mu, lambda) of small strains [Pa]."""
        return sum(self.mu), sum(2.0 * m * b for m, b in zip(self.mu, self.beta, strict=True))

    @property
    def young_modulus(self) -> float:
        """Young's modulus of small strains [Pa]."""
        mu, lam = self.lame
        return mu * (3.0 * lam + 2.0 * mu) / (lam + mu)

    @property
    def poisson_ratio(self) -> float:
        """Poisson's ratio of small strains [-]."""
        mu, lam = self.lame
        return 0.5 * lam / (lam + mu)


_NEWTON = "McCulloch, Delp and Kuhl 2026 (arXiv 2602.12694), fitted in the repository jkuzmeski/newton"
_CANN = "LivingMatterLab/CANN, folder FOAM: fit to its compression curve up to a strain of 0.6"

FOAMS: dict[str, Foam] = {
    "ff-leap": Foam((171.8e3, 18.2e3), (8.39, -1.04), (0.0, 0.0), _NEWTON),
    "ff-turbo": Foam((169.0e3, 12.0e3), (5.65, -2.0), (0.0, 0.0), _NEWTON),
    "midsole-heel": Foam((162.1e3, 6.4e3), (6.15, -2.44), (0.0, 0.0), _CANN),
    "midsole": Foam((75.4e3,), (1.62,), (0.0,), _CANN),
    "midsole-worn": Foam((185.3e3, 1.6e3), (4.83, -4.4), (0.0, 0.0), _CANN),
    "pe-foam": Foam((87.2e3, 14.3e3), (7.71, 0.465), (0.076, 0.423),
                    "Kossa and Berezvai 2016 (chauminhvu/fitting-model-parameters): fit to its uniaxial, biaxial and "
                    "lateral data"),
    "poron-125": Foam((24.4e3, 4.18e3), (8.31, 1.39), (0.154, 7.71), "Landauer et al. 2019"),
    "eva": Foam((1050e3,), (4.0,), (0.0,), "Verdejo and Mills 2004, J. Biomech.; beta is assumed"),
}
"""Foams that ``material`` in ``[object]`` of a scene may name."""
