"""Of many degrees of freedom steps and segments follow the motion, far slower than the fastest."""

import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import fractaljax as fj
import hybrid_truth
from benchmarks.many_dofs import rods
from fractaljax._dynamics.excitation import excited_system
from fractaljax._dynamics.hybrid import HybridSystem
from fractaljax._dynamics.runge_kutta import stability_polynomial
from fractaljax._dynamics.scaled import hybrid_system
from fractaljax._dynamics.segments import flow, tableau
from structures import monodromy_of, truth_of
from tools import both_modes

system = jax.jit(hybrid_system)
field, guards = jax.jit(HybridSystem.field), jax.jit(HybridSystem.guards)


@functools.cache
def system_of(n):
    return system(rods(n))


@pytest.mark.slow
def test_largest_rate_and_the_factor_of_a_step():
    """Within a per cent; damping makes some modes faster than their frequency."""
    system = system_of(40)
    eye, zero = np.eye(40), np.zeros((40, 40))
    rates = abs(np.linalg.eigvals(np.block([[zero, eye], [-system.K, -system.C]])))
    assert rates.max() > 1.2
    assert system.fastest == pytest.approx(rates.max(), rel=1e-2)
    assert system_of(8).fastest is None
    excited: Any = jax.jit(excited_system)(rods(16), fj.Excitation({0: 1.0}, 1e3))
    assert excited.products.matrix.shape == (3 * 6 + 17, 34)
    assert excited.fastest == pytest.approx(2e3 * np.pi / float(excited.omega))
    # Of a linear field; to eighth order the exponential's.
    found = stability_polynomial(tableau())
    np.testing.assert_allclose(found[:9] * np.cumprod([1, *range(1, 9)]), 1, rtol=1e-12)
    system = system_of(12)
    y, s = jnp.ones((24, 1)), jnp.ones((6, 1))
    slope, still, moved = programs(system, y, s)
    rest = np.linalg.solve(slope, still)
    z, A = 1.5 * np.asarray(slope), np.zeros((24, 24))
    for c in found[::-1]:
        A = A @ z + c * np.eye(24)
    # Friction falls with speed: its slope is not the same everywhere.
    gap = np.asarray(moved) - (A @ (1 + rest) - rest)
    assert abs(gap).max() < 0.05


@pytest.mark.parametrize("s", [(1, 1, 1, 1, 1, 1), (0, 0, -1, -1, 2, 2), (0, 1, 0, 1, 1, 1)])
def test_field_and_guards_by_what_is_seen_at_the_faces(s, monkeypatch):
    """As without those products, which a system with load curves cannot use, in every state."""
    system = system_of(12)
    rng = np.random.default_rng(1)
    y, s = jnp.asarray(rng.standard_normal((24, 3))), jnp.tile(jnp.array(s, float)[:, None], 3)
    found = [of(system, y, s) for of in (field, guards)]
    monkeypatch.setattr(HybridSystem, "_at_faces", None)
    for of, was in zip((HybridSystem.field, HybridSystem.guards), found, strict=True):
        plain = jax.jit(lambda *given, of=of: of(*given))(system, y, s)
        np.testing.assert_allclose(was, plain, rtol=1e-11, atol=1e-11)


@jax.jit
def programs(system, y, s):
    """Slope of the field, the field at 0, and the end of a step of 1.5, for states (2n, 1)."""
    slope = jax.jacfwd(lambda y: system.field(y[:, None], s)[:, 0])(y[:, 0])
    end = flow(system, y, jnp.full(1, 1.5), s)
    return slope, system.field(0 * y, s)[:, 0], end[:, 0]


@pytest.mark.slow
def test_cycles_of_many_degrees_of_freedom():
    """Two side by side, with slopes in both modes, beside the independent solver.

    Each takes 300/omega a period.
    """
    structure = rods(40)

    @jax.jit
    @jax.vmap
    def found(P):
        def period(P):
            cycle = fj.limit_cycle(structure.replace(**{"tip.P": P[0]}), throw=False)
            return cycle.period[None], (cycle, monodromy_of(cycle))

        return both_modes(period, P[None], has_aux=True)

    P = jnp.array([1.0, 1.1])
    _, *slopes, (cycles, flows) = found(P)
    assert (cycles.result == fj.CycleResult.converged).all()
    omega = float(hybrid_system(structure).omega)
    assert float(cycles.period.min()) * omega > 300

    for i, forward, reverse in zip(range(2), *slopes, strict=True):
        cycle = jax.tree.map(lambda leaf, i=i: leaf[i], cycles)

        def closed(P, cycle=cycle, flow=flows[i]):
            own = truth_of(structure.replace(**{"tip.P": P}))
            z, T = np.asarray(cycle.state) / own.units, float(cycle.period) * own.omega
            return own, *hybrid_truth.closed(own.scaled, z, T, 1e-12, own.map_in_units(flow))

        own, z, T, trip = closed(P[i])
        assert T / own.omega == pytest.approx(float(cycle.period), rel=1e-9)
        state, stick = z * own.units, hybrid_truth.shares(own.scaled, trip)[0] / T
        np.testing.assert_allclose(cycle.state, state, rtol=0, atol=1e-8 * abs(state).max())
        np.testing.assert_allclose(cycle.stick_fraction, stick, atol=1e-8)
        assert stick[0] > 0.1 and stick[2] > 0.05
        ends = [T / own.omega for own, _, T, _ in map(closed, (P[i] - 1e-4, P[i] + 1e-4))]
        assert forward[0, 0] == pytest.approx((ends[1] - ends[0]) / 2e-4, rel=1e-6)
        np.testing.assert_allclose(reverse, forward, rtol=1e-9)
