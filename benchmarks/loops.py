"""What a user would write with SciPy and NumPy: the peers of the package.

A plain loop, equation by equation; a loop tuned by hand, and arrays throughout, both on a load
balance reduced to one dimensionless equation. The loops call brentq and numpy.linalg.eigvals, the
arrays take Newton steps for all points at once and give LAPACK all matrices in one call.
"""

import dataclasses
import functools
import math
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np
from scipy.optimize import brentq

import fractaljax as fj

# Of f(k step) - f(-k step), by the order of the difference and k.
WEIGHTS = {2: {1: 1 / 2}, 4: {1: 2 / 3, 2: -1 / 12}}
NEWTON_STEPS = 4  # to the last digit over all surfaces of the pages
STEP = 6e-6  # of the central differences in D and ln G: the cube root of the machine epsilon
Numbers = dict[str, float]


def brake() -> Numbers:
    """The numbers of the reference brake."""
    scene: Any = fj.brake_scene()
    parts = (scene.contact.surface, scene.contact.material, scene.friction, scene.oscillator)
    numbers = {f.name: getattr(part, f.name) for part in parts for f in dataclasses.fields(part)}
    return {name: float(value) for name, value in (numbers | {"P": scene.contact.P}).items()}


# Equation by equation


def plain_loop(b: Numbers) -> Callable[[float, float], tuple[Any, ...]]:
    """The body of a loop as a user writes it, of (D, G).

    Growth rate [1/s], |eigenvalue|, regime, K_n [N/m], ln(a_l/a_e) and Q_e/(mu_s P).
    """
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


# The reduced load balance, for scalars and for arrays


def by_brentq(load, half, r, factor, xtol=1e-15) -> float:
    """t = ln(a_l/a_e) of one joint; 0 where it is fully plastic."""
    if load <= 0:
        return 0.0
    expm1, log1p = math.expm1, math.log1p

    def residual(t):
        return half * t + log1p(factor * (expm1(r * t) / r if r else t)) - load

    t: Any = brentq(residual, 0.0, load / half, xtol=xtol, rtol=np.float64(1e-15))
    return t


def by_newton(load, half, r, factor):
    """The same of many joints."""
    load = np.maximum(load, 0)
    t = load / half
    for _ in range(NEWTON_STEPS):
        elastic = 1 + factor * ARRAYS.power(r, t)
        residual = half * t + np.log(elastic) - load
        t = t - residual / (half + factor * np.exp(r * t) / elastic)
    return t


SCALARS = SimpleNamespace(
    exp=math.exp,
    log=math.log,
    cbrt=math.cbrt,
    positive=lambda x: max(x, 0.0),
    power=lambda q, t: math.expm1(q * t) / q if q else t,
)
ARRAYS = SimpleNamespace(
    exp=np.exp,
    log=np.log,
    cbrt=np.cbrt,
    positive=lambda x: np.maximum(x, 0),
    power=lambda q, t: np.where(q == 0, t, np.expm1(q * t) / np.where(q == 0, 1, q)),
)


def joint(b: Numbers, of: SimpleNamespace, solve: Callable) -> Callable:
    """(D, G) to ln a_l, K_n, K_t, the load above fully plastic and 1 - Q_e/(mu_s P).

    Constants are taken out. A load of at most 0 is fully plastic.
    """
    exp, log, power, positive, cbrt = of.exp, of.log, of.power, of.positive, of.cbrt
    E, nu, sigma_y, H, P = b["E"], b["nu"], b["sigma_y"], b["H"], b["P"]
    mu_s, mu_m = b["mu_s"], b["mu_m"]
    k_mu = 1 - 0.228 * mu_m if mu_m <= 0.3 else 0.932 * math.exp(-1.58 * (mu_m - 0.3))
    log_2, log_pi, log_log_gamma = math.log(2), math.log(math.pi), math.log(math.log(b["gamma"]))
    log_yield = 2 * math.log(33 * k_mu * sigma_y / E / 40)
    normal_factor = 4 * E / (3 * math.sqrt(math.pi))
    tangential_factor = 8 / (math.pi * (6 - 3 * nu)) / (mu_s * P)
    shear_factor = 4 * E / ((1 + nu) * (2 - nu) * math.sqrt(math.pi))

    def at(D, G):
        log_a_e = log_yield + (3 * D - 11) * log_2 + (4 - D) * log_pi - log_log_gamma
        log_a_e = log_a_e / (2 - D) + 2 * log(G)
        load = log(P * (3 - D) / (H * (D - 1))) - log_a_e
        half, r = (D - 1) / 2, (5 - 2 * D) / 2
        factor = 1.1 * k_mu * sigma_y / H * (3 - D) / 2
        t = solve(load, half, r, factor)

        def moment(p):
            return half * exp(p * log_a_e + half * t) * power(p - half, t)

        J, ratio = moment(0.5), factor * power(r, t)
        elastic_load = P * ratio / (1 + ratio)
        Q_e = sigma_y * moment(1.0) + (2 * nu - 1) * elastic_load
        grip = 1 - tangential_factor * Q_e
        K_t = shear_factor * cbrt(positive(grip)) * J
        return log_a_e + t, normal_factor * (4 - D) / (3 - D) * J, K_t, load, grip

    return at


def scalar_joint(b: Numbers, xtol: float = 1e-15) -> Callable:
    """`joint` of one surface, by brentq to this tolerance."""
    return joint(b, SCALARS, functools.partial(by_brentq, xtol=xtol))


def state_matrices(b: Numbers) -> Callable:
    """(K_n, K_t) to the matrices (..., 4, 4) of Eq. 43."""
    m, f = b["m"], b["F"] / math.sqrt(2)
    k_1, k_2 = m * b["omega_1"] ** 2, m * b["omega_2"] ** 2
    c_1, c_2 = 2 * b["xi_1"] * b["omega_1"], 2 * b["xi_2"] * b["omega_2"]
    drop, u = b["mu_s"] - b["mu_m"], b["V"] / b["v_m"]
    mu, slope = b["mu_s"] + drop * u * (u * u - 3) / 2, 1.5 * drop / b["v_m"] * (u * u - 1)

    def at(K_n, K_t):
        s_1, s_2 = k_1 + K_t, k_2 + K_n
        force = slope * f / (s_1 * s_2 + mu * mu * K_n * K_t) / m
        zero, one = 0 * K_n, 0 * K_n + 1
        rows = [
            [zero, zero, one, zero],
            [zero, zero, zero, one],
            [-s_1 / m, mu * K_n / m, force * K_n * (s_1 + mu * K_t) - c_1, zero],
            [-mu * K_t / m, -s_2 / m, zero, force * K_t * (s_2 - mu * K_n) - c_2],
        ]
        return np.moveaxis(np.array(rows), -1, 0) if np.ndim(K_n) else np.array(rows)

    return at


def tuned_loop(b: Numbers) -> Callable[[float, float], tuple[float, float, str]]:
    """The body of a loop tuned by hand: (D, G) to growth rate [1/s], |eigenvalue| and regime."""
    at, matrix = scalar_joint(b), state_matrices(b)

    def growth(D, G):
        _, K_n, K_t, load, grip = at(D, G)
        regime = "fully plastic" if load <= 0 else "elastic-plastic" if grip > 0 else "gross slip"
        s = max(np.linalg.eigvals(matrix(K_n, K_t)).tolist(), key=lambda s: s.real)
        return s.real, abs(s), regime

    return growth


def arrays(b: Numbers) -> Callable[[np.ndarray, np.ndarray], np.ndarray]:
    """D and G (n,) to growth rates (n,) [1/s], with no loop over points."""
    at, matrices = joint(b, ARRAYS, by_newton), state_matrices(b)
    return lambda D, G: np.real(np.linalg.eigvals(matrices(*at(D, G)[1:3]))).max(axis=1)


# Values and differences


def differences(growth: Callable, D, G, step: float, order: int) -> list[Any]:
    """Value and derivatives to D and ln G, by central differences."""
    by_D, by_log_G = 0, 0
    for k, weight in WEIGHTS[order].items():
        move, up = k * step, math.exp(k * step)
        by_D = by_D + weight / step * (growth(D + move, G) - growth(D - move, G))
        by_log_G = by_log_G + weight / step * (growth(D, G * up) - growth(D, G / up))
    return [growth(D, G), by_D, by_log_G]
