"""A contact state and a kind of joint force that are added in one place, against plain formulas."""

import dataclasses
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
import scipy.integrate

import fractaljax as fj
from fractaljax._dynamics import contact_state
from fractaljax._dynamics.contact_state import FORWARD, STATES, Change, State, find_state
from fractaljax._dynamics.exact_step import step_to_switch
from fractaljax._dynamics.guard import NONE
from fractaljax._dynamics.hybrid import HybridSystem
from fractaljax._dynamics.joint_force import JointForce
from fractaljax._dynamics.scaled import hybrid_system
from fractaljax._dynamics.transition import first_contact_state

FAST, LIMIT = 3, 1.8  # a slip above a sliding velocity, in units of V
FORWARD_ROW = find_state(FORWARD)
ROWS = (
    dataclasses.replace(
        FORWARD_ROW,
        guards=lambda faces, _: (faces.w, LIMIT - faces.w),
        upper=Change((FAST,), at_rest=False),
    ),
    *STATES[1:3],
    State(
        code=FAST,
        symbol="f",
        name="fast",
        description="slips fast",
        colour="tab:green",
        force=lambda faces: faces.system.friction(faces.w, faces.loads, jnp.ones_like(faces.s)) / 2,
        guards=lambda faces, _: (faces.w - LIMIT, None),
        lower=Change((FORWARD,), at_rest=False),
        upper=None,
        opening=FORWARD_ROW.opening,
    ),
)


class Planing(HybridSystem):
    """A system whose friction halves above a sliding velocity."""

    @property
    def states(self) -> tuple[State, ...]:
        return ROWS


def test_a_contact_state_is_a_row(monkeypatch):
    """A mass on a belt whose friction halves above 1.8 V: its states and times, beside scipy's."""
    joint = fj.Joint(fj.FixedContact(0.0, 0.0, P=1.0), fj.Coulomb(0.3), 0, V=0.5)
    structure = fj.Structure(np.eye(1), 0.02 * np.eye(1), np.eye(1), (joint,))
    plain = jax.jit(hybrid_system)(structure)
    fields = dataclasses.fields(plain)
    system = Planing(**{field.name: getattr(plain, field.name) for field in fields})
    length, end = float(plain.units[0]), 9.0

    def rate(t, y, share, sign):
        return [y[1], share * sign * 0.3 - 0.02 * y[1] - y[0]]

    # The independent solver: a phase at a time, in SI units.
    y, t, truth = np.array([1.5, 0.0]), 0.0, [(0.0, 1)]
    while t < end:
        s = truth[-1][1]
        share, sign = (0.5, 1) if s == FAST else (1, s)
        events = [lambda t, y, *_: 0.5 - y[1], lambda t, y, *_: 0.5 * (1 - LIMIT) - y[1]]
        for event, direction in zip(events, (-sign, 1 if s == FORWARD else -1), strict=True):
            vars(event).update(terminal=True, direction=direction)
        found = scipy.integrate.solve_ivp(
            rate, (t, end), y, args=(share, sign), events=events, rtol=1e-12, atol=1e-13,
            first_step=1e-3,
        )  # fmt: skip
        y, t = found.y[:, -1], float(found.t[-1])
        if t < end:
            stops = len(found.t_events[0]) > 0
            # Friction of 0.3 carries the mass on where the spring pulls with more than that.
            after = -s if stops else {FORWARD: FAST, FAST: FORWARD}[s]
            truth.append((t, after))

    step = jax.jit(lambda y, s, left: step_to_switch(system, y, s, 0.1, left, 1e-11))
    z = np.array([1.5 / length, 0.0])
    s, t, states = first_contact_state(system, z), 0.0, [(0.0, 1)]
    scaled_end = end * float(plain.omega)
    while t < scaled_end * (1 - 1e-12):
        z, s, h, guard = step(z, s, scaled_end - t)
        t += float(h)
        if guard != NONE:
            states.append((t / float(plain.omega), int(s[0])))
    states = [at for i, at in enumerate(states) if i == 0 or at[1] != states[i - 1][1]]
    assert [s for _, s in states] == [s for _, s in truth] and FAST in dict(truth).values()
    np.testing.assert_allclose([t for t, _ in states], [t for t, _ in truth], atol=1e-7)
    np.testing.assert_allclose(np.asarray(z) * np.asarray(plain.units), y, atol=1e-7)
    # Names are read from the table as well.
    monkeypatch.setattr(contact_state, "STATES", ROWS)
    assert (find_state(FAST).symbol, find_state(FAST).name) == ("f", "fast")


class Hardening(JointForce):
    """N/P = 1 + e + e^3."""

    exponent: ClassVar[int] = 3

    @property
    def opening(self) -> Any:
        return 0.6823278038280193

    def __call__(self, e):
        return 1 + e + e**self.exponent


def test_a_joint_force_is_a_class():
    """The field, the equilibrium and the opening of a joint that hardens."""
    rng = np.random.default_rng(2)
    A = rng.normal(size=(3, 3))
    K, C, F = 4 * np.eye(3) + 0.2 * (A + A.T), 0.1 * np.eye(3), np.array([0.3, -0.8, 0.1])
    t, n, K_n, P, mu, V = np.eye(3)[0], np.eye(3)[1], 3.0, 1.5, 0.4, 0.7
    contact = fj.FixedContact(K_n, 0.0, P=P)
    joint = fj.Joint(contact, fj.Coulomb(mu), 0, 1, V=V, preload=True)
    spring = jax.jit(hybrid_system)(fj.Structure(np.eye(3), C, K, (joint,), F=F))
    system = dataclasses.replace(spring, joint_forces=(Hardening(),))
    units, omega = np.asarray(system.units), float(system.omega)

    def normal_force(x):
        e = K_n * x[1] / P
        return P * (1 + e + e**3)

    def acceleration(x, u, sign):
        N = normal_force(x)
        return F - K @ x - C @ u - n * (N - P) + t * sign * mu * N

    for sign in (1, -1):
        y = 0.2 * rng.normal(size=6)
        field = np.asarray(system.field(y / units, np.full(2, float(sign))))[3:] * units[3:] * omega
        np.testing.assert_allclose(field, acceleration(y[:3], y[3:], sign), rtol=1e-12)
    x = np.asarray(system.equilibrium() * units)[:3]
    np.testing.assert_allclose(acceleration(x, np.zeros(3), 1), 0, atol=1e-12)
    assert abs(normal_force(x) / P - 1) > 0.1
    opened = np.array([0.0, -P / K_n * Hardening().opening, 0.0])
    assert abs(normal_force(opened)) < 1e-12
    assert abs(system.closures(opened / units[:3])[0]) < 1e-12
    assert system.guard_numbers.opening == (0,) and not system.affine
