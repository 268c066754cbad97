"""Closed forms of membranes, plates, gas and contact: recomputes hencky.json, blown_disc.json, gas_sphere.json,
plate.json and hertz_layer.json.

    python -m references.closed_forms        # prints each value beside the stored one

NumPy and SciPy only: nothing of `vsfsim` is used.
"""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
from scipy.integrate import solve_bvp, solve_ivp
from scipy.optimize import brentq

from references import load

_NEAR = 1e-6  # radius at which an integration from the pole starts, over the disc's radius


def hencky(poisson_ratio: float) -> tuple[float, float]:
    """(C, c_V) of Hencky's membrane: w0 = C (p a^4 / (E h))^(1/3), V = c_V pi a^2 w0.

    Equilibrium and compatibility of a membrane of small slope, with a = p = E h = 1 and the radial tension S(r):
    w' = -r / (2 S), r S'' + 3 S' = -r / (8 S^2), S'(0) = 0, S'(1) + (1 - nu) S(1) = 0 (clamped rim).
    """
    def integrate(centre: float) -> np.ndarray:
        # State: S, S', the integral of r / (2 S), which is w0 - w, and the integral of (w0 - w) r.
        def slope(r: float, y: np.ndarray) -> list[float]:
            return [y[1], -1.0 / (8.0 * y[0] ** 2) - 3.0 * y[1] / r, r / (2.0 * y[0]), y[2] * r]

        start = [centre, -_NEAR / (32.0 * centre**2), 0.0, 0.0]
        return solve_ivp(slope, (_NEAR, 1.0), start, rtol=1e-11, atol=1e-13).y[:, -1]

    def rim(centre: float) -> float:
        y = integrate(centre)
        return y[1] + (1.0 - poisson_ratio) * y[0]

    _, _, height, lost = integrate(brentq(rim, 0.3, 2.0, xtol=1e-13))
    return height, 1.0 - 2.0 * lost / height


def blown_disc(pole_stretch: float) -> tuple[float, float, float]:
    """(p a / (mu h), w0 / a, V / a^3) of a flat neo-Hookean disc inflated to a stretch at its pole.

    Membrane equilibrium of Adkins and Rivlin (1952) over the undeformed radius R, with the angle of the meridian as an
    unknown, so that the dome may overhang its rim: lambda_1 and lambda_2 = r / R are the principal stretches,
    T_1 = mu h (lambda_1 / lambda_2 - (lambda_1 lambda_2)^-3) is the meridional tension, a = mu h = 1.
    """
    def integrate(pressure: float) -> np.ndarray:
        def slope(radius: float, y: np.ndarray) -> list[float]:
            first, r, angle = y[0], y[1], y[2]
            second = r / radius
            thin = (first * second) ** -3
            meridian, hoop = first / second - thin, second / first - thin
            widen = (first * math.cos(angle) - second) / radius
            change = first * math.cos(angle) * (hoop - meridian) / r
            slope = 1.0 / second + 3.0 * thin / first
            stretch = (change - (-first / second**2 + 3.0 * thin / second) * widen) / slope
            curvature = (pressure - hoop * math.sin(angle) / r) / meridian
            down = first * math.sin(angle)
            return [stretch, first * math.cos(angle), first * curvature, down, math.pi * r**2 * down]

        tension = 1.0 - pole_stretch**-6
        start = [pole_stretch, pole_stretch * _NEAR, pole_stretch * _NEAR * pressure / (2.0 * tension), 0.0, 0.0]
        return solve_ivp(slope, (_NEAR, 1.0), start, rtol=1e-10, atol=1e-12).y[:, -1]

    def rim(pressure: float) -> float:
        return integrate(pressure)[1] - 1.0

    scan = np.linspace(0.0, 2.5, 26)
    low, high = next((a, b) for a, b in pairwise(scan) if rim(a) > 0.0 >= rim(b))
    pressure = brentq(rim, low, high, xtol=1e-12)
    _, _, _, height, volume = integrate(pressure)
    return pressure, height, volume


def gas_sphere(ambient_ratio: float, gamma: float, *, radius: float, mu_h: float, ambient: float,
               stretch: float) -> tuple[float, float]:
    """(stretch, gauge pressure [Pa]) of a sealed neo-Hookean sphere after a change of the ambient pressure.

    p = 2 mu h / R (1 / s - 1 / s^7); (p + ambient) V^gamma stays what it was at ``stretch`` and ``ambient``.
    """
    def gauge(s: float) -> float:
        return 2.0 * mu_h / radius * (1.0 / s - s**-7)

    kept = (gauge(stretch) + ambient) * stretch ** (3.0 * gamma)
    found = brentq(lambda s: (gauge(s) + ambient_ratio * ambient) * s ** (3.0 * gamma) - kept, 1.05, 2.0, xtol=1e-14)
    return found, gauge(found)


def plate(load_: float, *, young_modulus: float, thickness: float, radius: float, poisson_ratio: float) -> float:
    """Deflection [m] of the centre of a circular plate under an even load [Pa], whose rim is held and may rotate.

    Foeppl's and von Karman's equations: D ((r w')' / r)' = S w' + q r / 2, r S'' + 3 S' = -E h w'^2 / (2 r), with
    w'(0) = S'(0) = 0, a w''(a) + nu w'(a) = 0 and a S'(a) + (1 - nu) S(a) = 0. Lengths are in radii, deflections in
    thicknesses.
    """
    nu = poisson_ratio
    scale = 12.0 * (1.0 - nu**2)
    force = load_ * radius**4 / (young_modulus * thickness**4) * scale

    def slope(r: np.ndarray, y: np.ndarray) -> np.ndarray:
        # State: w, k = w' / r, m = (r w')' / r = 2 k + r k', S (a^2 / D), S'; without the terms in 1 / r.
        _, k, _, s, ds = y
        return np.stack([r * k, 0.0 * k, r * (s * k + 0.5 * force), ds, -0.5 * scale * k**2])

    singular = np.zeros((5, 5))
    singular[1, 1], singular[1, 2], singular[4, 4] = -2.0, 1.0, -3.0  # k' = (m - 2 k) / r, S'' = ... - 3 S' / r

    def ends(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        return np.array([a[2] - 2.0 * a[1], a[4], b[0], b[2] - (1.0 - nu) * b[1], b[4] + (1.0 - nu) * b[3]])

    r = np.linspace(0.0, 1.0, 101)
    height = min(force / 16.0, 2.0)
    guess = height * np.stack([(1.0 - r**2) ** 2, -4.0 * (1.0 - r**2), -8.0 + 16.0 * r**2, 0.0 * r, 0.0 * r])
    found = solve_bvp(slope, ends, r, guess, S=singular, tol=1e-8, max_nodes=20_000)
    if not found.success:
        raise RuntimeError(found.message)
    return float(found.y[0, 0]) * thickness


def hertz_layer(depth: float, *, young_modulus: float, poisson_ratio: float, radius: float,
                height: float) -> tuple[float, float]:
    """Normal force [N] on a rigid sphere pressed into a bonded layer: Hertz's law, and with the correction for the
    layer's height of Dimitriadis et al. (Biophys. J. 82, 2002, eq. 8)."""
    nu = poisson_ratio
    alpha = -(1.2876 - 1.4678 * nu + 1.3442 * nu**2) / (1.0 - nu)
    beta = (0.6387 - 1.0277 * nu + 1.5164 * nu**2) / (1.0 - nu)
    x = math.sqrt(radius * depth) / height / math.pi
    hertz = 4.0 / 3.0 * young_modulus / (1.0 - nu**2) * math.sqrt(radius) * depth**1.5
    series = (1.0 - 2.0 * alpha * x + 4.0 * alpha**2 * x**2 - 8.0 * (alpha**3 + 4.0 * math.pi**2 / 15.0 * beta) * x**3
              + 16.0 * alpha * (alpha**3 + 3.0 * math.pi**2 / 5.0 * beta) * x**4)
    return hertz, hertz * series


def comparisons() -> list[tuple[str, float, float]]:
    """(what, value computed here, value stored) of all of them."""
    out = []
    for nu, stored in load("hencky")["coefficients"].items():
        c, c_v = hencky(float(nu))
        out += [(f"hencky, nu {nu}, C", c, stored["C"]), (f"hencky, nu {nu}, c_V", c_v, stored["c_V"])]
    for row in load("blown_disc")["rows"]:
        for name, value in zip(("pressure", "height", "volume"), blown_disc(row["pole_stretch"]), strict=True):
            out.append((f"blown disc, pole stretch {row['pole_stretch']}, {name}", value, row[name]))
    data = load("gas_sphere")
    given = data["setting"]
    for row in data["rows"]:
        stretch, pressure = gas_sphere(row["ambient_ratio"], row["gamma"], radius=given["radius_m"],
                                       mu_h=given["mu_h_N_per_m"], ambient=given["ambient_Pa"],
                                       stretch=given["stretch"])
        name = f"gas sphere, ambient x {row['ambient_ratio']}, gamma {row['gamma']}"
        out += [(f"{name}, stretch", stretch, row["stretch"]), (f"{name}, Pa", pressure, row["gauge_pressure_Pa"])]
    top = 7.0 ** (1.0 / 6.0)
    out.append(("gas sphere, largest p R / (mu h)", 2.0 * (1.0 / top - top**-7),
                data["limit_pressure_over_mu_h_per_R0"]))
    data = load("plate")
    given = {key.rsplit("_", 1)[0] if key.endswith(("_Pa", "_m")) else key: value
             for key, value in data["setting"].items()}
    out += [(f"plate, {q} Pa", plate(q, **given), w)
            for q, w in zip(data["load_Pa"], data["deflection_m"], strict=True)]
    data = load("hertz_layer")
    given = data["setting"]
    hertz, force = hertz_layer(data["depth_m"][0], young_modulus=given["young_modulus_Pa"],
                               poisson_ratio=given["poisson_ratio"], radius=given["sphere_radius_m"],
                               height=given["block_m"][2])
    out += [("hertz", hertz, data["hertz_without_correction_N"]), ("hertz, layer", force, data["force_N"][0])]
    return out


if __name__ == "__main__":
    for what, computed, stored in comparisons():
        print(f"{what:<45}{computed:14.6g}{stored:14.6g}{computed / stored - 1.0:+11.1e}")
