"""Contact states after a guard has reached zero, beside the independent solver's choice.

Faces are coupled through inertia: a switch of one changes the forces on those that stick.
"""

import jax
import numpy as np

import hybrid_truth
from fractaljax._dynamics import transition
from fractaljax._dynamics.contact_state import OPEN
from fractaljax._dynamics.scaled import hybrid_system
from mechanisms import PROBLEMS
from structures import of_problem

JOINTS = [
    {
        "tangential": [1.0, 0.3, 0.0], "normal": [0.0, 1.0, 0.2], "V": 0.5, "P": 2.0,
        "K_n": 4.0, "K_t": 1.5, "friction": ("exponential", {"mu_s": 0.8, "mu_d": 0.4, "v_0": 0.5}),
    },
    {
        "tangential": [0.2, 0.0, 1.0], "normal": [1.0, -0.4, 0.0], "V": 0.4, "P": 1.5,
        "K_n": 3.0, "K_t": 1.0, "friction": ("coulomb", {"mu": 0.6}),
    },
]  # fmt: skip
PROBLEM = PROBLEMS["second_face"] | {"joints": JOINTS, "F": [0.3, -0.2, 0.1]}
TRUTH = hybrid_truth.Mechanism.of(PROBLEM)
FACES = len(TRUTH.faces)


def nearest(x, rows, values):
    """x moved to where rows @ x = values."""
    return x + np.linalg.pinv(rows) @ (values - rows @ x) if len(rows) else x


def case(seed):
    """A state at an event: z, the mode before, the event, and the guard's number."""
    rng = np.random.default_rng(seed)
    x, u = 0.5 * rng.normal(size=3), 0.5 * rng.normal(size=3)
    d, V = np.array([f.d for f in TRUTH.faces]), np.array([f.V for f in TRUTH.faces])
    kind = ["w", "w", "limit", "limit", "open", "close"][seed % 6]
    at = int(rng.integers(2 if kind in ("open", "close") else FACES))
    sticks = rng.random(FACES) < 0.4
    is_open = np.zeros(2, bool)
    if kind in ("open", "close"):
        is_open[at] = kind == "close"
        joint = TRUTH.joints[at]
        x = nearest(x, joint.K_n * joint.n[None], np.array([-joint.P]))
        guard = 1 + 2 * FACES + at
    else:
        sticks[at], side = True, int(rng.choice([1, -1]))
        guard = 1 + 2 * at + (kind == "limit" and side < 0)
    sticks &= ~is_open[[f.joint for f in TRUTH.faces]]
    sticks &= np.cumsum(sticks) <= 3
    if kind in ("w", "limit") and not sticks[at]:
        return None
    u = nearest(u, d[sticks], V[sticks])
    w = V - d @ u
    mode = np.where(sticks, 0, np.sign(w)).astype(int)
    if kind == "w":
        mode[at] = side
    mode[is_open[[f.joint for f in TRUTH.faces]]] = hybrid_truth.OPEN
    event = (kind, at, side) if kind == "limit" else (kind, at)
    return np.concatenate([x, u]), tuple(int(s) for s in mode), event, guard


def test_transitions():
    """Of 3000 events; in two of three the switch releases a face that stuck."""
    system = jax.jit(hybrid_system)(of_problem(PROBLEM))
    switch = jax.jit(lambda y, s, guard: transition.switch(system, y, s, guard)[1])
    units = np.asarray(system.units)
    cases = [made for seed in range(3000) if (made := case(seed))]
    compared = released = 0
    for z, mode, event, guard in cases:
        try:
            after, _ = hybrid_truth.next_mode(TRUTH, z, 0.0, mode, event)
        except hybrid_truth.Impossible:
            continue
        s = np.where(np.array(mode) == hybrid_truth.OPEN, OPEN, mode).astype(float)
        wanted = np.where(np.array(after) == hybrid_truth.OPEN, OPEN, after)
        found = switch(z / units, s, guard)
        np.testing.assert_array_equal(found, wanted, err_msg=f"{event} in {mode}")
        compared += 1
        released += any(
            a == 0 != b
            for i, (a, b) in enumerate(zip(mode, after, strict=True))
            if event[:2] != ("limit", i)
        )
    assert compared > 2900 and released > 1500
