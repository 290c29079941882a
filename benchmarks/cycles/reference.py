"""The limit cycle that several pages measure: its scene, and what is known of it to 20 digits."""

import math
from typing import Any

import jax
import jax.numpy as jnp

import fractaljax as fj

# F acts at 45 degrees; mass is 1 kg.
OSCILLATOR = {
    "omega_1": 2000 * math.pi,
    "omega_2": 1600 * math.pi,
    "xi_1": 1e-3,
    "xi_2": 7e-3,
    "F": 5.0,
}
K_N, KAPPA, MU_S, MU_M, V_M, V = 4e8, 0.5, 0.4, 0.25, 0.5, 0.15
SCALE = 2e4  # sqrt(K_n/m) [1/s]
PERIOD = 6.467445952469732345405 / SCALE  # s
AMPLITUDE = 2.290139035337965256497 * V / SCALE  # m: peak to peak of x1
# Derivatives of period and amplitude: by K_n at fixed K_t/K_n with 19 digits, by mu_s at fixed
# mu_m and by V with the nine to ten digits of tests/reference/cycle.json.
SLOPES = {
    "K_n": (-3.778482645969588942e-13, -2.137527543171888603e-14),
    "mu_s": (2.9293397590337195e-05, 1.571030430586891e-05),
    "V": (-2.295324305437884e-05, 1.0063974100762737e-4),
}
PLACE = {"K_n": K_N, "mu_s": MU_S, "V": V}
MEMBERS = (
    "converged",
    "inaccurate",
    "not_periodic",
    "too_stiff",
    "exhausted",
    "equilibrium",
    "diverged",
    "depends_on_eps",
    "unstable",
)


def reference(K_n: Any = K_N, mu_s: Any = MU_S, V: Any = V) -> fj.Scene:
    """The reference scene, its K_n (and K_t with it), mu_s or V changed."""
    oscillator = fj.Oscillator(m=1.0, **OSCILLATOR, V=V)
    contact = fj.FixedContact(K_n, KAPPA * K_n)
    return fj.Scene(contact, fj.Stribeck(mu_s, MU_M, V_M), oscillator)


def relative(found, truth: float) -> float:
    """Relative error."""
    return abs(float(found) / truth - 1)


def member(cycle: fj.LimitCycle) -> jax.Array:
    """The place of a cycle's result in MEMBERS."""
    hits = [cycle.result == getattr(fj.CycleResult, name) for name in MEMBERS]
    return jnp.argmax(jnp.stack(hits))
