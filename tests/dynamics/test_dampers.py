"""Friction without a belt, V = 0: a block on a spring that a harmonic force moves.

Truth: the closed form of Den Hartog (Trans. ASME 53, 107, 1931) without stops, and
tests/hybrid_truth.py with them.
"""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import fractaljax as fj
from hybrid_truth import Mechanism, forced_cycle
from tools import both_modes, refusals

M, K, F, MU = 2.0, 50.0, 3.0, 0.5
OMEGA = np.sqrt(K / M)


def damper(r, f, zeta=0.0, V=0.0) -> tuple[fj.Structure, fj.Excitation]:
    """The block at r times its frequency, with the friction f F and the damping ratio zeta."""
    joint = fj.Joint(fj.FixedContact(1.0, 0.0, P=f * F / MU), fj.Coulomb(MU), [1.0], V=V)
    C = jnp.reshape(2 * zeta * M * OMEGA, (1, 1))
    return fj.Structure([[M]], C, [[K]], joint), fj.Excitation([F], r * OMEGA / (2 * jnp.pi))


def closed_form(x):
    """Half of peak to peak over F/k, of an undamped motion that never stops."""
    r, f = x
    response = 1 / (1 - r**2)
    sliding = jnp.sin(jnp.pi / r) / (r * (1 + jnp.cos(jnp.pi / r)))
    return jnp.sqrt(response**2 - (f * sliding) ** 2)


@jax.jit
def numerical(x):
    """The same of the cycle by r, f and zeta, in both modes, and the cycle."""

    def outputs(x):
        x, excitation = damper(*x)
        found = fj.limit_cycle(x, excitation=excitation, throw=False)
        return found.amplitude / 2 / (F / K), found

    return both_modes(outputs, x, has_aux=True)


def test_den_hartog():
    """The amplitude and its derivatives by r and f; and the smaller one with damping."""
    value, *slopes, found = numerical(jnp.array([0.8, 0.2, 0.0]))
    truth, slope, _ = both_modes(closed_form, jnp.array([0.8, 0.2]))
    assert float(truth) == pytest.approx(2.7114152554375, rel=1e-13)
    np.testing.assert_allclose(value, [truth], rtol=1e-10)
    for own in slopes:
        np.testing.assert_allclose(own[0, :2], slope, rtol=1e-7)
    assert found.result == fj.CycleResult.converged and float(found.stick_fraction[0]) == 0
    damped, *_ = numerical(jnp.array([0.8, 0.2, 0.05]))
    assert 2 < float(damped[0]) < float(value[0])


def test_rest():
    """Where friction exceeds the force it sticks at rest, and all derivatives are 0."""
    value, *slopes, found = numerical(jnp.array([0.8, 1.5, 0.02]))
    assert found.result == fj.CycleResult.converged and float(found.stick_fraction[0]) == 1
    np.testing.assert_array_equal(value, [0])
    for slope in slopes:
        np.testing.assert_allclose(slope, 0, atol=1e-12)
    np.testing.assert_allclose(np.sort(abs(found.multipliers)), [0, 1], atol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("x", [(0.8, 0.2, 0.05), (0.3, 0.6, 0.02), (0.15, 0.8, 0.01)])
def test_stops(x):
    """Cycles with and without stops; derivatives by differences of the other solver."""
    value, forward, reverse, found = numerical(jnp.array(x))
    r, _, zeta = x

    def truth(f):
        joint = {
            "tangential": [1.0],
            "V": 0.0,
            "P": f * F / MU,
            "friction": ("coulomb", {"mu": MU}),
        }
        numbers = {"M": [[M]], "C": [[2 * zeta * M * OMEGA]], "K": [[K]], "F": [0.0]}
        solver = replace(
            Mechanism.of(numbers | {"joints": [joint]}),
            force=lambda t: F * np.cos(r * OMEGA * np.asarray(t))[..., None],
        )
        return forced_cycle(solver, found.state, 2 * np.pi / (r * OMEGA), settle=30)

    exact = truth(x[1])
    np.testing.assert_allclose(value * 2 * F / K, exact.amplitude, rtol=1e-9)
    np.testing.assert_allclose(found.stick_fraction, exact.stick_fraction, atol=1e-9)
    h = 1e-4
    slope = (truth(x[1] + h).amplitude - truth(x[1] - h).amplitude) / (2 * h) / (2 * F / K)
    for own in (forward, reverse):
        np.testing.assert_allclose(own[:, 1], slope, rtol=1e-5)


def decay(x):
    """Where the block comes to rest that starts at x with friction f F, with no excitation."""
    start, f = x
    step = 2 * f * F / K  # amplitudes fall by it in half a period
    swings = jnp.ceil(start / step - 0.5)
    return (-1.0) ** swings * (start - swings * step)


@pytest.mark.parametrize("size", [1.0, 1e-6])
def test_free_decay(size):
    """Without an excitation amplitudes fall by 2 mu N/k in each half period; then it sticks."""
    at = jnp.array([1.03, 1 / 1.2])

    @jax.jit
    def both(x):
        def end(x):
            structure, _ = damper(1.0, x[1])
            structure = structure.replace(P=size * x[1] * F / MU)
            start = size * x[0] * jnp.array([1.0, 0.0])
            found = fj.simulate(structure, start, 10.0, max_steps=256, throw=False)
            return found.end[:1] / size, found

        return both_modes(end, x, has_aux=True)

    value, *slopes, found = both(at)
    truth, *slopes_of_truth = both_modes(lambda x: decay(x)[None], at)
    assert found.result == fj.SimulationResult.reached
    np.testing.assert_allclose(value, truth, rtol=1e-8)
    for slope in slopes:
        np.testing.assert_allclose(slope, slopes_of_truth[0], rtol=1e-7)
    np.testing.assert_array_equal(found.contact_states[-1], [0])
    reversals = np.asarray(found.contact_states[1:] != found.contact_states[:-1]).sum()
    assert reversals == int(jnp.ceil(1.03 / (2 * F / 1.2 / K) - 0.5))


X, EXCITATION = damper(0.8, 0.2)
test_refusals = refusals(
    [
        (lambda: damper(0.8, 0.2, V=-1.0), "^V must be at least 0, got -1"),
        (
            lambda: fj.growth_rate(X),
            "^V of joint joint_1 must be above 0 for steady sliding, got 0",
        ),
        (lambda: fj.margin(X), "^V of joint joint_1 must be above 0 for steady sliding, got 0"),
        (lambda: fj.limit_cycle(X), "^V of joint joint_1 must be above 0 without an excitation"),
        (
            lambda: fj.basin(X, starts=8, radius=1.0),
            "^V of joint joint_1 must be above 0 without an excitation",
        ),
        (
            lambda: fj.simulate(X, t1=1.0),
            "^V of joint joint_1 must be above 0 without an excitation",
        ),
        (
            lambda: fj.simulate(X, [0, 0], 1.0),
            "^V of joint joint_1 must be above 0 without an excitation",
        ),
    ]
)
