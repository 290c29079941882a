"""Run-in: a rough surface worn by the smooth rigid flat that slides on it.

Archard's wear takes off height in proportion to the pressure, whatever the path (J. F. Archard, J.
Appl. Phys. 24, 981, 1953, doi:10.1063/1.1721448). A step that takes off a mean height d under the
nominal pressure p_0 takes off c p at each point, c = d/p_0. In the implicit method of Euler p is
the pressure after the step,

    S p + g = h - c p  where p > 0,    S p + g >= h  where p = 0,    mean(p) = p_0,

which is the contact of `boundary_element.py` with c added to the compliance 2/(E |q|) of each wave.
In full contact a step divides a wave by 1 + c E |q|/2; small steps make it decay exponentially.
"""

import functools
from typing import final

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float, ScalarLike

from .._base.parts import Numbers, Record, flag, raise_unless, scalar, whole
from .._surface.heights import height_statistics
from .boundary_element import (
    BoundaryElementResult,
    Convergence,
    boundary_element,
    check_map,
    press_layered,
    rms,
)
from .material import Material


@final
class WornSurface(Record):
    """A surface after run-in, as `run_in` returns it; SI units.

    It is that of a depth of wear. The wear coefficient, which tells the sliding distance or the
    time of that depth, is the user's.
    """

    heights: Float[Array, "nx ny"]  # [m], those before less the wear
    pressure: Float[Array, "nx ny"]  # [Pa], that of the elastic contact of these heights
    dx: Numbers  # grid spacing [m]
    material: Material
    result: BoundaryElementResult  # a member of BoundaryElementResult

    @property
    def K_n(self) -> Float[Array, ""]:
        """Normal stiffness [N/m] of the map's area, nx ny dx^2, at the pressure of the run-in.

        It is that of `boundary_element`, with its derivatives; infinite at full contact.
        """
        P = jnp.sum(self.pressure) * self.dx**2
        return boundary_element(self.heights, self.dx, self.material, P).K_n

    @property
    def Sq(self) -> Float[Array, ""]:
        """Root mean square height [m] about the mean."""
        return self._statistics().root_mean_square

    @property
    def Ssk(self) -> Float[Array, ""]:
        """Skewness of the heights: below 0 for plateaus above valleys."""
        return self._statistics().skewness

    @property
    def Sku(self) -> Float[Array, ""]:
        """Kurtosis of the heights: 3 for Gaussian ones."""
        return self._statistics().kurtosis

    def _statistics(self):
        return height_statistics(self.heights - jnp.mean(self.heights))


def run_in(
    z: Float[ArrayLike, "nx ny"],
    dx: ScalarLike,
    material: Material,
    pressure: ScalarLike,
    depth: ScalarLike,
    *,
    steps: int = 16,
    rtol: float | None = None,
    max_steps: int = 2000,
    throw: bool = True,
) -> WornSurface:
    """Wear a rough surface by a smooth rigid flat that is pressed and slides on it.

    The map is periodic, its contact elastic and frictionless as in `boundary_element`, and every
    point loses height in proportion to its pressure (Archard); the equations are in `run_in.py`.
    How long a depth takes is not said here: depth = k pressure (sliding distance), where the user
    has measured the wear rate k [1/Pa], the wear coefficient over the hardness. There is no debris,
    no third body, no wear of the flat and no plastic flow, and friction does not change.

    The depth is divided into equal steps. Their error falls as 1/steps: with 16 it is 1e-4 in Sq,
    5e-4 in Sdq and .005 in K_n after a depth of a tenth of Sq, less than from one map to another.

    Differentiable in z, dx, E, pressure and depth, in both modes, and works under `jit` and `vmap`.
    Heights and pressure have their exact derivatives on the grid. There are no second derivatives.

    **Arguments:**

    - `z`: (nx, ny), heights of the surface [m], the highest next to the flat.
    - `dx`: grid spacing [m], the same in x and y.
    - `material`: E is that of the pair (Eq. 2); nothing else counts.
    - `pressure`: nominal pressure [Pa], the load over nx ny dx^2, constant.
    - `depth`: mean height that is worn off [m], at least 0.
    - `steps`: steps into which the depth is divided, 1 to 1e6, by default 16.
    - `rtol`: bound on the largest gap in contact and overlap outside, over the rms height of z; by
      default 1e-9, and 1e-5 in float32.
    - `max_steps`: most iterations of each contact, 2000 by default.
    - `throw`: True, the default, raises unless every contact has converged; otherwise `result` says
      how they ended.

    **Returns:** a `WornSurface`.

    **Raises:** `ValueError` unless z is (nx, ny) and finite, dx > 0, pressure > 0, depth >= 0,
    1 <= steps <= 1e6, 0 < rtol < 1 and max_steps >= 1; `RuntimeError` if `throw` and a contact has
    not converged. Under a trace (`jit`, `vmap`) everything is NaN instead.
    """
    dx, pressure = scalar("dx", dx, above=0), scalar("pressure", pressure, above=0)
    depth = scalar("depth", depth, at_least=0)
    z = check_map("z", z, material, dx, pressure, depth)
    convergence = Convergence.checked(rtol, max_steps, z.dtype)
    steps, throw = whole("steps", steps, 1, 10**6), flag("throw", throw)
    worn = _run_in(z, dx, material, pressure, depth, steps, convergence)
    return raise_unless(BoundaryElementResult.converged, worn) if throw else worn


@functools.partial(jax.jit, static_argnums=(5, 6))
def _run_in(z, dx, material, pressure, depth, steps, convergence):
    # Units of boundary_element.py: dx and E.
    flat = jnp.max(z) == jnp.min(z)  # their mean may be rounded
    h = jnp.where(flat, 0, z - jnp.mean(z)) / dx
    mean = jnp.asarray(pressure / material.E, z.dtype)
    c = jnp.asarray(depth / (dx * steps * mean), z.dtype)
    scale = rms(h)

    def wear_once(state, _):
        wear, _ = state
        p, residual = press_layered(h - wear, mean, c, scale, convergence)
        return (wear + c * p, p), residual

    start = jnp.zeros_like(h), jnp.zeros_like(h)
    (wear, p), residuals = jax.lax.scan(wear_once, start, length=steps)
    result = BoundaryElementResult.where(
        jnp.all(residuals <= convergence.rtol),
        BoundaryElementResult.converged,
        BoundaryElementResult.not_converged,
    )
    return WornSurface(z - wear * dx, p * material.E, dx, material, result)
