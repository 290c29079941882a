"""What a user would write with SciPy and NumPy: the peers of the package.

Two loops over brentq and numpy.linalg.eigvals, and the quickest: arrays throughout, with Newton's
steps on the load balance of all points at once and one call of LAPACK for all matrices.
"""

import dataclasses
import math
from collections.abc import Callable
from typing import Any

import numpy as np
from scipy.optimize import brentq

import fractaljax as fj

# Of f(k step) - f(-k step), by the order of the difference and k.
WEIGHTS = {2: {1: 1 / 2}, 4: {1: 2 / 3, 2: -1 / 12}}
NEWTON_STEPS = 4  # to the last digit over all surfaces of the page
STEP = 6e-6  # of the central differences in D and ln G: the cube root of a double's last bit


def brake() -> dict[str, float]:
    """The numbers of the reference brake."""
    scene: Any = fj.brake_scene()
    parts = (scene.contact.surface, scene.contact.material, scene.friction, scene.oscillator)
    numbers = {f.name: getattr(part, f.name) for part in parts for f in dataclasses.fields(part)}
    return {name: float(value) for name, value in (numbers | {"P": scene.contact.P}).items()}


def tuned_loop(b: dict[str, float]) -> Callable[[float, float], tuple[float, float, str]]:
    """The body of a loop tuned by hand: (D, G) to growth rate [1/s], |eigenvalue| and regime.

    Everything constant taken out, the load balance reduced to one dimensionless number, scalars
    of the math module instead of NumPy's.
    """
    exp, log, log1p, expm1 = math.exp, math.log, math.log1p, math.expm1
    E, nu, sigma_y, H, P = b["E"], b["nu"], b["sigma_y"], b["H"], b["P"]
    mu_s, mu_m, m = b["mu_s"], b["mu_m"], b["m"]
    k_mu = 1 - 0.228 * mu_m if mu_m <= 0.3 else 0.932 * exp(-1.58 * (mu_m - 0.3))
    log_2, log_pi, log_log_gamma = log(2), log(math.pi), log(log(b["gamma"]))
    log_yield = 2 * log(33 * k_mu * sigma_y / E / 40)
    tangential_factor = 8 / (math.pi * (6 - 3 * nu))
    shear_factor = 8 * E / (2 * (1 + nu)) / ((2 - nu) * math.sqrt(math.pi))
    k_1, k_2 = m * b["omega_1"] ** 2, m * b["omega_2"] ** 2
    c_1, c_2 = 2 * b["xi_1"] * b["omega_1"], 2 * b["xi_2"] * b["omega_2"]
    drop, u = mu_s - mu_m, b["V"] / b["v_m"]
    mu, slope = mu_s + drop * u * (u * u - 3) / 2, 1.5 * drop / b["v_m"] * (u * u - 1)
    f = b["F"] / math.sqrt(2)

    def stiffness(D, G):
        log_a_e = (log_yield + (3 * D - 11) * log_2 + (4 - D) * log_pi - log_log_gamma) / (
            2 - D
        ) + 2 * log(G)
        load = log(P * (3 - D) / (H * (D - 1))) - log_a_e
        if load <= 0:
            return 0.0, 0.0, "fully plastic"
        half, r = (D - 1) / 2, (5 - 2 * D) / 2
        factor = 1.1 * k_mu * sigma_y / H * (3 - D) / 2

        def excess(t):
            power = expm1(r * t) / r if r else t
            return half * t + log1p(factor * power) - load

        t = brentq(excess, 0.0, load / half, xtol=1e-15, rtol=np.float64(1e-15))

        def moment(p):
            q = p - half
            return half * exp(p * log_a_e + half * t) * (expm1(q * t) / q if q else t)

        J = moment(0.5)
        K_n = 4 * E * (4 - D) / (3 * math.sqrt(math.pi) * (3 - D)) * J
        ratio = factor * (expm1(r * t) / r if r else t)
        elastic_load = P * ratio / (1 + ratio)
        Q_e = tangential_factor * (sigma_y * moment(1.0) + (2 * nu - 1) * elastic_load)
        grip = 1 - Q_e / (mu_s * P)
        if grip <= 0:
            return K_n, 0.0, "gross slip"
        return K_n, shear_factor * math.cbrt(grip) * J, "elastic-plastic"

    def growth(D, G):
        K_n, K_t, regime = stiffness(D, G)
        s_1, s_2 = k_1 + K_t, k_2 + K_n
        determinant = s_1 * s_2 + mu * mu * K_n * K_t
        x_1 = f * (s_2 - mu * K_n) / determinant
        x_2 = -f * (s_1 + mu * K_t) / determinant
        matrix = np.array(
            [
                [0.0, 0.0, 1.0, 0.0],
                [0.0, 0.0, 0.0, 1.0],
                [-s_1 / m, mu * K_n / m, -c_1 - slope * K_n * x_2 / m, 0.0],
                [-mu * K_t / m, -s_2 / m, 0.0, -c_2 + slope * K_t * x_1 / m],
            ]
        )
        s = max(np.linalg.eigvals(matrix).tolist(), key=lambda s: s.real)
        return s.real, abs(s), regime

    return growth


def plain_loop(b: dict[str, float]) -> Callable[[float, float], tuple[float, float, str]]:
    """The body of a loop as a user writes it, equation by equation with NumPy; as `tuned_loop`."""
    numbers = plain_numbers(b)
    return lambda D, G: numbers(D, G)[:3]


def plain_numbers(b: dict[str, float]) -> Callable[[float, float], tuple[Any, ...]]:
    """The same with what a design asks for: K_n [N/m], ln(a_l/a_e) and Q_e/(mu_s P) follow."""
    E, nu, sigma_y, H, P, gamma = (b[n] for n in ("E", "nu", "sigma_y", "H", "P", "gamma"))
    mu_s, mu_m, v_m, V, F, m = (b[n] for n in ("mu_s", "mu_m", "v_m", "V", "F", "m"))
    omega = np.array([b["omega_1"], b["omega_2"]])
    xi = np.array([b["xi_1"], b["xi_2"]])

    def power_integral(p, D, a_l, a_e):
        r = p + (1 - D) / 2
        if abs(r) < 1e-12:
            return (D - 1) / 2 * a_l ** ((D - 1) / 2) * np.log(a_l / a_e)
        return (D - 1) / 2 * a_l ** ((D - 1) / 2) * (a_l**r - a_e**r) / r

    def stiffness(D, G):
        k_mu = 1 - 0.228 * mu_m if mu_m <= 0.3 else 0.932 * np.exp(-1.58 * (mu_m - 0.3))
        log_a_e = (
            2 * np.log(33 * k_mu * sigma_y / E / 40)
            + (3 * D - 11) * np.log(2)
            + (4 - D) * np.log(np.pi)
            - np.log(np.log(gamma))
        ) / (2 - D) + 2 * np.log(G)
        a_e, a_plastic = np.exp(log_a_e), (3 - D) / (D - 1) * P / H
        if a_plastic <= a_e:
            return 0.0, 0.0, "fully plastic", np.log(a_plastic / a_e), 0.0
        c_e = E / 3 * np.pi ** ((D - 4) / 2) * 2 ** ((15 - 3 * D) / 2)
        c_e = c_e * np.sqrt(np.log(gamma)) * G ** (D - 2)

        def load(a_l):
            plastic = (D - 1) / (3 - D) * H * a_l ** ((D - 1) / 2) * a_e ** ((3 - D) / 2)
            return plastic + c_e * power_integral((4 - D) / 2, D, a_l, a_e)

        top = log_a_e + 2 / (D - 1) * np.log(a_plastic / a_e)
        log_a_l: Any = brentq(lambda x: np.log(load(np.exp(x)) / P), log_a_e, top, xtol=1e-14)
        a_l = np.exp(log_a_l)
        root_integral = power_integral(0.5, D, a_l, a_e)
        K_n = 4 * E * (4 - D) / (3 * np.sqrt(np.pi) * (3 - D)) * root_integral
        elastic_load = c_e * power_integral((4 - D) / 2, D, a_l, a_e)
        Q_e = sigma_y * power_integral(1, D, a_l, a_e) + (2 * nu - 1) * elastic_load
        Q_e = 8 / (np.pi * (6 - 3 * nu)) * Q_e
        ratios = log_a_l - log_a_e, Q_e / (mu_s * P)
        if Q_e >= mu_s * P:
            return K_n, 0.0, "gross slip", *ratios
        shear_modulus = E / (2 * (1 + nu))
        K_t = 8 * shear_modulus / ((2 - nu) * np.sqrt(np.pi)) * root_integral
        return K_n, K_t * np.cbrt(1 - Q_e / (mu_s * P)), "elastic-plastic", *ratios

    def growth(D, G):
        K_n, K_t, regime, *ratios = stiffness(D, G)
        drop = mu_s - mu_m
        mu = mu_s - 3 * drop / (2 * v_m) * V + drop / (2 * v_m**3) * V**3
        slope = -3 * drop / (2 * v_m) + 3 * drop / (2 * v_m**3) * V**2
        K = np.diag(m * omega**2) + np.array([[K_t, -mu * K_n], [mu * K_t, K_n]])
        x_1, x_2 = np.linalg.solve(K, np.array([F, -F]) / np.sqrt(2))
        C = np.diag(2 * xi * omega * m + slope * np.array([K_n * x_2, -K_t * x_1]))
        A = np.block([[np.zeros((2, 2)), np.eye(2)], [-K / m, -C / m]])
        eigenvalues = np.linalg.eigvals(A)
        critical = eigenvalues[eigenvalues.real.argmax()]
        return critical.real, abs(critical), regime, K_n, *ratios

    return growth


def arrays(b: dict[str, float]) -> Callable[[np.ndarray, np.ndarray], np.ndarray]:
    """D and G (n,) to growth rates (n,) [1/s]: as `tuned_loop`, with no loop over points."""
    E, nu, sigma_y, H, P, m = (b[n] for n in ("E", "nu", "sigma_y", "H", "P", "m"))
    k_mu = 1 - 0.228 * b["mu_m"]  # up to mu_m = 0.3, where this brake is
    f = b["F"] / math.sqrt(2)
    k_1, k_2 = m * b["omega_1"] ** 2, m * b["omega_2"] ** 2
    c_1, c_2 = 2 * b["xi_1"] * b["omega_1"], 2 * b["xi_2"] * b["omega_2"]
    drop, u = b["mu_s"] - b["mu_m"], b["V"] / b["v_m"]
    mu, slope = b["mu_s"] + drop * u * (u * u - 3) / 2, 1.5 * drop / b["v_m"] * (u * u - 1)

    def power(q, t):
        return np.where(q == 0, t, np.expm1(q * t) / np.where(q == 0, 1, q))

    def stiffness(D, G):
        log_a_e = 2 * math.log(33 * k_mu * sigma_y / E / 40) + (3 * D - 11) * math.log(2)
        log_a_e += (4 - D) * math.log(math.pi) - math.log(math.log(b["gamma"]))
        log_a_e = log_a_e / (2 - D) + 2 * np.log(G)
        # Where it is below 0 the joint is fully plastic, and at 0 has no stiffness either.
        load = np.maximum(np.log(P * (3 - D) / (H * (D - 1))) - log_a_e, 0)
        half, r = (D - 1) / 2, (5 - 2 * D) / 2
        factor = 1.1 * k_mu * sigma_y / H * (3 - D) / 2
        t = load / half
        for _ in range(NEWTON_STEPS):
            elastic = 1 + factor * power(r, t)
            excess = half * t + np.log(elastic) - load
            t = t - excess / (half + factor * np.exp(r * t) / elastic)

        def moment(p):
            return half * np.exp(p * log_a_e + half * t) * power(p - half, t)

        J, ratio = moment(0.5), factor * power(r, t)
        K_n = 4 * E * (4 - D) / (3 * math.sqrt(math.pi) * (3 - D)) * J
        Q_e = sigma_y * moment(1.0) + (2 * nu - 1) * P * ratio / (1 + ratio)
        grip = np.maximum(1 - 8 / (math.pi * (6 - 3 * nu)) * Q_e / (b["mu_s"] * P), 0)
        return K_n, 4 * E / ((1 + nu) * (2 - nu) * math.sqrt(math.pi)) * np.cbrt(grip) * J

    def growth(D, G):
        K_n, K_t = stiffness(D, G)
        s_1, s_2 = k_1 + K_t, k_2 + K_n
        determinant = s_1 * s_2 + mu * mu * K_n * K_t
        A = np.zeros((len(D), 4, 4))
        A[:, 0, 2] = A[:, 1, 3] = 1
        A[:, 2, 0], A[:, 2, 1], A[:, 3, 0], A[:, 3, 1] = -s_1, mu * K_n, -mu * K_t, -s_2
        A[:, 2:] /= m
        A[:, 2, 2] = -c_1 + slope * K_n / m * f * (s_1 + mu * K_t) / determinant
        A[:, 3, 3] = -c_2 + slope * K_t / m * f * (s_2 - mu * K_n) / determinant
        return np.linalg.eigvals(A).real.max(axis=1)

    return growth


def differences(growth, D: np.ndarray, G: np.ndarray, step: float, order: int) -> np.ndarray:
    """Value and derivatives to D and ln G (n, 3) of `arrays`, by central differences."""
    by_D, by_log_G = 0, 0
    for k, weight in WEIGHTS[order].items():
        move, up = k * step, math.exp(k * step)
        by_D = by_D + weight / step * (growth(D + move, G) - growth(D - move, G))
        by_log_G = by_log_G + weight / step * (growth(D, G * up) - growth(D, G / up))
    return np.stack([growth(D, G), by_D, by_log_G], axis=1)


def loop_value(growth, D: list[float], G: list[float]) -> np.ndarray:
    """Growth rates (n,) of the loop."""
    return np.array([growth(d, g)[0] for d, g in zip(D, G, strict=True)])


def loop_gradient(growth, D: list[float], G: list[float]) -> np.ndarray:
    """Value and derivatives to D and ln G (n, 3) of the loop, by central differences."""
    rows, up = [], math.exp(STEP)
    for d, g in zip(D, G, strict=True):
        by_D = (growth(d + STEP, g)[0] - growth(d - STEP, g)[0]) / (2 * STEP)
        by_log_G = (growth(d, g * up)[0] - growth(d, g / up)[0]) / (2 * STEP)
        rows.append((growth(d, g)[0], by_D, by_log_G))
    return np.array(rows)
