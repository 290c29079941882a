"""The public functions of the package on rows of plain numbers, as `points.py` makes them."""

from typing import Any

import jax
import jax.numpy as jnp

import fractaljax as fj

Numbers = dict[str, jax.Array]


def joint(x: jax.Array) -> tuple[tuple[Any, ...], dict[str, Any]]:
    """Surface, material, load and frictions of a row (10,)."""
    D, G, gamma, E, nu, sigma_y, H, P, mu_s, mu_m = x
    frictions = {"mu_s": mu_s, "mu_m": mu_m}
    return (fj.Surface(D, G, gamma), fj.Material(E, nu, sigma_y, H), P), frictions


def state(x: jax.Array) -> Numbers:
    """What `contact_state` gives, but the regime."""
    given, frictions = joint(x)
    found = vars(fj.contact_state(*given, **frictions))
    return {name: value for name, value in found.items() if name != "regime"}


def load_there_and_back(x: jax.Array) -> Numbers:
    """`contact_load` at the real area that `contact_state` has under the load P."""
    (surface, material, P), frictions = joint(x)
    A_r = fj.contact_state(surface, material, P, **frictions).A_r
    return {"P": fj.contact_load(surface, material, A_r, mu_m=frictions["mu_m"])}


def scene(x: jax.Array) -> fj.Scene:
    """The scene of a row (12,): known stiffness, friction that falls."""
    *oscillator, K_n, K_t, mu_s, mu_m, v_m = x
    contact, friction = fj.FixedContact(K_n, K_t), fj.Stribeck(mu_s, mu_m, v_m)
    return fj.Scene(contact, friction, fj.Oscillator(*oscillator))


def squeal(x: jax.Array) -> Numbers:
    """`growth_rate`, `margin` and what `stability` gives."""
    found = fj.stability(scene(x))
    more = {"real": found.eigenvalues.real, "imaginary": found.eigenvalues.imag}
    return growth_and_margin(x) | more | {"damping_ratio": found.damping_ratio}


def growth_and_margin(x: jax.Array) -> Numbers:
    return {"growth_rate": fj.growth_rate(scene(x)), "margin": fj.margin(scene(x))}


def rest(x: jax.Array) -> Numbers:
    """`equilibrium` at the sliding velocity of the belt."""
    given = scene(x)
    K_n, K_t = fj.stiffness(given)
    mu = given.friction.mu(given.oscillator.V)
    return {"x_0": jnp.stack(fj.equilibrium(given.oscillator, K_n, K_t, mu))}


def critical_friction(x: jax.Array) -> Numbers:
    """`critical_friction` without the slope of the law: the closed form."""
    return {"mu_c": fj.critical_friction(scene(x), friction_slope=False)}


def roughness(x: jax.Array) -> Numbers:
    """What `roughness` gives for a row (5,)."""
    D, G, gamma, L, L_s = x
    return dict(vars(fj.roughness(fj.Surface(D, G, gamma), L, L_s)))


def of_rows(function):
    """The compiled program of a function over rows (n, k), and of its two derivatives."""
    return [jax.jit(jax.vmap(f)) for f in (function, jax.jacfwd(function), jax.jacrev(function))]
