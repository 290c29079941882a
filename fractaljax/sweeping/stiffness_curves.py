"""Contact stiffness over two quantities of a scene, as the source's Figs. 2 to 4 show it."""

import dataclasses
import functools
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp

from ..base.parts import Record, number, substitute
from ..base.singular import safe_divide
from ..mechanism.contact import Regime, load_of_area
from ..mechanism.quantities import substituted, unit, with_optional
from ..mechanism.scene import Scene
from ..modes.maps import grid_over

_LENGTH, _LOAD = "G", "P"  # what a dimensionless form changes among the axes


class StiffnessCurves(Record):
    """The stiffness of a joint over x, a curve for each y, as `stiffness_over` returns it.

    Slopes are those of the logarithm, d ln K/dx, and NaN where a stiffness is 0.
    """

    names: tuple[str, str] = eqx.field(static=True)  # of x and y
    units: tuple[str, str] = eqx.field(static=True)
    x: jax.Array  # (n,)
    y: jax.Array  # (m,)
    K_n: jax.Array  # (m, n), normal stiffness [N/m], 0 where fully plastic
    K_t: jax.Array  # (m, n), tangential stiffness [N/m], 0 also in gross slip
    K_n_slope: jax.Array  # (m, n), d ln K_n/dx
    K_t_slope: jax.Array  # (m, n), d ln K_t/dx
    A_r: jax.Array  # (m, n), real contact area [m^2]
    P: jax.Array  # (m, n), normal load [N]
    regime: Regime  # (m, n), members of Regime
    E: jax.Array  # (m, n), equivalent modulus [Pa]
    A_a: jax.Array | None = None  # apparent area [m^2] of a dimensionless form

    def dimensionless(self, A_a) -> "StiffnessCurves":
        """Eqs. 31 and 37: K/(E sqrt(A_a)), A_r/A_a, G/sqrt(A_a) and P/(E A_a), all without a unit.

        The stiffness as it is does not depend on the apparent area A_a [m^2], which is a scalar.

        **Raises:** `ValueError` unless A_a > 0, for what is dimensionless already, and for a load
        on an axis beside a modulus on the other.
        """
        A_a = number("A_a", A_a, above=0)
        if self.A_a is not None:
            raise ValueError("the curves are dimensionless already")
        if {_LOAD, "E"} <= set(self.names):
            raise ValueError("P* = P/(E A_a) is no axis where E changes")
        scales = {_LENGTH: jnp.sqrt(A_a), _LOAD: self.E[0, 0] * A_a}
        scale_x, scale_y = (scales.get(name, 1.0) for name in self.names)
        names = tuple(f"{name}*" if name in scales else name for name in self.names)
        units = tuple(
            "-" if name in scales else unit
            for name, unit in zip(self.names, self.units, strict=True)
        )
        stiffness = self.E * jnp.sqrt(A_a)
        return dataclasses.replace(
            self,
            names=names,
            units=units,
            x=self.x / scale_x,
            y=self.y / scale_y,
            K_n=self.K_n / stiffness,
            K_t=self.K_t / stiffness,
            K_n_slope=self.K_n_slope * scale_x,
            K_t_slope=self.K_t_slope * scale_x,
            A_r=self.A_r / A_a,
            P=self.P / (self.E * A_a),
            A_a=A_a,
        )


def stiffness_over(
    scene: Scene, x: tuple[str, Any], y: tuple[str, Any], A_r: Any = None
) -> StiffnessCurves:
    """Stiffness over two quantities, each a name and its values (n,) and (m,), as `modes_over`.

    Under the scene's load, or, with `A_r` [m^2] given, under the load that makes the real contact
    area this large at every point: Eqs. 31 and 37 take it as given.

    **Raises:** `ValueError` for a contact that is not fractal, an unknown name, two names of one
    quantity, values that are not one-dimensional or outside their domain, A_r <= 0 or P beside it,
    and for a scene that holds arrays.
    """
    if not scene.contact.fractal:
        raise ValueError("stiffness over a surface needs a FractalContact: a FixedContact has none")
    across, up, _ = grid_over(scene, x, y)
    names = x[0], y[0]
    if A_r is not None:
        A_r = number("A_r", A_r, above=0)
        if _LOAD in names:
            raise ValueError("the load follows from A_r: P cannot be an axis beside it")
    found = _states(with_optional(scene, names), names, across, up, A_r)
    units = unit(scene, names[0]), unit(scene, names[1])
    return StiffnessCurves(names, units, across, up, *found)


@functools.partial(jax.jit, static_argnames="names")
def _states(scene, names, across, up, A_r):
    def at(x, y):
        moved = substituted(scene, dict(zip(names, (x, y), strict=True)))
        contact, friction = moved.contact, moved.friction
        if A_r is not None:
            load = load_of_area(contact.surface, contact.material, A_r, friction.mu_m)
            contact = substitute(contact, {"P": load})
        state = contact.state(friction.mu_s, friction.mu_m)
        return (state.K_n, state.K_t), (state.A_r, contact.P, state.regime, contact.material.E)

    def one(x, y):
        stiffness, slopes, rest = jax.jvp(
            lambda x: at(x, y), (x,), (jnp.ones_like(x),), has_aux=True
        )
        relative = (
            safe_divide(slope, K, jnp.full_like(K, jnp.nan))
            for slope, K in zip(slopes, stiffness, strict=True)
        )
        return *stiffness, *relative, *rest

    return jax.vmap(lambda y: jax.vmap(lambda x: one(x, y))(across))(up)
