"""Linear stability of steady sliding: eigenvalues of a scene or a structure, and its modes.

Two directions take the closed form of `quartic.py`, matrices LAPACK's route of `quadratic.py`.
"""

import functools
import math
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Complex, Float, ScalarLike

from .._base.parts import Record
from .._base.programs import exported_jit
from .._mechanism.mechanism import Mechanism
from .._mechanism.quantities import has_memory, require_sliding
from .linearise import linearised, require_equilibrium
from .margin import damping_ratios
from .two_directions import two_directions


class Mode(NamedTuple):
    """One mode, as `Stability.unstable` and `least_damped` list them."""

    growth_rate: float  # [1/s]; > 0: it squeals
    frequency: float  # [Hz]
    damping_ratio: float  # -Re/|s|
    shape: np.ndarray  # (n,) complex displacements, the largest of them 1
    largest: int | str  # the degree of freedom of that one, by name where it has one
    resolution: float  # rounding error of the growth rate, at most [1/s]


class Stability(Record):
    """Linear stability of steady sliding, as `stability` returns it, for n degrees of freedom.

    `resolutions` bound the rounding error of the real part of each eigenvalue: a smaller real part
    has no sign. A rigid-body mode of a structure, with K x = 0 within rounding, has an eigenvalue
    and a damping ratio of exactly 0, and does not count in the margin.

    `normal_force` has one entry per joint: its normal force under preload, P without a normal
    direction, NaN in the source's form; None where no joint is preloaded. Where it is not above 0
    the joint is open: there is no steady sliding, and all numbers are NaN.

    Friction with memory adds the eigenvalues of its internal states: there are 2n + s of them.

    For a structure that `reduce` made, only the eigenvalues in its band count: they come first, and
    the others are not eigenvalues of the structure.
    """

    eigenvalues: Complex[Array, " 2*n"]  # [1/s], largest real part first
    growth_rate: Float[Array, ""]  # largest real part [1/s]; > 0: it squeals
    frequency: Float[Array, ""]  # of the same eigenvalue [Hz]
    damping_ratio: Float[Array, ""]  # of the same eigenvalue, -Re/|s|
    margin: Float[Array, ""]  # > 0 exactly where all modes decay, see `margin`
    resolutions: Float[Array, " 2*n"]  # [1/s]
    shapes: Complex[Array, "2*n n"]  # displacements, the largest of each 1
    normal_force: Any  # (m,), of each preloaded joint at the equilibrium [N]; else None
    counted: Bool[Array, " 2*n"]  # of a reduced structure, whether it lies in the band
    names: tuple[str, ...] | None = eqx.field(static=True)  # of the degrees of freedom

    @property
    def resolution(self) -> Float[Array, ""]:
        """Rounding error of the growth rate, at most [1/s]."""
        return self.resolutions[..., 0]

    @property
    def frequencies(self) -> Float[Array, " 2*n"]:
        """Frequency of each eigenvalue [Hz]."""
        return jnp.abs(self.eigenvalues.imag) / (2 * jnp.pi)

    @property
    def damping_ratios(self) -> Float[Array, " 2*n"]:
        """-Re/|s| of each eigenvalue s, and 0 where s is 0."""
        return damping_ratios(self.eigenvalues)

    def unstable(self) -> list[Mode]:
        """The modes that grow, the fastest first, one of each conjugate pair.

        A real part within its resolution of 0 does not count: see `unresolved`.

        **Raises:** `ValueError` for a batch.
        """
        return [mode for mode in self._modes() if mode.growth_rate > mode.resolution]

    def unresolved(self) -> list[Mode]:
        """The modes that may grow or decay within rounding, without rigid-body modes.

        All modes without damping are among them.

        **Raises:** `ValueError` for a batch.
        """
        # "not >" also holds for NaN, where the range of numbers ends.
        modes = [mode for mode in self._modes() if not abs(mode.growth_rate) > mode.resolution]
        return [mode for mode in modes if mode.growth_rate or mode.frequency]

    def least_damped(self, count: int = 10) -> list[Mode]:
        """The `count` oscillating modes with the least damping ratios, the least first.

        **Raises:** `ValueError` for a batch.
        """
        modes = [mode for mode in self._modes() if mode.frequency > 0]
        return sorted(modes, key=lambda mode: mode.damping_ratio)[:count]

    def _modes(self) -> list[Mode]:
        if self.eigenvalues.ndim != 1:
            raise ValueError(f"modes are listed of one result, got {self.eigenvalues.shape}")
        modes, columns = [], (self.eigenvalues, self.resolutions, self.shapes, self.counted)
        for s, resolution, shape, counted in zip(*map(np.asarray, columns), strict=True):
            if counted and s.imag >= 0:
                largest = int(np.abs(shape).argmax())
                mode = Mode(
                    growth_rate=float(s.real),
                    frequency=float(s.imag) / (2 * np.pi),
                    damping_ratio=float(-s.real / abs(s)) if s else 0.0,
                    shape=shape,
                    largest=largest if self.names is None else self.names[largest],
                    resolution=float(resolution),
                )
                modes.append(mode)
        return modes

    def _shown(self):
        for name in ("growth_rate", "frequency", "damping_ratio", "margin"):
            yield f"{name}={getattr(self, name)}"
        yield f"eigenvalues: {self.eigenvalues.shape}"


def growth_rate(scene: Mechanism, friction_slope: bool = True) -> Float[Array, ""]:
    """Largest real part of the eigenvalues of Eq. 43 [1/s], a scalar; above 0 there is squeal.

    Towards coalescing eigenvalues the derivative grows without bound. Exactly there it is infinite,
    and some finite number is returned. NaN where the numbers leave the range in which a sign can be
    told (`dimensionless`), and where a preloaded joint is open at its equilibrium
    (`Stability.normal_force`). For a structure also, under `jit` and `vmap`, where there is no
    equilibrium.

    **Arguments:**

    - `scene`: a scene or structure of scalars; `jax.vmap` takes many.
    - `friction_slope`: False leaves out the slope of the friction law, as the source's Eq. 43 does.

    **Raises:** `ValueError` if the scene holds arrays: use `jax.vmap`; if a structure without F has
    friction with a slope; if one has no equilibrium; and for V = 0.
    """
    growth = _growth_rate(require_sliding(scene, "for steady sliding"), friction_slope)
    require_equilibrium(scene, friction_slope, growth)
    return growth


@functools.partial(exported_jit, static_argnames="friction_slope")
def _growth_rate(scene, friction_slope):
    return linearised(scene, friction_slope).rightmost().real


def margin(
    scene: Mechanism, shift: ScalarLike = 0.0, friction_slope: bool = True
) -> Float[Array, ""]:
    """Margin of stability [-], a scalar: above 0 exactly where the growth rate is below `shift`.

    Its scale is that of a damping ratio. For a scene with lightly damped, well separated modes it
    is 0.5 to 1 times the least decay rate over the rms natural frequency sqrt((a + b)/2) in
    contact; for modes within their damping of each other, about 0.3 times. It is analytic in the
    scene where modes coalesce and where they cross. Only without any damping is it not: there it is
    0 where stable and negative in flutter.

    For a structure, and with friction that has memory, it is the least damping ratio, which has
    kinks where modes cross: a smooth measure of n degrees of freedom takes a Lyapunov equation of
    size 2n. With a shift the ratios are those of the eigenvalues minus the shift. Rigid-body modes
    do not count without a shift.

    **Arguments:**

    - `scene`: a scene or structure of scalars.
    - `shift`: growth rate [1/s] at which the margin is 0, a scalar, 0 by default.
    - `friction_slope`: as in `growth_rate`; the margin is NaN where the growth rate is.

    **Raises:** as `growth_rate`; `TypeError` for a `shift` that is no number.
    """
    kind = jnp.dtype(bool) if shift is None else jnp.result_type(shift)
    if not (jnp.issubdtype(kind, jnp.floating) or jnp.issubdtype(kind, jnp.integer)):
        raise TypeError(f"shift must be a real number, got {kind}; friction_slope comes third")
    value = _margin(require_sliding(scene, "for steady sliding"), shift, friction_slope)
    require_equilibrium(scene, friction_slope, value)
    return value


@functools.partial(jax.jit, static_argnums=2)
def _margin(scene, shift, friction_slope):
    return linearised(scene, friction_slope).margin(shift)


def stability(scene: Mechanism, friction_slope: bool = True) -> Stability:
    """Eigenvalues of Eq. 43 and what follows from them.

    **Arguments:**

    - `scene`, `friction_slope`: as in `growth_rate`.

    **Returns:** a `Stability`.

    **Raises:** as `growth_rate`.
    """
    result = _stability(require_sliding(scene, "for steady sliding"), friction_slope)
    require_equilibrium(scene, friction_slope, result.growth_rate)
    return result


@functools.partial(exported_jit, static_argnames="friction_slope")
def _stability(scene, friction_slope):
    system = linearised(scene, friction_slope)
    forces = system.normal_force
    s, x, error, margin, counted = system.modes()
    largest = jnp.abs(jax.lax.stop_gradient(x)).argmax(axis=1)
    return Stability(
        eigenvalues=s,
        growth_rate=s[0].real,
        frequency=jnp.abs(s[0].imag) / (2 * jnp.pi),
        damping_ratio=damping_ratios(s[0]),
        margin=margin,
        resolutions=error,
        shapes=x / jnp.take_along_axis(x, largest[:, None], axis=1),
        names=scene.names,
        normal_force=forces,
        counted=counted,
    )


def require_computable(
    scene: Any, friction_slope: bool = True, modes: Stability | None = None
) -> None:
    """Refuse a scene whose growth rate or margin is not finite, naming the quantity behind it.

    `modes` is its `stability`, if already computed.

    **Raises:** `ValueError` in that case.
    """
    if not scene.uncoupled:  # its matrices show what is not finite
        return
    modes = stability(scene, friction_slope) if modes is None else modes
    if math.isfinite(modes.growth_rate) and math.isfinite(modes.margin):
        return
    force = modes.normal_force
    if force is not None and force[0] <= 0:
        raise ValueError(
            f"the joint is open at its equilibrium: the normal force is {force[0]:.6g} N"
        )
    if has_memory(scene):
        raise ValueError(
            f"stability cannot be computed in {modes.margin.dtype}: the scene does not slide "
            "steadily, or its numbers are out of range"
        )
    system = two_directions(scene, friction_slope)
    lin = system.polynomial
    quantities = {
        "K_n [N/m]": system.K_n,
        "K_t [N/m]": system.K_t,
        "the friction at V": scene.coefficient(),
        "(K_t/m + omega_1^2) [1/s^2]": lin.a,
        "(K_n/m + omega_2^2) [1/s^2]": lin.b,
        "the damping of x1 [1/s]": lin.c_1,
        "the damping of x2 [1/s]": lin.c_2,
        "the coupling mu^2 K_n K_t/m^2 [1/s^4]": lin.g,
    }
    names = [name for name, value in quantities.items() if not math.isfinite(value)]
    if not names:  # the largest of damping and coupling as rates
        rates = dict(
            zip(list(quantities)[-3:], (abs(lin.c_1), abs(lin.c_2), lin.g**0.25), strict=True)
        )
        names = [max(rates, key=lambda name: float(rates[name]))]
    value = quantities[names[0]]
    raise ValueError(f"stability cannot be computed in {lin.a.dtype}: {names[0]} is {value:.6g}")
