"""Error against run time of the stick-slip limit cycle: this package against transients.

Every peer runs the transient from the package's default start and reads the last turn: by event
(heyoka) on the exact law, or through tanh(v/eps) in place of sgn v (SciPy, diffrax), with steps
short enough to see that layer. The truth has more digits than a double.
"""

import dataclasses
import importlib
import importlib.metadata
import json
import math
import os
import platform
import statistics
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import matplotlib
import numpy as np
import scipy
from scipy.integrate import solve_ivp
from scipy.optimize import brentq
from tqdm import tqdm

import fractaljax as fj

from .page import png, write
from .timing import compiled, others_running, ran_on, seconds, this_machine

K_N, KAPPA, V = 4e8, 0.5, 0.15
SCALE = 2e4  # sqrt(K_n/m) [1/s]
PERIOD = 6.467445952469732345405 / SCALE  # s
AMPLITUDE = 2.290139035337965256497 * V / SCALE  # m: peak to peak of x1
# d(amplitude)/dK_n at fixed K_t/K_n, of which the truth is known in units of V/omega.
SLOPE = (1.263706994327e-11 - 2.290139035337965256497 / (2 * K_N)) * V / SCALE
DIFFERENCE = 1e-4  # relative step of the peer's central difference
PERIODS = 120  # the slowest multiplier is 0.797: from the 30th period on, 90 more for 1e-9
CAP = 8  # longest step of the tanh law, in eps: dv/dt is of order 1, so that no layer is jumped
FINE = 96  # segments of the truth in the batch
RANGE = (2e8, 6e8)  # of K_n in the batch
MEMBERS = (
    "converged",
    "inaccurate",
    "not_periodic",
    "too_stiff",
    "exhausted",
    "equilibrium",
    "diverged",
)


@dataclasses.dataclass(frozen=True)
class Size:
    """How much is measured."""

    segments: tuple[int, ...]
    eps: tuple[float, ...]  # of the package's regularised cycle, in V
    batch: int
    repeats: int
    slow: int  # repeats of what takes seconds


FULL = Size((20, 24, 32, 40, 64), (1e-2, 1e-3), 4096, 51, 3)
QUICK = Size((20,), (), 64, 5, 1)


def reference(K_n: Any = K_N, kappa: Any = KAPPA) -> fj.Scene:
    """The reference scene, its K_n changed."""
    oscillator = fj.Oscillator(
        m=1.0, omega_1=2000 * math.pi, omega_2=1600 * math.pi, xi_1=1e-3, xi_2=7e-3, F=5.0, V=V
    )
    return fj.Scene(fj.FixedContact(K_n, kappa * K_n), fj.Stribeck(0.4, 0.25, 0.5), oscillator)


def relative(found, truth: float) -> float:
    """Relative error."""
    return abs(float(found) / truth - 1)


# ---------------------------------------------------------------------------------------------
# The package
# ---------------------------------------------------------------------------------------------


def amplitude(K_n, **options):
    """Peak to peak of x1 [m]."""
    return fj.limit_cycle(reference(K_n), throw=False, **options).amplitude[0]


def exact_rows(size: Size) -> list[dict[str, Any]]:
    """Value, and value with gradient, by the number of segments."""
    kinds = {
        "value": lambda f: f,
        "value and gradient, forward": lambda f: lambda K: jax.jvp(f, (K,), (1.0,)),
        "value and gradient, reverse": jax.value_and_grad,
    }
    if size is QUICK:
        kinds.pop("value and gradient, reverse")
    programs = {}
    for n in tqdm(size.segments, desc="compile"):
        for kind, wrap in kinds.items():
            f = wrap(lambda K, n=n: amplitude(K, segments=n))
            programs[n, kind] = compiled(f, K_N)
    times: dict[Any, list[float]] = {key: [] for key in programs}
    results = {key: program(K_N) for key, (program, _) in programs.items()}
    for _ in range(size.repeats):
        for key, (program, _) in programs.items():
            times[key].append(seconds(program, K_N)[0])
    rows = []
    for (n, kind), (_, compile_s) in programs.items():
        found = results[n, kind]
        value, slope = found if isinstance(found, tuple) else (found, None)
        own, plain = times[n, kind], times[n, "value"]
        rows.append(
            {
                "name": f"fj.limit_cycle, {n} segments, {kind}",
                "group": "package",
                "segments": n,
                "kind": kind,
                "compile_s": compile_s,
                "seconds": statistics.median(own),
                "seconds_fastest": min(own),
                "ratio_to_value": statistics.median(a / b for a, b in zip(own, plain, strict=True)),
                "error": relative(value, AMPLITUDE),
                "gradient_error": None if slope is None else relative(slope, SLOPE),
            }
        )
    return rows


def regularised_rows(size: Size) -> list[dict[str, Any]]:
    """The package's own tanh law, value and gradient at once."""
    rows = []
    for share in size.eps:

        def cycle(K, share=share):
            found = fj.limit_cycle(reference(K), regularisation=share * V, throw=False)
            return found.amplitude[0], found.regularisation_error

        program, compile_s = compiled(lambda K, f=cycle: jax.jvp(f, (K,), (1.0,)), K_N)
        (value, differs), (slope, _) = program(K_N)
        times = [seconds(program, K_N)[0] for _ in range(size.slow)]
        rows.append(
            {
                "name": f"fj.limit_cycle, eps = {share:g} V, value and gradient, forward",
                "group": "package, regularised",
                "eps": share * V,
                "compile_s": compile_s,
                "seconds": statistics.median(times),
                "seconds_fastest": min(times),
                "error": relative(value, AMPLITUDE),
                "gradient_error": relative(slope, SLOPE),
                "regularisation_error": float(differs),
            }
        )
    return rows


# ---------------------------------------------------------------------------------------------
# Peers: plain transients, in the units 1/omega and V/omega, omega^2 = K_n/m
# ---------------------------------------------------------------------------------------------


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
    length: float  # m
    start: list[float]


def law(K_n: float = K_N) -> Law:
    """Of the reference scene."""
    scene = reference(K_n)
    o, mu, drop = scene.oscillator, 0.4, 0.4 - 0.25
    w_1, w_2, xi_1, xi_2, F = (float(x) for x in (o.omega_1, o.omega_2, o.xi_1, o.xi_2, o.F))
    omega, r = math.sqrt(K_n), V / 0.5
    n = 1.0, -KAPPA
    k = (w_1 / omega) ** 2 + KAPPA, (w_2 / omega) ** 2 + 1
    a, b = 1.5 * drop * r, 0.5 * drop * r**3
    f, sliding = F / math.sqrt(2) / (omega * V), mu - a + b
    rest = np.linalg.solve([[k[0], -sliding * n[0]], [-sliding * n[1], k[1]]], [f, -f])
    displaced = omega / math.sqrt(w_1**2 + w_2**2 + K_n * (1 + KAPPA))  # the package's start
    start = [float(rest[0]) + displaced, float(rest[1]), 0.0, 0.0]
    c = 2 * xi_1 * w_1 / omega, 2 * xi_2 * w_2 / omega
    return Law(f, k, c, n, mu, a, b, V / omega, start)


def peaks(t: np.ndarray, x: np.ndarray, u: np.ndarray) -> np.ndarray:
    """Extremes of x between steps, in turn, from the cubic through values and slopes."""
    (i,) = np.nonzero(u[:-1] * u[1:] < 0)
    h, rise = t[i + 1] - t[i], x[i + 1] - x[i]
    d_0, d_1 = h * u[i], h * u[i + 1]
    s = d_0 / (d_0 - d_1)
    p, q = 6 * rise - 4 * d_0 - 2 * d_1, 3 * (d_0 + d_1) - 6 * rise
    for _ in range(4):
        s = s - (d_0 + s * (p + s * q)) / (p + 2 * s * q)
    return x[i] + s * (d_0 + s * (p / 2 + s * q / 3))


def until_flat(turns: np.ndarray, length: float) -> int:
    """Periods after which the amplitude keeps within a tenth of its final error."""
    found = np.abs(np.diff(turns))[::2] * length
    floor = abs(found[-1] / AMPLITUDE - 1)
    off = np.abs(found / found[-1] - 1) > 0.1 * floor
    return int(np.max(np.nonzero(off)[0], initial=-1)) + 2


def scipy_run(numbers: Law, share: float, method: str, rtol: float) -> Callable[[], np.ndarray]:
    """The transient of the tanh law by solve_ivp."""
    f, (k_1, k_2), (c_1, c_2), (n_1, n_2) = numbers.f, numbers.k, numbers.c, numbers.n
    mu, a, b, tanh = numbers.mu, numbers.a, numbers.b, math.tanh

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

    end = PERIODS * PERIOD * SCALE
    options: Any = {"max_step": CAP * share, "rtol": rtol, "atol": rtol}

    def run():
        found = solve_ivp(rates, (0, end), numbers.start, method, **options)
        return peaks(found.t, found.y[0], found.y[2])

    return run


def diffrax_run(numbers: Law, share: float, solver, rtol: float) -> Callable:
    """The same by diffrax: a program of the start, to be compiled."""
    end = PERIODS * PERIOD * SCALE
    k, c, n = (jnp.array(x) for x in (numbers.k, numbers.c, numbers.n))
    force = jnp.array([numbers.f, -numbers.f])

    def rates(t, y, args):
        x, u = y[:2], y[2:]
        w = 1 - u
        mu = numbers.mu * jnp.tanh(w / share) - numbers.a * w + numbers.b * w * w * w
        return jnp.concatenate([u, force - c * u - k * x + mu * n * x[::-1]])

    def run(y):
        found = diffrax.diffeqsolve(
            diffrax.ODETerm(rates),
            solver,
            0.0,
            end,
            None,
            y,
            saveat=diffrax.SaveAt(t0=True, steps=True),
            stepsize_controller=diffrax.PIDController(rtol=rtol, atol=rtol, dtmax=CAP * share),
            max_steps=1 << 16,
        )
        assert found.ys is not None
        return found.ts, found.ys[:, 0], found.ys[:, 2]

    return run


def heyoka_run(hy: Any, numbers: Law, periods: int) -> Callable[[], np.ndarray]:
    """The exact law, Taylor series between terminal events; the modes are parameters."""
    f, k, c, n, mu, a, b = (getattr(numbers, x) for x in ("f", "k", "c", "n", "mu", "a", "b"))
    x_1, x_2, u_1, u_2 = hy.make_vars("x1", "x2", "u1", "u2")
    force = f, -f

    def free(i, x, u):
        return force[i] - c[i] * u - k[i] * x

    system, events = [(x_1, u_1), (x_2, u_2)], []
    for i, (x, u, other) in enumerate([(x_1, u_1, x_2), (x_2, u_2, x_1)]):
        sign, slips, armed = hy.par[i], hy.par[2 + i], hy.par[4 + i]
        w = 1 - u
        load, own = n[i] * other, free(i, x, u)
        system.append((u, slips * (own + (sign * mu - a * w + b * (w * w * w)) * load)))
        events.append(hy.t_event(armed * w + (1 - armed)))  # a slip ends
        events.append(hy.t_event((1 - slips) * (mu * load + own) + slips))  # a stick ends
        events.append(hy.t_event((1 - slips) * (mu * load - own) + slips))
    events.append(hy.t_event(u_1))  # an extreme of x1
    integrator = hy.taylor_adaptive(system, numbers.start, t_events=events, pars=[1.0] * 6)

    def run():
        ta = integrator
        y, mode = ta.state, ta.pars
        ta.time, y[:], mode[:] = 0.0, numbers.start, 1.0
        ta.reset_cooldowns()
        turns, rearm = [], None
        while len(turns) < 2 * periods + 1:
            outcome = ta.propagate_until(1e9 if rearm is None else rearm)[0]
            if outcome == hy.taylor_outcome.time_limit:  # the new slip has left zero
                mode[4:], rearm = mode[2:4], None
                continue
            i, kind = divmod(-int(outcome) - 1, 3)
            if i == 2:
                turns.append(y[0])
                continue
            y[2 + i] = 1.0
            if kind == 0:
                s = mode[i]
                crosses = s * free(i, y[i], 1.0) - mu * n[i] * y[1 - i] > 0
                mode[i], mode[2 + i] = (-s, 1.0) if crosses else (0.0, 0.0)
                mode[4 + i] = mode[2 + i]
            else:
                mode[i], mode[2 + i] = (1.0 if kind == 1 else -1.0), 1.0
                rearm = ta.time + 1e-3
        return np.array(turns)

    return run


def optional(name: str) -> Any:
    """A package that the benchmark can do without, or None."""
    try:
        return importlib.import_module(name)
    except ImportError:
        return None


def peer_rows(size: Size) -> list[dict[str, Any]]:
    """Every transient: time of one warm run, error of its last turn."""
    numbers, quick, rows = law(), size is QUICK, []

    def add(name, group, run, compile_s, repeats, periods, **more):
        turns = run()
        times = [seconds(run)[0] for _ in range(repeats)]
        flat = min(until_flat(turns, numbers.length), periods)
        rows.append(
            {
                "name": name,
                "group": group,
                "compile_s": compile_s,
                "seconds": statistics.median(times),
                "seconds_fastest": min(times),
                "error": relative(abs(turns[-1] - turns[-2]) * numbers.length, AMPLITUDE),
                "periods": periods,
                "periods_to_its_floor": None if group == "exact" else flat,
                **more,
            }
        )

    hy = optional("heyoka")
    for periods in (30, 60, 90, PERIODS) if hy else ():
        start = time.perf_counter()
        run = heyoka_run(hy, numbers, periods)
        built = time.perf_counter() - start
        name = f"heyoka, exact law by events, {periods} periods"
        add(name, "exact", run, built, size.repeats // 3, periods)
    if hy:
        sides = [law(K_N * (1 + side * DIFFERENCE)) for side in (-1, 1)]
        runs = [heyoka_run(hy, side, PERIODS) for side in sides]

        def ends():
            return [run() for run in runs]

        low, high = (
            abs(turns[-1] - turns[-2]) * side.length
            for turns, side in zip(ends(), sides, strict=True)
        )
        rows[-1] |= {
            "gradient_error": relative((high - low) / (2 * DIFFERENCE * K_N), SLOPE),
            "seconds_of_gradient": statistics.median(
                seconds(ends)[0] for _ in range(size.repeats // 3)
            ),
        }

    if quick:
        methods = [("LSODA", 0.1, 1e-6)]
    else:
        methods = [(name, 1e-2, 1e-8) for name in ("RK45", "LSODA", "DOP853", "Radau")]
        methods.append(("DOP853", 1e-3, 1e-8))
    for method, share, rtol in tqdm(methods, desc="SciPy"):
        run = scipy_run(numbers, share, method, rtol)
        slow = method == "Radau" or share < 1e-2
        name = f"SciPy {method}, eps = {share:g} V"
        add(name, "tanh", run, None, 1 if slow else size.slow, PERIODS, eps=share * V)
    solvers = [("Tsit5", 0.1 if quick else 1e-2)]
    if not quick:
        solvers += [("Dopri8", 1e-2)]
    for name, share in tqdm(solvers, desc="diffrax"):
        start = jnp.array(numbers.start)
        body = diffrax_run(numbers, share, getattr(diffrax, name)(), 1e-8)
        program, compile_s = compiled(body, start)

        def turns(program=program, start=start):
            t, x, u = (np.asarray(values) for values in program(start))
            used = np.isfinite(t)
            return peaks(t[used], x[used], u[used])

        title = f"diffrax {name}, eps = {share:g} V"
        add(title, "tanh", turns, compile_s, size.slow, PERIODS, eps=share * V)
    return rows


# ---------------------------------------------------------------------------------------------
# Many at once
# ---------------------------------------------------------------------------------------------


def many(segments: int | None = None) -> Callable:
    """The batch: peak to peak of x1 and the place of the result in MEMBERS, by K_n (n,)."""

    def one(K):
        cycle = fj.limit_cycle(reference(K), segments=segments, throw=False)
        return cycle.amplitude[0], member(cycle)

    return jax.vmap(one)


def member(cycle: fj.LimitCycle) -> jax.Array:
    """The place of a cycle's result in MEMBERS."""
    hits = [cycle.result == getattr(fj.CycleResult, name) for name in MEMBERS]
    return jnp.argmax(jnp.stack(hits))


def sharded_times(count: int, repeats: int) -> dict[str, Any]:
    """The batch over all devices of this process: as `python -m benchmarks.limit_cycle` runs it."""
    devices = np.array(jax.devices())
    mesh = jax.sharding.Mesh(devices, ("cycles",))
    spec = jax.sharding.PartitionSpec("cycles")
    body = jax.shard_map(many(), mesh=mesh, in_specs=spec, out_specs=spec, check_vma=False)
    K_n = jax.device_put(jnp.linspace(*RANGE, count), jax.sharding.NamedSharding(mesh, spec))
    program, compile_s = compiled(body, K_n)
    values = np.asarray(program(K_n)[0]).tolist()
    fastest = min(seconds(program, K_n)[0] for _ in range(repeats))
    return {
        "devices": len(devices),
        "compile_s": compile_s,
        "seconds": fastest,
        "cycles_per_second": count / fastest,
        "values": values,
    }


def sharded(size: Size, values: np.ndarray) -> dict[str, Any]:
    """The batch over two virtual devices, in a process that has them, beside the values of one."""
    flags = os.environ.get("XLA_FLAGS", "") + " --xla_force_host_platform_device_count=2"
    command = [sys.executable, "-m", "benchmarks.limit_cycle", str(size.batch), str(size.slow)]
    done = subprocess.run(
        command,
        cwd=Path(__file__).parents[1],
        env=os.environ | {"XLA_FLAGS": flags, "JAX_PLATFORMS": "cpu"},
        capture_output=True,
        text=True,
        check=False,
    )
    if done.returncode:
        raise RuntimeError(f"the sharded run failed: {done.stderr[-2000:]}")
    found = json.loads(done.stdout.splitlines()[-1])
    return found | {"differs": float(np.nanmax(np.abs(np.array(found.pop("values")) / values - 1)))}


def batch(size: Size) -> dict[str, Any]:
    """Rate of a batch in one call, on one device and over two, and its errors."""
    K_n = jnp.linspace(*RANGE, size.batch)
    program, compile_s = compiled(many(), K_n)
    found, results = (np.asarray(x) for x in program(K_n))
    fastest = min(seconds(program, K_n)[0] for _ in range(size.slow))
    truth, fine_results = (np.asarray(x) for x in jax.jit(many(FINE))(K_n))
    errors = np.abs(found / truth - 1)[(results == 0) & (fine_results == 0)]
    others = errors < 1e-6  # above it, another attractor or another itinerary
    counts = {name: int(np.sum(results == i)) for i, name in enumerate(MEMBERS)}
    return {
        "cycles": size.batch,
        "K_n": RANGE,
        "compile_s": compile_s,
        "seconds": fastest,
        "cycles_per_second": size.batch / fastest,
        "results": {name: count for name, count in counts.items() if count},
        "not_converged": size.batch - counts["converged"],
        "not_converged_with_96": int(np.sum(fine_results != 0)),
        "error": {
            "compared": len(errors),
            "median": float(np.median(errors)),
            "worst": float(np.max(errors)),
            "above_1e-6": int(np.sum(~others)),
            "worst_of_the_others": float(np.max(errors[others])),
        },
        "sharded": None if size is QUICK else sharded(size, found),
    }


# ---------------------------------------------------------------------------------------------
# Stiff and extreme
# ---------------------------------------------------------------------------------------------


def barely(sign: int) -> fj.Scene:
    """The reference scene with so little friction that its growth rate is +-1e-6 omega."""

    def weaker(share):
        return reference().replace(friction=fj.Stribeck(0.4 * share, 0.25 * share, 0.5))

    def gap(share):
        return float(fj.growth_rate(weaker(share))) / SCALE - sign * 1e-6

    return weaker(brentq(gap, 0.01, 1.0, xtol=1e-15))


def edge(low: float, high: float) -> tuple[float, float]:
    """The two neighbouring G between which K_t becomes zero or ceases to be."""
    brake = fj.brake_scene()

    def stiff(log_G):
        return float(fj.stiffness(brake.replace(G=math.exp(log_G)))[1]) > 0

    a, b = math.log(low), math.log(high)
    first = stiff(a)
    while b - a > 1e-9:
        middle = (a + b) / 2
        a, b = (middle, b) if stiff(middle) == first else (a, middle)
    return math.exp(a), math.exp(b)


def extreme_scenes(quick: bool) -> dict[str, fj.Scene]:
    """Where the search for a cycle may fail."""
    base = reference()
    scenes = {f"K_n = {K:.0e} N/m": reference(K) for K in 10.0 ** np.arange(6, 14)}
    scenes |= {f"V = {v:g} m/s": base.replace(V=v) for v in (1e-4, 1e-3, 1e-2, 0.5, 1.0)}
    scenes |= {
        "xi_1 = xi_2 = 0": base.replace(xi_1=0.0, xi_2=0.0),
        "F = 0": base.replace(F=0.0),
        "xi_1 = xi_2 = 0, F = 0": base.replace(xi_1=0.0, xi_2=0.0, F=0.0),
        "growth 1e-6 omega": barely(1),
        "growth -1e-6 omega": barely(-1),
    }
    if quick:
        return {name: scenes[name] for name in ("K_n = 1e+06 N/m", "V = 1 m/s", "F = 0")}
    brake = fj.brake_scene()
    slip, stiff = edge(1e-11, 1e-10)
    last, soft = edge(2e-10, 4e-10)
    scenes |= {
        "brake": brake,
        "brake, G at gross slip, outside": brake.replace(G=slip),
        "brake, G at gross slip, inside": brake.replace(G=stiff),
        "brake, G at fully plastic, inside": brake.replace(G=last),
        "brake, G at fully plastic, outside": brake.replace(G=soft),
        "brake, D = 2.45": brake.replace(D=2.45),
        "brake, D = 2.9": brake.replace(D=2.9),
    }
    return scenes


def extremes(quick: bool) -> list[dict[str, Any]]:
    """One row a scene, by the exact law."""

    @eqx.filter_jit
    def describe(scene):
        cycle = fj.limit_cycle(scene, throw=False)
        one = cycle.multipliers[jnp.argmin(jnp.abs(cycle.multipliers - 1))]
        K_n, _ = fj.stiffness(scene)
        omega = jnp.sqrt(K_n / scene.oscillator.m)
        numbers = (
            fj.growth_rate(scene) / omega,
            cycle.period,
            cycle.error,
            jnp.abs(one - 1),
            cycle.amplitude[0],
            jnp.max(cycle.stick_fraction),
        )
        return member(cycle), cycle.turns, numbers

    rows = []
    for name, scene in tqdm(extreme_scenes(quick).items(), desc="extreme"):
        describe(scene)
        elapsed, (result, turns, numbers) = seconds(describe, scene)
        growth, period, error, trivial, size, stuck = (float(x) for x in numbers)
        result = MEMBERS[int(result)]
        why = None
        if not all(math.isfinite(x) for x in (period, error, trivial, size)):
            why = str(fj.CycleResult[getattr(fj.CycleResult, result)])
        rows.append(
            {
                "name": name,
                "result": result,
                "growth_by_omega": growth if math.isfinite(growth) else None,
                "turns": int(turns),
                "seconds": elapsed,
                "non_finite": why,
            }
            | dict(
                zip(
                    ("period", "error", "trivial_multiplier_off", "amplitude", "stick_fraction"),
                    (None,) * 5 if why else (period, error, trivial, size, stuck),
                    strict=True,
                )
            )
        )
    return rows


def stiff_rows(quick: bool) -> list[dict[str, Any]]:
    """Three periods of the tanh law from a point of the exact cycle: how far it comes back."""
    cycle = fj.limit_cycle(reference(), segments=64)
    units = np.array([V / SCALE, V / SCALE, V, V])
    rows = []
    for eps in () if quick else 10.0 ** np.arange(-3, -9, -1):
        periods = 3

        def run(eps=eps, periods=periods):
            return fj.simulate(
                reference(),
                cycle.state,
                periods * cycle.period,
                regularisation=eps,
                solver=diffrax.Kvaerno5(),
                max_steps=200000,
                throw=False,
            )

        run()
        elapsed, found = seconds(run)
        off = np.max(np.abs(np.asarray(found.end - cycle.state)) / units)
        moved = np.asarray(jnp.diff(found.times) > 0)
        rows.append(
            {
                "eps": float(eps),
                "result": str(fj.SimulationResult[found.result]),
                "steps": int(np.sum(moved)),
                "seconds": elapsed,
                "finite": bool(np.isfinite(off)),
                "off_the_exact_cycle": float(off) if np.isfinite(off) else None,
            }
        )
    return rows


# ---------------------------------------------------------------------------------------------
# Measuring and showing
# ---------------------------------------------------------------------------------------------


def measure(quick: bool = False) -> dict[str, Any]:
    """Every number of the benchmark, ready for JSON."""
    size, busy = (QUICK if quick else FULL), others_running()
    versions = {
        "python": platform.python_version(),
        "jax": jax.__version__,
        "numpy": np.__version__,
        "scipy": scipy.__version__,
        "diffrax": importlib.metadata.version("diffrax"),
    }
    if optional("heyoka"):
        versions["heyoka"] = importlib.metadata.version("heyoka")
    return {
        "quick": quick,
        "truth": {"period": PERIOD, "amplitude": AMPLITUDE, "slope": SLOPE},
        "repeats": size.repeats,
        "machine": this_machine(busy),
        "versions": versions,
        "not_installed": [] if "heyoka" in versions else ["heyoka"],
        "methods": exact_rows(size) + regularised_rows(size) + peer_rows(size),
        "batch": batch(size),
        "extreme": extremes(quick),
        "stiff": stiff_rows(quick),
    }


def cell(value: Any, form: str) -> str:
    """A number, or a dash."""
    return "-" if value is None else format(value, form)


def rows_of(headings: list[str], rows: list[list[str]]) -> list[str]:
    """A Markdown table."""
    lines = [headings, ["---"] * len(headings), *rows]
    return [f"| {' | '.join(line)} |" for line in lines]


def one_cycle_table(result: dict[str, Any]) -> list[str]:
    """Error against run time, one cycle."""
    headings = [
        "method",
        "compile [s]",
        "time: median [ms]",
        "fastest",
        "to the value's",
        "error of the amplitude, relative",
        "of d/dK_n",
        "periods run, to its floor",
    ]
    rows = []
    for m in result["methods"]:
        periods = [str(m[k]) for k in ("periods", "periods_to_its_floor") if m.get(k)]
        rows.append(
            [
                m["name"],
                cell(m["compile_s"], ".1f"),
                f"{m['seconds'] * 1e3:.3g}",
                f"{m['seconds_fastest'] * 1e3:.3g}",
                cell(m.get("ratio_to_value"), ".2f"),
                f"{m['error']:.1e}",
                cell(m.get("gradient_error"), ".1e"),
                ", ".join(periods) or "-",
            ]
        )
    return rows_of(headings, rows)


def choice(result: dict[str, Any]) -> str:
    """Which method to take for one cycle, in one sentence."""
    own = [m for m in result["methods"] if m["group"] == "package"]
    values = [m for m in own if m["kind"] == "value"]
    value = min(values, key=lambda m: (m["error"] > 1e-9, m["seconds"]))
    slope = min((m for m in own if m["gradient_error"] is not None), key=lambda m: m["seconds"])
    text = (
        f"For one cycle take `fj.limit_cycle` by the exact law: {value['seconds'] * 1e3:.2g} ms"
        f" for an error of {value['error']:.0e} ({value['segments']} segments), the gradient for"
        f" {slope['ratio_to_value']:.2g} times that"
    )
    peers = [m for m in result["methods"] if m["group"] == "exact" and m["error"] < 1e-8]
    if peers:
        peer = min(peers, key=lambda m: m["seconds"])
        text += (
            f"; {peer['name']}, takes {peer['seconds'] / value['seconds']:.1f} times as long"
            f" for {peer['error']:.0e}"
        )
    tanh = [m for m in result["methods"] if m["group"] == "tanh"]
    best = min(tanh, key=lambda m: m["seconds"])
    return text + (
        f", and the fastest tanh law, {best['name']}, {best['seconds'] / value['seconds']:.0f}"
        f" times as long for {best['error']:.0e}."
    )


def table(result: dict[str, Any]) -> str:
    """The Markdown page: for each table one sentence that says what to take."""
    many_ = result["batch"]
    two, errors = many_["sharded"], many_["error"]
    batches, over_two = [(1, many_)], ""
    if two:
        batches.append((two["devices"], two))
        over_two = (
            f", {two['cycles_per_second']:.0f} over {two['devices']} virtual devices of the same"
            f" processor (values differ by at most {two['differs']:.0e})"
        )
    lines = [
        "# The stick-slip limit cycle: error against run time",
        "",
        choice(result),
        "",
        *one_cycle_table(result),
        "",
        "Time is that of one warm call from the plain start; compile time is apart. Errors are"
        " relative, of the peak to peak of x1 and of its derivative by K_n at fixed K_t/K_n,"
        " against a solution with 20 digits."
        f" The transients run {PERIODS} periods: the slowest Floquet multiplier is 0.797, so that"
        " about 90 periods after the first 30 give 1e-9. A tanh law is done earlier, as its error"
        " stops at a floor that only a smaller eps lowers; the last column says after how many"
        f" periods, and its steps are at most {CAP} eps/V (in 1/omega), lest it jump the layer.",
        "",
    ]
    peer = next((m for m in result["methods"] if "seconds_of_gradient" in m), None)
    if peer:
        lines += [
            "The derivative of heyoka is a central difference, two more runs of"
            f" {peer['seconds_of_gradient'] * 1e3:.3g} ms together, the integrators already built.",
            "",
        ]
    if result["not_installed"]:
        lines += [f"Not installed: {', '.join(result['not_installed'])}.", ""]
    lines += [
        "## Many cycles",
        "",
        f"For many cycles take one `jax.vmap`: {many_['cycles_per_second']:.0f} cycles a second on"
        f" one device{over_two}.",
        "",
        *rows_of(
            ["devices", "cycles", "compile [s]", "time [s]", "cycles a second"],
            [
                [
                    str(n),
                    str(many_["cycles"]),
                    f"{x['compile_s']:.1f}",
                    f"{x['seconds']:.3g}",
                    f"{x['cycles_per_second']:.0f}",
                ]
                for n, x in batches
            ],
        ),
        "",
        f"K_n {RANGE[0]:.0e} to {RANGE[1]:.0e} N/m, fastest of the repeats;"
        f" {many_['not_converged']} of {many_['cycles']} did not converge"
        f" ({many_['not_converged_with_96']} with 96 segments). Against the run with 96 segments"
        f" the amplitude is off by {errors['median']:.0e} (median) and {errors['worst']:.0e}"
        f" (worst); {errors['above_1e-6']} differ by more than 1e-6, the others by at most"
        f" {errors['worst_of_the_others']:.0e}.",
        "",
        "## Stiff and extreme",
        "",
        "Take the exact law here as well, and read `result` before the numbers: it says where"
        " there is no cycle to find.",
        "",
        *rows_of(
            [
                "scene",
                "result",
                "growth / omega",
                "turns",
                "period [s]",
                "estimated error",
                "trivial multiplier - 1",
                "time [ms]",
                "non-finite",
            ],
            [
                [
                    r["name"],
                    r["result"],
                    cell(r["growth_by_omega"], ".1e"),
                    str(r["turns"]),
                    cell(r["period"], ".6g"),
                    cell(r["error"], ".1e"),
                    cell(r["trivial_multiplier_off"], ".1e"),
                    f"{r['seconds'] * 1e3:.3g}",
                    r["non_finite"] or "no",
                ]
                for r in result["extreme"]
            ],
        ),
        "",
    ]
    if result["stiff"]:
        lines += [
            "The tanh law of a small eps needs an implicit solver (Kvaerno5 here, three periods"
            " from a point of the exact cycle) and stays slower than the exact law: take it only"
            " to compare.",
            "",
            *rows_of(
                ["eps [m/s]", "result", "steps", "time [s]", "off the exact cycle, scaled"],
                [
                    [
                        f"{r['eps']:.0e}",
                        r["result"],
                        str(r["steps"]),
                        f"{r['seconds']:.3g}",
                        cell(r["off_the_exact_cycle"], ".1e"),
                    ]
                    for r in result["stiff"]
                ],
            ),
            "",
        ]
    lines += [
        ran_on(result),
        "",
    ]
    return "\n".join(lines)


def picture(result: dict[str, Any]) -> bytes:
    """Error of the amplitude against time, a marker a method."""
    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, axis = plt.subplots(figsize=(11, 6), layout="constrained")
    colours = {"package": "tab:blue", "package, regularised": "tab:cyan", "exact": "tab:green"}
    shapes = {"value": "o", "value and gradient, forward": "^", "value and gradient, reverse": "v"}
    for i, m in enumerate(result["methods"]):
        axis.loglog(
            m["seconds"],
            max(m["error"], 1e-16),
            shapes.get(m.get("kind"), "sDP*X<>hp"[i % 9]),
            markersize=9,
            color=colours.get(m["group"], "tab:red"),
            fillstyle="none",
            markeredgewidth=1.6,
            label=m["name"],
        )
    axis.margins(0.1)
    axis.grid(True, which="major", alpha=0.4)
    axis.set(xlabel="time [s]", ylabel="amplitude of x1: relative error [-]")
    figure.legend(loc="outside right upper", fontsize="small")
    figure.suptitle("Limit cycle: error against run time")
    return png(figure, dpi=130)


def run(out: Path, quick: bool = False) -> list[Path]:
    """Measure, and write limit_cycle.json, .md and .png into a folder; returns their paths."""
    result = measure(quick)
    return write(out, "limit_cycle", result, table(result), picture(result))


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    print(json.dumps(sharded_times(int(sys.argv[1]), int(sys.argv[2]))))
