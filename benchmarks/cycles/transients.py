"""The tanh law run until it repeats: what a user of an integrator would write.

Units are 1/omega and V/omega, omega^2 = K_n/m; sgn v is tanh(v/eps), eps = share V. Every run gives
times and values of the last extremes of x1.
"""

import dataclasses
import functools
import math
from collections.abc import Callable
from typing import Any

import diffrax
import jax.numpy as jnp
import numpy as np
from scipy.integrate import solve_ivp

from ..timing import compiled
from .reference import K_N, KAPPA, MU_M, MU_S, OSCILLATOR, PERIOD, SCALE, V_M, V

CAP = 8  # longest step of a Taylor series, in eps: dv/dt is of order 1, so no layer is jumped
# Periods by eps/V, after which the transient is less than a tenth of the floor: the slowest
# multiplier of the exact cycle is 0.797. At eps = 0.1 V no cycle of one turn is there to settle on.
PERIODS = {1e-1: 40, 1e-2: 40, 1e-3: 44, 1e-4: 56}
MAX_STEPS = 1 << 17  # of diffrax
WINDOW, READINGS = 2.5, 324  # what is read: periods before the end, every 0.05 of time

Extremes = tuple[np.ndarray, np.ndarray]  # times and values of x1


@dataclasses.dataclass(frozen=True)
class Law:
    """The equations' numbers; mu(w) = +-mu_s - a w + b w^3 with w = 1 - dx/dt."""

    f: float
    k: tuple[float, float]
    c: tuple[float, float]
    n: tuple[float, float]  # the loads are n1 x2 and n2 x1
    mu: float
    a: float
    b: float
    time: float  # s
    length: float  # m
    start: tuple[float, ...]

    @property
    def numbers(self) -> tuple[float, ...]:
        """f, k1, k2, c1, c2, n1, n2, mu, a, b."""
        return self.f, *self.k, *self.c, *self.n, self.mu, self.a, self.b


def law(K_n: float = K_N, mu_s: float = MU_S, V: float = V) -> Law:
    """Of the reference scene, in doubles whatever JAX is set to."""
    w_1, w_2, xi_1, xi_2, F = OSCILLATOR.values()
    omega, r, drop = math.sqrt(K_n), V / V_M, mu_s - MU_M
    n = 1.0, -KAPPA
    k = (w_1 / omega) ** 2 + KAPPA, (w_2 / omega) ** 2 + 1
    a, b = 1.5 * drop * r, 0.5 * drop * r**3
    f, sliding = F / math.sqrt(2) / (omega * V), mu_s - a + b
    rest = np.linalg.solve([[k[0], -sliding * n[0]], [-sliding * n[1], k[1]]], [f, -f])
    displaced = omega / math.sqrt(w_1**2 + w_2**2 + K_n * (1 + KAPPA))  # the package's start
    start = float(rest[0]) + displaced, float(rest[1]), 0.0, 0.0
    c = 2 * xi_1 * w_1 / omega, 2 * xi_2 * w_2 / omega
    return Law(f, k, c, n, mu_s, a, b, 1 / omega, V / omega, start)


def reading(periods: int) -> np.ndarray:
    """Times of the window at the end of so many periods."""
    end = periods * PERIOD * SCALE
    return np.linspace(end - WINDOW * PERIOD * SCALE, end, READINGS)


# ---------------------------------------------------------------------------------------------
# Reading a run
# ---------------------------------------------------------------------------------------------


def extremes_of(t: np.ndarray, x: np.ndarray, u: np.ndarray, rate: np.ndarray) -> Extremes:
    """Of x with the velocity u, where the cubics through u and its rates are zero."""
    (i,) = np.nonzero(u[:-1] * u[1:] < 0)
    h, u_0, u_1 = t[i + 1] - t[i], u[i], u[i + 1]
    d_0, d_1 = h * rate[i], h * rate[i + 1]
    # u = u_0 + d_0 s + q s^2 + p s^3 in the share s of the way.
    q, p = 3 * (u_1 - u_0) - 2 * d_0 - d_1, d_0 + d_1 - 2 * (u_1 - u_0)
    s = u_0 / (u_0 - u_1)
    for _ in range(5):
        s = s - (u_0 + s * (d_0 + s * (q + s * p))) / (d_0 + s * (2 * q + 3 * p * s))
    return t[i] + s * h, x[i] + h * s * (u_0 + s * (d_0 / 2 + s * (q / 3 + s * p / 4)))


def extremes(law: Law, share: float, t: np.ndarray, y: np.ndarray) -> Extremes:
    """Of x1, from states (n, 4) at times (n,)."""
    return extremes_of(t, y[:, 0], y[:, 2], accelerations(law, share, y)[0])


def accelerations(law: Law, share: float, y: np.ndarray) -> list[np.ndarray]:
    """Of states (n, 4), two of (n,)."""
    f, k_1, k_2, c_1, c_2, n_1, n_2, mu, a, b = law.numbers
    x_1, x_2, u_1, u_2 = y.T
    w_1, w_2 = 1 - u_1, 1 - u_2
    mu_1, mu_2 = (mu * np.tanh(w / share) - a * w + b * w**3 for w in (w_1, w_2))
    return [
        f - c_1 * u_1 - k_1 * x_1 + mu_1 * n_1 * x_2,
        -f - c_2 * u_2 - k_2 * x_2 + mu_2 * n_2 * x_1,
    ]


def last_turn(law: Law, found: Extremes) -> tuple[float, float]:
    """Period [s] and peak to peak of x1 [m], from the last maximum backwards."""
    t, x = found
    last = -1 if x[-1] > x[-2] else -2
    return float(t[last] - t[last - 2]) * law.time, float(x[last] - x[last - 1]) * law.length


# ---------------------------------------------------------------------------------------------
# The integrators: each gives a run without arguments
# ---------------------------------------------------------------------------------------------


def scipy_run(law: Law, share: float, method: str, rtol: float, periods: int) -> Callable:
    """By solve_ivp."""
    f, k_1, k_2, c_1, c_2, n_1, n_2, mu, a, b = law.numbers
    tanh, times = math.tanh, reading(periods)

    def rates(_, y):
        x_1, x_2, u_1, u_2 = y.tolist()
        w_1, w_2 = 1 - u_1, 1 - u_2
        mu_1 = mu * tanh(w_1 / share) - a * w_1 + b * w_1 * w_1 * w_1
        mu_2 = mu * tanh(w_2 / share) - a * w_2 + b * w_2 * w_2 * w_2
        return [
            u_1,
            u_2,
            f - c_1 * u_1 - k_1 * x_1 + mu_1 * n_1 * x_2,
            -f - c_2 * u_2 - k_2 * x_2 + mu_2 * n_2 * x_1,
        ]

    options: Any = {"t_eval": times, "rtol": rtol, "atol": rtol}

    def run() -> Extremes:
        found = solve_ivp(rates, (0, times[-1]), law.start, method, **options)
        return extremes(law, share, found.t, found.y.T)

    return run


@functools.cache
def diffrax_program(solver: str) -> tuple[Callable, float]:
    """By diffrax: states at times (n,) from a start, eps/V and rtol; and seconds to compile it."""
    numbers = law()
    k, c, n = (jnp.array(x) for x in (numbers.k, numbers.c, numbers.n))
    force = jnp.array([numbers.f, -numbers.f])

    def smooth(t, y, share):
        x, u = y[:2], y[2:]
        return jnp.concatenate([u, force - c * u - k * x])

    def friction(t, y, share):
        x, w = y[:2], 1 - y[2:]
        mu = numbers.mu * jnp.tanh(w / share) - numbers.a * w + numbers.b * w * w * w
        return jnp.concatenate([jnp.zeros(2), mu * n * x[::-1]])

    def both(t, y, share):
        return smooth(t, y, share) + friction(t, y, share)

    if solver == "KenCarp4":  # explicit in the first term, implicit in the second
        terms = diffrax.MultiTerm(diffrax.ODETerm(smooth), diffrax.ODETerm(friction))
    else:
        terms = diffrax.ODETerm(both)

    def run(y, times, share, rtol):
        found = diffrax.diffeqsolve(
            terms,
            getattr(diffrax, solver)(),
            0.0,
            times[-1],
            None,
            y,
            share,
            saveat=diffrax.SaveAt(ts=times),
            stepsize_controller=diffrax.PIDController(rtol=rtol, atol=rtol),
            max_steps=MAX_STEPS,
            adjoint=diffrax.ForwardMode(),
            throw=False,
        )
        return found.ys

    shapes = jnp.array(numbers.start), jnp.array(reading(3)), jnp.array(1e-2), jnp.array(1e-4)
    return compiled(run, *shapes)


def diffrax_run(program: Callable, law: Law, share: float, rtol: float, periods: int) -> Callable:
    """The same, compiled, as a run."""
    times = reading(periods)
    arguments = jnp.array(law.start), jnp.array(times), jnp.array(share), jnp.array(rtol)

    def run() -> Extremes:
        states = np.asarray(program(*arguments))
        if not np.isfinite(states).all():
            raise RuntimeError(f"more than {MAX_STEPS} steps")
        return extremes(law, share, times, states)

    return run


def heyoka_run(law: Law, share: float, tolerance: float, periods: int) -> Callable:
    """By heyoka, the step capped."""
    import heyoka as hy  # pyright: ignore[reportMissingImports]

    f, k_1, k_2, c_1, c_2, n_1, n_2, mu, a, b = law.numbers
    x_1, x_2, u_1, u_2 = hy.make_vars("x1", "x2", "u1", "u2")
    start, times = law.start, reading(periods)

    def friction(u):
        w = 1 - u
        return mu * hy.tanh(w / share) - a * w + b * (w * w * w)

    system = [
        (x_1, u_1),
        (x_2, u_2),
        (u_1, f - c_1 * u_1 - k_1 * x_1 + friction(u_1) * (n_1 * x_2)),
        (u_2, -f - c_2 * u_2 - k_2 * x_2 + friction(u_2) * (n_2 * x_1)),
    ]
    integrator = hy.taylor_adaptive(system, list(start), tol=tolerance)

    def run() -> Extremes:
        integrator.time, integrator.state[:] = 0.0, start
        integrator.propagate_until(times[0], max_delta_t=CAP * share)
        states = integrator.propagate_grid(times, max_delta_t=CAP * share)[-1]
        return extremes(law, share, times, states)

    return run


@functools.cache
def numba_rates() -> Any:
    """The compiled right-hand side; its data are `Law.numbers` and eps/V."""
    import numba  # pyright: ignore[reportMissingImports]
    from numbalsoda import lsoda_sig  # pyright: ignore[reportMissingImports]

    def rates(t, y, dy, data):
        f, k_1, k_2, c_1, c_2 = data[0], data[1], data[2], data[3], data[4]
        n_1, n_2, mu, a, b, share = data[5], data[6], data[7], data[8], data[9], data[10]
        w_1, w_2 = 1 - y[2], 1 - y[3]
        mu_1 = mu * math.tanh(w_1 / share) - a * w_1 + b * w_1 * w_1 * w_1
        mu_2 = mu * math.tanh(w_2 / share) - a * w_2 + b * w_2 * w_2 * w_2
        dy[0] = y[2]
        dy[1] = y[3]
        dy[2] = f - c_1 * y[2] - k_1 * y[0] + mu_1 * n_1 * y[1]
        dy[3] = -f - c_2 * y[3] - k_2 * y[1] + mu_2 * n_2 * y[0]

    return numba.cfunc(lsoda_sig)(rates)


def numbalsoda_run(law: Law, share: float, method: str, rtol: float, periods: int) -> Callable:
    """By numbalsoda's LSODA or DOP853."""
    import numbalsoda  # pyright: ignore[reportMissingImports]

    data, start = np.array([*law.numbers, share]), np.array(law.start)
    times = np.concatenate([[0.0], reading(periods)])
    solve = {"LSODA": numbalsoda.lsoda, "DOP853": numbalsoda.dop853}[method]
    address = numba_rates().address

    def run() -> Extremes:
        states, success = solve(address, start, times, data, rtol, rtol, 10_000_000)
        if not success:
            raise RuntimeError(f"numbalsoda's {method} gave up")
        return extremes(law, share, times[1:], states[1:])

    return run
