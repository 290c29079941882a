"""Boundary elements: a rough surface pressed on an elastic half-space, periodic in x and y.

Here lengths are in units of the grid spacing dx and pressures in units of E, so that a solution
depends on heights and mean pressure only, and on the aspect dy/dx of a cell: only the wavenumbers
along y know of it. With S the half-space's displacement under a pressure,
2/|q| for each wave (Johnson, Contact Mechanics, 1985), the pressure p and the mean gap g of heights
h less their mean satisfy

    S p + g = h  where p > 0,    S p + g >= h  where p = 0,    mean(p) = given.

The solver is constrained conjugate gradients (Polonsky and Keer, Wear 231, 206, 1999,
doi:10.1016/S0043-1648(99)00113-1), preconditioned by |q| (Vollebergt, Appl. Math. Model. 38, 3509,
2014, doi:10.1016/j.apm.2013.12.004).
"""

import dataclasses
import functools
import math
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float, ScalarLike

from .._base.parts import Record, concrete, flag, raise_unless, require_kind, scalar, whole
from .._surface.heights import height_numbers
from .material import Material


class BoundaryElementResult(eqx.Enumeration):
    """How a boundary-element solution ended."""

    converged = "converged"
    not_converged = "boundary elements did not converge: rtol may be too small, or max_steps"
    too_soft = "the load exceeds what the surface carries at the hardness H everywhere"


class BoundaryElement(Record):
    """A rough contact, as `boundary_element` returns it; SI units."""

    K_n: Float[Array, ""]  # normal stiffness [N/m], infinite at full contact
    area: Float[Array, ""]  # real contact area [m^2]: counted, so it has no derivative
    mean_gap: Float[Array, ""]  # mean distance of the two surfaces [m]
    pressure: Float[Array, "nx ny"]  # [Pa]
    gap: Float[Array, "nx ny"]  # distance of the two surfaces [m], 0 in contact
    result: BoundaryElementResult  # a member of BoundaryElementResult


@dataclasses.dataclass(frozen=True)
class Convergence:
    """When an iteration ends."""

    rtol: float
    max_steps: int

    @classmethod
    def checked(cls, rtol: float | None, max_steps: int, dtype) -> "Convergence":
        if rtol is None:
            rtol = 1e-9 if dtype == jnp.float64 else 1e-5
        rtol = float(scalar("rtol", rtol, above=0, below=1))
        return cls(rtol, whole("max_steps", max_steps, 1))

    def continues(self, residual, count) -> Array:
        return (residual > self.rtol) & (count < self.max_steps)


class _Solution(NamedTuple):
    pressure: Array
    mean_gap: Array
    residual: Array  # largest violation of the conditions, over the rms height


def boundary_element(
    heights: Float[ArrayLike, "nx ny"],
    dx: ScalarLike,
    material: Material,
    P: ScalarLike,
    *,
    plastic: bool = False,
    aspect: float = 1.0,
    rtol: float | None = None,
    max_steps: int = 2000,
    throw: bool = True,
) -> BoundaryElement:
    """Press a rough surface on a flat one by the load P.

    Both are periodic, of area nx ny dx dy, and frictionless. K_n = -dP/d(mean gap) is the stiffness
    of the current contact: that of a flat punch of the same outline, from one more linear system.
    The equations and their sources are in `boundary_element.py`.

    Differentiable in heights, dx, E and P, in both modes, and works under `jit` and `vmap`.
    Pressure, gap and mean gap have their exact derivatives on the grid. The outline of the contact
    moves by whole grid points, so the derivative of K_n is that of the mean gap between the loads
    0.95 P and 1.05 P, as d(1/K_n)/dh = -d(d mean gap/dh)/dP. The area counts points: its derivative
    is 0. There are no second derivatives, and none at all with `plastic`.

    **Arguments:**

    - `heights`: (nx, ny), heights of the surface [m].
    - `dx`: grid spacing [m] along x, the first axis.
    - `material`: E is that of the pair (Eq. 2), H the hardness.
    - `P`: normal load [N], a scalar.
    - `plastic`: True lets no pressure exceed H; K_n is then that of a small vibration, in which
      plastic contacts unload elastically. By default the contact is elastic.
    - `aspect`: dy/dx, 1 by default; structure, and constant in a derivative with respect to dx.
    - `rtol`: bound on the largest gap in contact and overlap outside, over the rms height; by
      default 1e-9, and 1e-5 in float32.
    - `max_steps`: most steps of each iteration, 2000 by default.
    - `throw`: True, the default, raises unless the solution has converged; otherwise `result` says
      how it ended.

    **Returns:** a `BoundaryElement`.

    **Raises:** `ValueError` unless heights are (nx, ny) and finite, dx > 0, P > 0, aspect > 0,
    0 < rtol < 1 and max_steps >= 1; `RuntimeError` if `throw` and the solution has not converged.
    Under a trace (`jit`, `vmap`) everything is NaN instead. `TypeError` for a traced aspect.
    """
    dx, P = scalar("dx", dx, above=0), scalar("P", P, above=0)
    heights = check_map("heights", heights, material, dx, P)
    convergence = Convergence.checked(rtol, max_steps, heights.dtype)
    plastic, throw = flag("plastic", plastic), flag("throw", throw)
    ratio = concrete(scalar("aspect", aspect, above=0))
    if ratio is None:
        raise TypeError("aspect must be known while a program is traced")
    solution = _boundary_element(heights, dx, material, P, plastic, convergence, float(ratio))
    return raise_unless(BoundaryElementResult.converged, solution) if throw else solution


def check_map(name: str, heights, material: Material, *others: Array) -> Array:
    """Heights (nx, ny) in the widest of all precisions."""
    heights = height_numbers(name, heights)
    if heights.ndim != 2 or min(heights.shape) < 2:
        raise ValueError(f"{name} must have shape (nx, ny), got {heights.shape}")
    require_kind("material", material, Material)
    return heights.astype(jnp.result_type(heights, *others, material.E, material.H))


@functools.partial(jax.jit, static_argnums=(4, 5, 6))
def _boundary_element(heights, dx, material, P, plastic, convergence, aspect):
    flat = jnp.max(heights) == jnp.min(heights)  # their mean may be rounded
    h = jnp.where(flat, 0, heights - jnp.mean(heights)) / dx
    mean = jnp.asarray(P / (material.E * dx**2 * (h.size * aspect)), h.dtype)
    limit = material.H / material.E if plastic else None
    pressure, mean_gap, compliance, residual = (
        _plastic(h, mean, limit, convergence, aspect)
        if plastic
        else _contact(h, mean, convergence, aspect)
    )
    gap = jnp.maximum(_displacement(pressure, aspect) + mean_gap - h, 0)
    touches = jax.lax.stop_gradient(pressure) > 0
    gap = jnp.where(touches, 0, gap)
    full = jnp.all(touches)
    result = BoundaryElementResult.where(
        residual <= convergence.rtol,
        BoundaryElementResult.converged,
        BoundaryElementResult.not_converged,
    )
    if plastic:
        soft = mean >= material.H / material.E
        result = BoundaryElementResult.where(soft, BoundaryElementResult.too_soft, result)
        mean_gap = jnp.mean(gap)
    cells = h.size * aspect  # the nominal area in units of dx^2
    return BoundaryElement(
        K_n=jnp.where(full, jnp.inf, material.E * dx * cells / jnp.where(full, 1, compliance)),
        area=jnp.sum(touches) * aspect * dx**2,
        mean_gap=mean_gap * dx,
        pressure=pressure * material.E,
        gap=gap * dx,
        result=result,
    )


# --- the half-space ------------------------------------------------------------------------


def _wavenumbers(shape, aspect):
    x, y = 2 * np.pi * np.fft.fftfreq(shape[0]), 2 * np.pi * np.fft.rfftfreq(shape[1], aspect)
    return np.hypot(x[:, None], y)


def _filtered(field, factor):
    return jnp.fft.irfft2(jnp.asarray(factor, field.dtype) * jnp.fft.rfft2(field), s=field.shape)


def _displacement(pressure, aspect, local=None):
    """S p: 2/|q| times each wave, and 0 for the mean, which the mean gap represents.

    A `local` compliance, of a layer on the half-space, adds to that of each wave.
    """
    q = _wavenumbers(pressure.shape, aspect)
    S = np.divide(2, q, out=np.zeros_like(q), where=q > 0)
    return _filtered(pressure, S if local is None else S + local * (q > 0))


def _precondition(residual, aspect, local=None):
    q = _wavenumbers(residual.shape, aspect)
    stiffness = np.maximum(q, np.min(q[q > 0])) / 2
    return _filtered(residual, stiffness if local is None else 1 / (1 / stiffness + local))


def _mean(field, where):
    return jnp.sum(jnp.where(where, field, 0)) / jnp.maximum(jnp.sum(where), 1)


def rms(h):
    root = jnp.std(h)
    return jnp.where(root > 0, root, jnp.inf)  # a flat surface has no residual


# --- solvers -------------------------------------------------------------------------------


def _solve(h, mean, convergence, aspect, start=None, local=None, scale=None) -> _Solution:
    """Constrained conjugate gradients."""
    displacement = functools.partial(_displacement, aspect=aspect, local=local)
    precondition = functools.partial(_precondition, aspect=aspect, local=local)

    def conditions(pressure, u):
        """(gap, points in contact, points that overlap, mean gap, residual) of pressure and u."""
        free = pressure > 0
        gap = u - h
        mean_gap = -_mean(gap, free)
        gap = gap + mean_gap
        wrong = (gap < 0) & ~free
        largest = jnp.max(jnp.where(free | wrong, jnp.abs(gap), 0))
        residual = largest / (rms(h) if scale is None else scale)
        return gap, free, wrong, mean_gap, residual

    def projected(field, free):  # onto steps that keep the load
        return jnp.where(free, field - _mean(field, free), 0)

    def go_on(state):
        *_, residual, count = state
        return convergence.continues(residual, count)

    def iterate(state):
        pressure, u, direction, old, product, before, count = state
        gap, free, wrong, *_ = conditions(pressure, u)
        gradient = jnp.where(free, gap, 0)
        step = projected(precondition(gradient), free)
        new = jnp.sum(gradient * step)
        # Polak and Ribiere's factor; 0 at the first step, and after the contact has grown.
        beta = jnp.maximum((new - jnp.sum(old * step)) / product, 0)
        direction = projected(step + beta * direction, free)
        response = displacement(direction)
        curvature = jnp.sum(direction * response)
        # A single point in contact has no direction, but others must still join it.
        length = jnp.where(curvature > 0, jnp.sum(gradient * direction) / curvature, 1)
        trial = pressure - length * direction
        grown = jnp.any(wrong)
        pull = jax.lax.cond(
            grown,
            lambda: length * jnp.where(wrong, precondition(jnp.where(wrong, gap, 0)), 0),
            lambda: jnp.zeros_like(gap),
        )
        clipped = jnp.maximum(trial - pull, 0)
        changed = grown | jnp.any(trial < 0)
        following = jnp.where(changed, clipped * (mean / jnp.mean(clipped)), trial)
        u = jax.lax.cond(changed, lambda: displacement(following), lambda: u - length * response)
        residual = conditions(following, u)[-1]
        product = jnp.where(grown & (residual > before), jnp.inf, new)
        return following, u, direction, gradient, product, residual, count + 1

    start = jnp.full_like(h, mean) if start is None else start * (mean / jnp.mean(start))
    u, zeros = displacement(start), jnp.zeros_like(h)
    infinite = jnp.full_like(mean, jnp.inf)
    state = start, u, zeros, zeros, infinite, conditions(start, u)[-1], 0
    pressure, u, *_, residual, _ = jax.lax.while_loop(go_on, iterate, state)
    return _Solution(pressure, conditions(pressure, u)[3], residual)


def _solve_plastic(h, mean, limit, convergence, aspect) -> _Solution:
    """Projected gradients with Nesterov's momentum, from the elastic solution.

    Conjugate gradients fail once no point in contact is below the limit.
    """
    q = _wavenumbers(h.shape, aspect)
    softest, stiffest = float(2 / np.min(q[q > 0])), float(2 / np.max(q))
    root = math.sqrt(stiffest / softest)
    momentum = (1 - root) / (1 + root)

    def project(field):
        """(p, shift): the nearest pressure from 0 to the limit with the given load."""

        def halve(_, bracket):
            low, high = bracket
            middle = (low + high) / 2
            less = jnp.mean(jnp.clip(field + middle, 0, limit)) < mean
            return jnp.where(less, middle, low), jnp.where(less, high, middle)

        bracket = -jnp.max(field), limit - jnp.min(field)
        shift = jax.lax.fori_loop(0, jnp.finfo(h.dtype).nmant + 8, halve, bracket)[1]
        return jnp.clip(field + shift, 0, limit), shift

    def conditions(pressure, displacement, mean_gap):
        """(mean gap, residual): where the surface yields it may overlap, but not open."""
        free = (pressure > 0) & (pressure < limit)
        gap = displacement - h
        mean_gap = jnp.where(jnp.any(free), -_mean(gap, free), mean_gap)
        gap = gap + mean_gap
        wrong = jnp.maximum(jnp.where(pressure < limit, -gap, gap), 0)
        return mean_gap, jnp.max(jnp.where(free, jnp.abs(gap), wrong)) / rms(h)

    def go_on(state):
        *_, residual, count = state
        return convergence.continues(residual, count)

    def iterate(state):
        pressure, u, ahead, u_ahead, *_, count = state
        following, shift = project(ahead - (u_ahead - h) / softest)
        u_following = _displacement(following, aspect)
        ahead = following + momentum * (following - pressure)
        u_ahead = u_following + momentum * (u_following - u)
        mean_gap, residual = conditions(following, u_following, -shift * softest)
        return following, u_following, ahead, u_ahead, mean_gap, residual, count + 1

    elastic = _solve(h, mean, convergence, aspect)
    yields = jnp.any(elastic.pressure > limit)
    start = jnp.where(yields, project(elastic.pressure)[0], elastic.pressure)
    u = _displacement(start, aspect)
    state = start, u, start, u, *conditions(start, u, elastic.mean_gap), 0
    pressure, *_, mean_gap, residual, _ = jax.lax.while_loop(go_on, iterate, state)
    return _Solution(pressure, mean_gap, residual)


def _conjugate_gradients(right, load, contact, convergence, aspect, local=None):
    """p with S p + g = right in contact for some g, p = 0 outside, and the sum `load`."""

    def go_on(state):
        *_, product, count = state
        return (product > enough) & (count < convergence.max_steps)

    def iterate(state):
        p, residual, direction, product, count = state
        response = _projected(_displacement(direction, aspect, local))
        length = product / _positive(jnp.sum(direction * response))
        p, residual = p + length * direction, residual - length * response
        step = _projected(_precondition(residual, aspect, local))
        new = jnp.sum(residual * step)
        direction = step + new / _positive(product) * direction
        return p, residual, direction, new, count + 1

    def _projected(field):
        return jnp.where(contact, field - _mean(field, contact), 0)

    def _positive(x):
        return jnp.where(x > 0, x, 1)

    p = jnp.where(contact, load / jnp.maximum(jnp.sum(contact), 1), 0)
    whole = jnp.where(contact, right - _displacement(p, aspect, local), 0)
    residual = _projected(whole)
    step = _projected(_precondition(residual, aspect, local))
    # Not relative to the first residual, which may be pure rounding error.
    tolerance = max(convergence.rtol, 4 * float(jnp.finfo(p.dtype).eps))
    enough = tolerance**2 * (jnp.sum(whole * _precondition(whole, aspect, local)) + jnp.sum(p**2))
    state = p, residual, step, jnp.sum(residual * step), 0
    return jax.lax.while_loop(go_on, iterate, state)[0]


def _solve_contact(right, load, contact, convergence, aspect, local=None) -> Any:
    """(p, g) with S p + g = right in contact, p = right outside, and the sum `load` inside."""

    def split(x):
        return x[:-1].reshape(contact.shape), x[-1]

    def operator(solution):
        p, g = split(solution)
        inside = jnp.where(contact, p, 0)
        balance = jnp.where(contact, _displacement(inside, aspect, local) + g, p)
        return jnp.append(balance, jnp.sum(inside))

    def solve(_, sides):
        right, load = split(sides)
        p = _conjugate_gradients(right, load, contact, convergence, aspect, local)
        g = _mean(right - _displacement(p, aspect, local), contact)
        return jnp.append(jnp.where(contact, p, right), g)

    # One vector: JAX transposes no system of which one right side depends on the input and one not.
    sides = jnp.append(right, load)
    return split(jax.lax.custom_linear_solve(operator, sides, solve, symmetric=True))


def _flat_punch(contact, convergence, aspect, dtype):
    """(w, c): pressure w, of mean 1, and indentation c of a flat punch of the contact's outline."""
    load = jnp.asarray(contact.size, dtype)
    w = _conjugate_gradients(jnp.zeros(contact.shape, dtype), load, contact, convergence, aspect)
    # The minimum of this energy, so its error is the square of the error of w.
    return w, jnp.sum(w * _displacement(w, aspect)) / w.size


@jax.custom_jvp
def _first_only(primals):
    return primals


@_first_only.defjvp
def _first_only_jvp(primals, tangents):
    raise TypeError("boundary_element has first derivatives only")


@functools.partial(jax.custom_jvp, nondiff_argnums=(2, 3))
def _contact(h, mean, convergence, aspect):
    """(p, g, c, residual): pressure, mean gap and compliance c = -dg/d(mean pressure)."""
    pressure, mean_gap, residual = _solve(h, mean, convergence, aspect)
    return pressure, mean_gap, _flat_punch(pressure > 0, convergence, aspect, h.dtype)[1], residual


@_contact.defjvp
def _contact_jvp(convergence, aspect, primals, tangents):
    (h, mean), (dh, dmean) = _first_only(primals), tangents
    pressure, mean_gap, residual = _solve(h, mean, convergence, aspect)
    contact = pressure > 0
    w, compliance = _flat_punch(contact, convergence, aspect, h.dtype)
    right, load = jnp.where(contact, dh, 0), dmean * h.size
    dpressure, _ = _solve_contact(right, load, contact, convergence, aspect)
    dmean_gap = jnp.mean(w * dh) - compliance * dmean

    def punch_at(load):
        solution = _solve(h, load, convergence, aspect, start=pressure)
        return _flat_punch(solution.pressure > 0, convergence, aspect, h.dtype)

    step = 0.05  # of the load: not less, since the outline moves by whole grid points
    (w_more, c_more), (w_less, c_less) = (punch_at(mean * (1 + x)) for x in (step, -step))
    width = 2 * step * mean
    # c = -dg/dmean and dg/dh = w/n, so dc/dh = -d(w/n)/dmean.
    dcompliance = (jnp.mean((w_less - w_more) * dh) + (c_more - c_less) * dmean) / width
    primals = pressure, mean_gap, compliance, residual
    return primals, (dpressure, dmean_gap, dcompliance, jnp.zeros_like(residual))


@functools.partial(jax.custom_jvp, nondiff_argnums=(4,))
def press_layered(h, mean, local, scale, convergence):
    """(p, residual over `scale`) with a layer of the compliance `local` on the half-space."""
    solution = _solve(h, mean, convergence, 1.0, local=local, scale=scale)
    return solution.pressure, solution.residual


@press_layered.defjvp
def _press_layered_jvp(convergence, primals, tangents):
    (h, mean, local, scale), (dh, dmean, dlocal, _) = _first_only(primals), tangents
    p, residual = press_layered(h, mean, local, scale, convergence)
    contact = p > 0
    right, load = jnp.where(contact, dh - dlocal * p, 0), dmean * h.size
    dp, _ = _solve_contact(right, load, contact, convergence, 1.0, local)
    return (p, residual), (dp, jnp.zeros_like(residual))


@functools.partial(jax.custom_jvp, nondiff_argnums=(3, 4))
def _plastic(h, mean, limit, convergence, aspect):
    """As `_contact`, for a surface that yields at the pressure `limit`."""
    pressure, mean_gap, residual = _solve_plastic(h, mean, limit, convergence, aspect)
    return pressure, mean_gap, _flat_punch(pressure > 0, convergence, aspect, h.dtype)[1], residual


@_plastic.defjvp
def _plastic_jvp(convergence, aspect, primals, tangents):
    raise TypeError("boundary_element with plastic=True cannot be differentiated")
