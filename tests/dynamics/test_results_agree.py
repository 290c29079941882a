"""Every result of `limit_cycle` beside the numbers that come with it, of random mechanisms.

Two bodies on springs, one on a belt, forced or not, with friction that is constant, falls gently,
or falls within a hundredth of the belt's velocity; one in six has negative damping, without which
nothing diverges.
"""

import numpy as np
import pytest

import fractaljax as fj

SLOW = pytest.mark.slow
R = fj.CycleResult
FOUND = R.converged, R.inaccurate, R.unstable, R.depends_on_eps


def mechanism(seed, kind):
    """A structure, its start [m, m/s], a harmonic force, and whether damping is positive."""
    rng = np.random.default_rng([seed, len(kind)])
    m, k, k_c = rng.uniform(0.5, 2, 2), rng.uniform(0.5, 2, 2), rng.uniform(0, 1)
    damped = seed % 6 != 5
    c = 10 ** rng.uniform(-2.5, -0.7) * (1 if damped else -1)
    mu_s, V, P = rng.uniform(0.3, 0.9), 10 ** rng.uniform(-1.5, 0), rng.uniform(0.5, 2)
    mu_d = mu_s * rng.uniform(0.4, 0.9)
    law = {
        "constant": lambda: fj.Coulomb(mu_s),
        "gentle": lambda: fj.ExponentialStribeck(mu_s, mu_d, V * rng.uniform(0.5, 5)),
        "steep": lambda: fj.ExponentialStribeck(mu_s, mu_d, V * 10 ** rng.uniform(-2, -1)),
    }[kind]()
    K = np.diag(k) + k_c * np.array([[1.0, -1.0], [-1.0, 1.0]])
    joint = fj.Joint(fj.FixedContact(1.0, 0.0, P=P), law, tangential=[1.0, 0.0], V=V, preload=True)
    structure = fj.Structure(M=np.diag(m), C=c * (np.diag(m) + K), K=K, joints=[joint])
    start = rng.uniform(-1, 1, 4) * [1.0, 1.0, V, V]
    force = fj.Excitation([0.3 * P, 0.0], rng.uniform(0.1, 0.4))
    return structure, start, force, damped


def largest_of_motion(cycle, forced) -> float:
    """The modulus of the largest multiplier that says whether the cycle attracts."""
    found = np.asarray(cycle.multipliers)
    if not forced:
        found = np.delete(found, np.argmin(abs(found - 1)))
    return float(abs(found).max())


def check(seed, kind, forced) -> str:
    """The name of the result, after what it claims has been looked at."""
    structure, start, force, damped = mechanism(seed, kind)
    excitation = force if forced else None
    cycle = fj.limit_cycle(
        structure, start, excitation=excitation, segments=256, max_returns=400, throw=False
    )
    result = cycle.result
    numbers = [float(cycle.period), float(cycle.error), *cycle.state, *cycle.amplitude]
    if any(bool(result == member) for member in FOUND):
        assert np.isfinite(numbers).all()
        largest, error = largest_of_motion(cycle, forced), float(cycle.error)
        if result == R.converged:
            assert error <= 1e-9 and largest <= 1 + 100 * error + 1e-9
        if result == R.inaccurate:
            assert error > 1e-9
        if result == R.unstable:
            assert largest > 1 + 1e-10
        period = float(cycle.period)
        if forced:
            assert period * force.frequency == pytest.approx(int(cycle.returns), rel=1e-12)
        again = fj.simulate(structure, cycle.state, period, excitation=excitation, max_steps=20000)
        units = np.asarray(cycle._system.units)
        gap = abs(np.asarray(again.end - cycle.state) / units).max()
        size = 1 + abs(np.asarray(cycle.state) / units).max()
        assert gap < size * max(1e-6, 100 * error) * max(1, largest)
        return str(R[result])
    assert np.isnan(numbers).all()
    if result == R.equilibrium:
        growth = float(fj.growth_rate(structure))
        assert growth < 0 and not forced
        at_rest = cycle._system.equilibrium() * cycle._system.units
        motion = fj.simulate(structure, start, 12 / -growth, max_steps=100000)
        away = np.asarray(motion.states) - np.asarray(at_rest)
        assert abs(away[-1]).max() < 1e-3 * abs(away).max()
    if result == R.diverged:
        assert not damped
        motion = fj.simulate(
            structure, start, 1e4, excitation=excitation, max_steps=100000, throw=False
        )
        assert motion.result != fj.SimulationResult.reached
    return str(R[result])


@pytest.mark.parametrize(("kind", "forced"), [("constant", True), ("steep", False)])
def test_some(kind, forced):
    """Forced dry friction, whose orbits were called repelling, and steep laws, once divergence."""
    found = [check(seed, kind, forced) for seed in range(10)]
    assert found.count(str(R[R.converged])) >= 3, found


@SLOW
@pytest.mark.parametrize("forced", [False, True])
@pytest.mark.parametrize("kind", ["constant", "gentle", "steep"])
def test_many(kind, forced):
    """Sixty of each kind; cycles, rest and divergence are among them."""
    found = [check(seed, kind, forced) for seed in range(10, 70)]
    counts = {name: found.count(name) for name in set(found)}
    # Constant friction on one body rarely squeals.
    assert counts[str(R[R.converged])] >= (1 if kind == "constant" and not forced else 15), counts
    assert counts[str(R[R.diverged])] >= 1, counts
    if not forced:
        assert counts[str(R[R.equilibrium])] >= 1, counts
