"""The limit cycle that several pages measure, and what a user of an integrator would write for it.

A transient runs until it repeats: with tanh(v/eps) in place of sgn v, or by events on the exact
law. Units are 1/omega and V/omega with omega^2 = K_n/m. Every run gives times and values of the
last extremes of x1.
"""

import functools
import math
from collections.abc import Callable
from typing import Any, NamedTuple

import diffrax
import jax.numpy as jnp
import numpy as np
from scipy.integrate import solve_ivp

import fractaljax as fj

from .timing import compiled

# F acts at 45 degrees; mass is 1 kg.
OSCILLATOR = {"omega_1": 2000 * math.pi, "omega_2": 1600 * math.pi}
OSCILLATOR |= {"xi_1": 1e-3, "xi_2": 7e-3, "F": 5.0}
K_N, KAPPA, MU_S, MU_M, V_M, V = 4e8, 0.5, 0.4, 0.25, 0.5, 0.15
SCALE = 2e4  # sqrt(K_n/m) [1/s]
PERIOD = 6.467445952469732345405 / SCALE  # s
AMPLITUDE = 2.290139035337965256497 * V / SCALE  # m: peak to peak of x1
OUTCOMES = ("converged", "inaccurate", "not_periodic", "too_stiff", "exhausted", "equilibrium")
OUTCOMES += ("diverged", "depends_on_eps", "unstable")

CAP = 8  # longest step of a Taylor series, in eps: dv/dt is of order 1, so no layer is jumped
# Periods by eps/V, after which the transient is less than a tenth of the floor: the slowest
# multiplier of the exact cycle is 0.797. At eps = 0.1 V the motion does not repeat after a period.
PERIODS = {1e-1: 40, 1e-2: 40, 1e-3: 44, 1e-4: 56}
MAX_STEPS = 1 << 17  # of diffrax
WINDOW, READINGS = 2.5, 324  # what is read: periods before the end, every 0.05 of time
TOLERANCE = 1e-9  # of an event-driven step: cycles to 1e-12; tighter ones take longer for the same
REARMED = 1e-3  # time after the start of a slip from which its end is searched

Extremes = tuple[np.ndarray, np.ndarray]  # times and values of x1
Run = Callable[[], Extremes]
States = Callable[[], np.ndarray]  # (n, 4) at the times that are read


def reference(K_n: Any = K_N, mu_s: Any = MU_S, V: Any = V) -> fj.Scene:
    """The reference scene, its K_n (and K_t with it), mu_s or V changed."""
    oscillator = fj.Oscillator(m=1.0, **OSCILLATOR, V=V)
    contact = fj.FixedContact(K_n, KAPPA * K_n)
    return fj.Scene(contact, fj.Stribeck(mu_s, MU_M, V_M), oscillator)


def outcomes(result: Any) -> dict[str, int]:
    """How often each outcome stands in the results of cycles."""
    counts = {name: int(np.sum(result == getattr(fj.CycleResult, name))) for name in OUTCOMES}
    return {name: count for name, count in counts.items() if count}


class Law(NamedTuple):
    """The equations' numbers; mu(w) = +-mu - a w + b w^3 with w = 1 - dx/dt."""

    numbers: tuple[float, ...]  # f, k1, k2, c1, c2, n1, n2, mu, a, b; the loads are n1 x2 and n2 x1
    start: tuple[float, ...]
    time: float  # s
    length: float  # m


def cubic(mu_s: Any, V: float = V) -> tuple[Any, Any, Any]:
    """The last numbers of a law: mu, a and b."""
    r, drop = V / V_M, mu_s - MU_M
    return mu_s, 1.5 * drop * r, 0.5 * drop * r**3


def law(K_n: float = K_N, mu_s: float = MU_S, V: float = V) -> Law:
    """Of the reference scene, in doubles whatever JAX is set to."""
    w_1, w_2, xi_1, xi_2, F = OSCILLATOR.values()
    omega, (mu_s, a, b) = math.sqrt(K_n), cubic(mu_s, V)
    k_1, k_2 = (w_1 / omega) ** 2 + KAPPA, (w_2 / omega) ** 2 + 1
    c_1, c_2 = 2 * xi_1 * w_1 / omega, 2 * xi_2 * w_2 / omega
    f, mu = F / math.sqrt(2) / (omega * V), mu_s - a + b
    x_1, x_2 = np.linalg.solve([[k_1, -mu], [mu * KAPPA, k_2]], [f, -f]).tolist()
    displaced = omega / math.sqrt(w_1**2 + w_2**2 + K_n * (1 + KAPPA))  # the package's start
    numbers = f, k_1, k_2, c_1, c_2, 1.0, -KAPPA, mu_s, a, b
    return Law(numbers, (x_1 + displaced, x_2, 0.0, 0.0), 1 / omega, V / omega)


def accelerations(tanh: Callable, numbers: tuple[float, ...], eps: Any) -> Callable:
    """The right-hand side of the tanh law: of x1, x2 and their rates."""
    f, k_1, k_2, c_1, c_2, n_1, n_2, mu, a, b = numbers

    def of(x_1, x_2, u_1, u_2):
        w_1, w_2 = 1 - u_1, 1 - u_2
        mu_1 = mu * tanh(w_1 / eps) - a * w_1 + b * w_1 * w_1 * w_1
        mu_2 = mu * tanh(w_2 / eps) - a * w_2 + b * w_2 * w_2 * w_2
        return (
            f - c_1 * u_1 - k_1 * x_1 + mu_1 * n_1 * x_2,
            -f - c_2 * u_2 - k_2 * x_2 + mu_2 * n_2 * x_1,
        )

    return of


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


def last_period(law: Law, found: Extremes) -> tuple[float, float]:
    """Period [s] and peak to peak of x1 [m], from the last maximum backwards."""
    t, x = found
    last = -1 if x[-1] > x[-2] else -2
    return float(t[last] - t[last - 2]) * law.time, float(x[last] - x[last - 1]) * law.length


# Integrators of the tanh law; eps in units of V


def scipy_states(solver: str, law: Law, eps: float, rtol: float, times: np.ndarray) -> States:
    of = accelerations(math.tanh, law.numbers, eps)
    options: Any = {"t_eval": times, "rtol": rtol, "atol": rtol}

    def rates(_, y):
        x_1, x_2, u_1, u_2 = y.tolist()
        return [u_1, u_2, *of(x_1, x_2, u_1, u_2)]

    return lambda: solve_ivp(rates, (0, times[-1]), law.start, solver, **options).y.T


@functools.cache
def diffrax_program(solver: str) -> tuple[Callable, float]:
    """States at times (n,) from a start, eps and rtol; and seconds to compile it."""
    start, numbers = law().start, law().numbers

    def term(numbers, moving=1.0):
        def rates(t, y, eps):
            u = y[2:] * moving
            return jnp.concatenate([u, jnp.stack(accelerations(jnp.tanh, numbers, eps)(*y))])

        return diffrax.ODETerm(rates)

    terms = term(numbers)
    if solver == "KenCarp4":  # explicit in the first term, implicit in the friction
        smooth, friction = (*numbers[:7], 0, 0, 0), (0, 0, 0, 0, 0, *numbers[5:])
        terms = diffrax.MultiTerm(term(smooth), term(friction, moving=0.0))

    def run(y, times, eps, rtol):
        return diffrax.diffeqsolve(
            terms,
            getattr(diffrax, solver)(),
            0.0,
            times[-1],
            None,
            y,
            eps,
            saveat=diffrax.SaveAt(ts=times),
            stepsize_controller=diffrax.PIDController(rtol=rtol, atol=rtol),
            max_steps=MAX_STEPS,
            adjoint=diffrax.ForwardMode(),
            throw=False,
        ).ys

    return compiled(run, *map(jnp.array, (start, reading(3), 1e-2, 1e-4)))


def diffrax_states(solver: str, law: Law, eps: float, rtol: float, times: np.ndarray) -> States:
    program, arguments = diffrax_program(solver)[0], map(jnp.array, (law.start, times, eps, rtol))
    call = functools.partial(program, *arguments)

    def run():
        states = np.asarray(call())
        if not np.isfinite(states).all():
            raise RuntimeError(f"more than {MAX_STEPS} steps")
        return states

    return run


def heyoka_states(_: str, law: Law, eps: float, tolerance: float, times: np.ndarray) -> States:
    """The step capped."""
    import heyoka as hy  # pyright: ignore[reportMissingImports]

    y = hy.make_vars("x1", "x2", "u1", "u2")
    rates = [*y[2:], *accelerations(hy.tanh, law.numbers, eps)(*y)]
    system = list(zip(y, rates, strict=True))
    integrator = hy.taylor_adaptive(system, list(law.start), tol=tolerance)

    def run():
        integrator.time, integrator.state[:] = 0.0, law.start
        integrator.propagate_until(times[0], max_delta_t=CAP * eps)
        return integrator.propagate_grid(times, max_delta_t=CAP * eps)[-1]

    return run


@functools.cache
def numba_rates(numbers: tuple[float, ...], eps: float) -> Any:
    """The compiled right-hand side."""
    import numba  # pyright: ignore[reportMissingImports]
    from numbalsoda import lsoda_sig  # pyright: ignore[reportMissingImports]

    of = numba.njit(accelerations(math.tanh, numbers, eps))

    def rates(t, y, dy, data):
        dy[0], dy[1] = y[2], y[3]
        dy[2], dy[3] = of(y[0], y[1], y[2], y[3])

    return numba.cfunc(lsoda_sig)(rates)


def numbalsoda_states(solver: str, law: Law, eps: float, rtol: float, times: np.ndarray) -> States:
    import numbalsoda  # pyright: ignore[reportMissingImports]

    times, start = np.concatenate([[0.0], times]), np.array(law.start)
    solve = {"LSODA": numbalsoda.lsoda, "DOP853": numbalsoda.dop853}[solver]
    address, nothing = numba_rates(law.numbers, eps).address, np.zeros(1)

    def run():
        states, success = solve(address, start, times, nothing, rtol, rtol, 10_000_000)
        if not success:
            raise RuntimeError(f"numbalsoda's {solver} gave up")
        return states[1:]

    return run


STATES: dict[str, Callable[..., States]] = {
    "SciPy": scipy_states,
    "diffrax": diffrax_states,
    "numbalsoda": numbalsoda_states,
    "heyoka": heyoka_states,
}


def reading(periods: int) -> np.ndarray:
    """Times of the window at the end of so many periods."""
    end = periods * PERIOD * SCALE
    return np.linspace(end - WINDOW * PERIOD * SCALE, end, READINGS)


def tanh_run(family: str, law: Law, eps: float, rtol: float, periods: int) -> Run:
    """By a library and its solver, as in "SciPy LSODA"."""
    library, _, solver = family.partition(" ")
    times, of = reading(periods), accelerations(np.tanh, law.numbers, eps)
    states = STATES[library.rstrip(",")](solver, law, eps, rtol, times)

    def run() -> Extremes:
        y = states()
        return extremes_of(times, y[:, 0], y[:, 2], of(*y.T)[0])

    return run


# The exact law, from event to event: the best that an integrator can do


@functools.cache
def _integrator(tolerance: float) -> Any:
    """heyoka's, with the events, for all scenes.

    Parameters: of each direction the sign of slip, whether it slips and whether the end of the slip
    is searched, then `Law.numbers`.
    """
    import heyoka as hy  # pyright: ignore[reportMissingImports]

    f, k_1, k_2, c_1, c_2, n_1, n_2, mu, a, b = (hy.par[6 + i] for i in range(10))
    x_1, x_2, u_1, u_2 = hy.make_vars("x1", "x2", "u1", "u2")
    system, events = [(x_1, u_1), (x_2, u_2)], []
    directions = (
        (u_1, n_1 * x_2, f - c_1 * u_1 - k_1 * x_1),
        (u_2, n_2 * x_1, -f - c_2 * u_2 - k_2 * x_2),
    )
    for i, (u, load, own) in enumerate(directions):
        sign, slips, armed = hy.par[i], hy.par[2 + i], hy.par[4 + i]
        w = 1 - u
        system.append((u, slips * (own + (sign * mu - a * w + b * (w * w * w)) * load)))
        events.append(hy.t_event(armed * w + (1 - armed)))  # a slip ends
        events.append(hy.t_event((1 - slips) * (mu * load + own) + slips))  # a stick ends
        events.append(hy.t_event((1 - slips) * (mu * load - own) + slips))
    events.append(hy.t_event(u_1))  # an extreme of x1
    return hy.taylor_adaptive(
        system, [0.0] * 4, t_events=events, pars=[1.0] * 16, tol=tolerance, fast_math=True
    )


def heyoka_events(
    law: Law, periods: int, settled: float = 0.0, tolerance: float = TOLERANCE
) -> Run:
    """Taylor series between events, over so many periods or until three maxima agree."""
    import heyoka as hy  # pyright: ignore[reportMissingImports]

    ta, limit = _integrator(tolerance), hy.taylor_outcome.time_limit
    f, k_1, k_2, c_1, c_2, n_1, n_2, mu, *_ = law.numbers
    force, k, c, n = (f, -f), (k_1, k_2), (c_1, c_2), (n_1, n_2)

    def run() -> Extremes:
        y, state = ta.state, ta.pars
        ta.time, y[:], state[:6], state[6:] = 0.0, law.start, 1.0, law.numbers
        ta.reset_cooldowns()
        times, values, rearm = [], [], None
        while len(times) < 2 * periods + 1:
            outcome = ta.propagate_until(1e9 if rearm is None else rearm)[0]
            if outcome == limit:  # the new slip has left zero
                state[4:6], rearm = state[2:4], None
                continue
            i, kind = divmod(-int(outcome) - 1, 3)
            if i == 2:
                times.append(ta.time)
                values.append(y[0])
                last = values[-5::2]  # of a kind
                if len(times) > 5 and max(last) - min(last) < settled:
                    break
                continue
            y[2 + i] = 1.0
            if kind == 0:
                s = state[i]
                own = force[i] - c[i] - k[i] * y[i]
                crosses = s * own - mu * n[i] * y[1 - i] > 0
                state[i], state[2 + i] = (-s, 1.0) if crosses else (0.0, 0.0)
                state[4 + i] = state[2 + i]
            else:
                state[i], state[2 + i] = (1.0 if kind == 1 else -1.0), 1.0
                rearm = ta.time + REARMED
        return np.array(times), np.array(values)

    return run
