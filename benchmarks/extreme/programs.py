"""The public functions of the package on rows of plain numbers, as `points.py` makes them."""

from typing import Any

import jax
import jax.numpy as jnp

import fractaljax as fj

Numbers = dict[str, jax.Array]


def joint(x: jax.Array) -> tuple[fj.Surface, fj.Material, Any, dict[str, Any]]:
    """Surface, material, load and frictions of a row (10,)."""
    D, G, gamma, E, nu, sigma_y, H, P, mu_s, mu_m = x
    frictions = {"mu_s": mu_s, "mu_m": mu_m}
    return fj.Surface(D, G, gamma), fj.Material(E, nu, sigma_y, H), P, frictions


def state(x: jax.Array) -> Numbers:
    """What `contact_state` gives, but the regime."""
    surface, material, P, frictions = joint(x)
    found = fj.contact_state(surface, material, P, **frictions)
    return {name: value for name, value in vars(found).items() if name != "regime"}


def contact_stiffness(x: jax.Array) -> Numbers:
    """K_n and K_t of `contact_state` alone."""
    found = state(x)
    return {name: found[name] for name in ("K_n", "K_t")}


def regime(x: jax.Array) -> Any:
    """The regime of `contact_state`."""
    surface, material, P, frictions = joint(x)
    return fj.contact_state(surface, material, P, **frictions).regime


def load_there_and_back(x: jax.Array) -> Numbers:
    """`contact_load` at the real area that `contact_state` has under the load P."""
    surface, material, P, frictions = joint(x)
    A_r = fj.contact_state(surface, material, P, **frictions).A_r
    return {"P": fj.contact_load(surface, material, A_r, mu_m=frictions["mu_m"])}


def scene(x: jax.Array) -> fj.Scene:
    """The scene of a row (12,): known stiffness, friction that falls."""
    m, omega_1, omega_2, xi_1, xi_2, F, V, K_n, K_t, mu_s, mu_m, v_m = x
    return fj.Scene(
        fj.FixedContact(K_n, K_t),
        fj.Stribeck(mu_s, mu_m, v_m),
        fj.Oscillator(m, omega_1, omega_2, xi_1, xi_2, F, V),
    )


def squeal(x: jax.Array, friction_slope: bool = True) -> Numbers:
    """`growth_rate`, `margin` and what `stability` gives."""
    given = scene(x)
    found = fj.stability(given, friction_slope=friction_slope)
    return {
        "growth_rate": fj.growth_rate(given, friction_slope=friction_slope),
        "margin": fj.margin(given, friction_slope=friction_slope),
        "real": found.eigenvalues.real,
        "imaginary": found.eigenvalues.imag,
        "damping_ratio": found.damping_ratio,
    }


def growth_and_margin(x: jax.Array) -> Numbers:
    """`growth_rate` and `margin` alone."""
    given = scene(x)
    return {"growth_rate": fj.growth_rate(given), "margin": fj.margin(given)}


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


def of_rows(function, *options):
    """The compiled program of a function over rows (n, k), and of its two derivatives."""
    one = lambda x: function(x, *options)  # noqa: E731
    return jax.jit(jax.vmap(one)), *(
        jax.jit(jax.vmap(mode(one))) for mode in (jax.jacfwd, jax.jacrev)
    )
