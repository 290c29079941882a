"""The surface of a drawing, which states a height and its scatter, but neither D nor G."""

import math

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import ArrayLike

from .._base.parts import scalar
from .areal_parameters import areal_parameters
from .profile_parameters import profile_parameters
from .self_affine import SelfAffine
from .surface import Surface
from .surface_scatter import HEIGHT, SurfaceScatter


def specify_surface(
    *,
    Ra: ArrayLike | None = None,
    Rz: ArrayLike | None = None,
    Sq: ArrayLike | None = None,
    scatter: ArrayLike,
    H: ArrayLike = 0.8,
    H_scatter: ArrayLike = 0.1,
    cutoff: ArrayLike | None = 8e-4,
    shortest: ArrayLike | None = 2.5e-6,
    rolloff: ArrayLike | None = None,
    rolloff_scatter: ArrayLike = 0.0,
    L: ArrayLike = 1e-3,
    L_s: ArrayLike = 1e-6,
    gamma: ArrayLike = 1.5,
) -> SurfaceScatter:
    """The surfaces that a drawing allows: a height with its scatter, and a range of H.

    A drawing has Ra, which leaves G open: at another H the same Ra takes a G that is powers of ten
    away. The scatter is therefore that of ln m(q), the height at the wavenumber q at which it is
    independent of H at one Ra, or with a roll-off that of ln Sq, with its covariance.

    **Arguments:**

    - `Ra`, `Rz`, `Sq`: one of them [m], as `profile_parameters` and `areal_parameters` have them.
    - `scatter`: its relative standard deviation, above 0: 0.15 for 15 %.
    - `H`, `H_scatter`: mean and standard deviation of the Hurst exponent, 0.8 +- 0.1 by default,
      truncated to (0, 1). D is 3 - H.
    - `cutoff`, `shortest`: lengths of the filters [m], 0.8 mm and 2.5 um by default; None for none.
    - `rolloff`, `rolloff_scatter`: the roll-off wavelength [m] of a `SelfAffine`, and the standard
      deviation of its logarithm, by default 0; without them, by default, it is a `Surface`.
    - `L`, `L_s`: longest and shortest wavelength [m] of a `Surface`, 1 mm and 1 um by default; L_s
      is the shortest one of a `SelfAffine` too.
    - `gamma`: that of a `Surface`, 1.5 by default.

    **Returns:** a `SurfaceScatter`, whose `surface` has this height and H; it is a tolerance of
    `design` and `squeal_probability`.

    **Raises:** `ValueError` unless one height is stated, above 0, 0 < H < 1, and scatters are at
    least 0, and as `profile_parameters`; and for a `rolloff_scatter` without a roll-off.
    """
    heights = {"Ra": Ra, "Rz": Rz, "Sq": Sq}
    stated = {name: value for name, value in heights.items() if value is not None}
    if len(stated) != 1:
        raise ValueError(f"one of Ra, Rz and Sq must be stated, got {', '.join(stated) or 'none'}")
    ((name, value),) = stated.items()
    height = float(scalar(name, value, above=0))
    mean = float(scalar("H", H, above=0, below=1))
    errors = [
        float(scalar("scatter", scatter, above=0)),
        float(scalar("H_scatter", H_scatter, at_least=0)),
        float(scalar("rolloff_scatter", rolloff_scatter, at_least=0)),
    ]
    filters = dict(cutoff=cutoff, shortest=shortest)
    parameters = areal_parameters if name == "Sq" else profile_parameters

    def log_parameter(surface, **lengths):
        return jnp.log(getattr(parameters(surface, **filters, **lengths), name))

    if rolloff is None:
        if errors[2]:
            raise ValueError("rolloff_scatter needs a rolloff, the wavelength that scatters")
        reference = float(scalar("L_s", L_s, above=0))  # a roughness G at which nothing underflows

        def at_reference(D):
            return log_parameter(Surface(D, reference, gamma), L=L, L_s=L_s)

        log_height, by_D = jax.value_and_grad(at_reference)(3 - mean)
        # R ~ G^(D-2): ln G at this height, whose product with D - 2 has no slope at this f.
        log_G = (math.log(height) - float(log_height)) / (1 - mean) + math.log(reference)
        q = 2 * math.pi / reference * math.exp(float(by_D))
        if not abs(log_G) < math.log(np.finfo(float).max):
            raise ValueError(f"H must be farther below 1 for this {name}, got {mean:g}")
        surface = Surface(3 - mean, math.exp(log_G), gamma)
        names, deviations = ("D", f"ln {HEIGHT}"), np.array([errors[1], 2 * errors[0]])
        used = deviations > 0
        names = tuple(np.array(names)[used].tolist())
        return SurfaceScatter(surface, names, np.diag(deviations[used] ** 2), q)
    wavelength = float(scalar("rolloff", rolloff, above=0))

    def of_unit(x):
        return log_parameter(SelfAffine(1.0, x[0], jnp.exp(x[1]), L_s))

    at = jnp.array([mean, math.log(wavelength)])
    log_height, slope = jax.value_and_grad(of_unit)(at)
    surface = SelfAffine(height * math.exp(-float(log_height)), mean, wavelength, L_s)
    change = np.eye(3)
    change[0, 1:] = -np.asarray(slope)
    used = np.array([True, errors[1] > 0, errors[2] > 0])
    covariance = (change @ np.diag(np.square(errors)) @ change.T)[np.ix_(used, used)]
    names = np.array(["ln Sq", "hurst", "ln rolloff"])[used]
    return SurfaceScatter(surface, tuple(names.tolist()), covariance)
