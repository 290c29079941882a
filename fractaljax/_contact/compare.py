"""Contact laws side by side, and boundary elements on surfaces of the same spectrum."""

import math
from collections.abc import Mapping, Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float, PRNGKeyArray, ScalarLike

from .._base.parts import (
    Record,
    flag,
    number,
    ordered,
    rebuild,
    require_kind,
    require_scalar,
    scalar,
    whole,
)
from .._base.table import aligned
from .._base.warn import warn_user
from .._surface.spectrum import Spectrum
from .._surface.surface import Surface
from .._surface.topography import topography
from .asperity import AsperityContact
from .boundary_element import boundary_element
from .contact import MU_M_MAX, Contact
from .fractal import FractalContact
from .material import Material
from .persson import PerssonContact

BOUNDARY_ELEMENTS = "boundary elements"


class LawCurve(Record):
    """The results of one law at the loads of a comparison (k,); SI units."""

    K_n: Float[Array, " k"]  # normal stiffness [N/m]
    K_t: Float[Array, " k"] | None  # tangential stiffness [N/m]; None for boundary elements
    alpha: Float[Array, " k"]  # d ln K_n/d ln P, NaN where K_n is 0 or infinite
    real_area: Float[Array, " k"] | None  # [m^2]; None where the law has none
    scatter: Float[Array, " k"] | None = None  # standard deviation of ln K_n over seeds


class LawComparison(Record):
    """Contact laws at the same loads, as `compare_laws` returns them; printed as a table."""

    surface: Spectrum  # surface of all laws
    material: Material  # material of all laws
    loads: Float[Array, " k"]  # [N]
    area: Float[Array, ""]  # nominal [m^2]
    L: Float[Array, ""]  # longest and
    L_s: Float[Array, ""]  # shortest wavelength [m]
    curves: dict[str, LawCurve]  # by the name of the law
    left_out: tuple[str, ...] = eqx.field(static=True, default=())  # laws that need D and G

    def rows(self) -> tuple[list[str], list[list[str]]]:
        """The titles and the rows of the table, one row for each load and law."""
        titles = ["P [N]", "law", "K_n [N/m]", "scatter", "K_t/K_n", "d ln K_n/d ln P", "A_r/A"]
        rows = []
        for i, P in enumerate(np.asarray(self.loads).tolist()):
            for law, curve in self.curves.items():
                cells = [f"{P:.6g}", law, f"{curve.K_n[i]:.4g}"]
                cells.append(_shown(curve.scatter, i, ".1%"))
                ratio = None if curve.K_t is None else curve.K_t / curve.K_n
                cells += [_shown(ratio, i, ".3f"), _shown(curve.alpha, i, ".3f")]
                share = None if curve.real_area is None else curve.real_area / self.area
                cells.append(_shown(share, i, ".3g"))
                rows.append(cells)
        return titles, rows

    def __repr__(self) -> str:
        titles, rows = self.rows()
        laws = len(self.curves)  # the load only beside the first
        table = aligned([titles, *(["" if k % laws else P, *x] for k, (P, *x) in enumerate(rows))])
        return "\n".join([table, *self.remarks()])

    def remarks(self) -> list[str]:
        """A line that says which laws are left out, and why; none if all are there."""
        if not self.left_out:
            return []
        kind = type(self.surface).__name__
        words = " and ".join(self.left_out)
        return [f"left out: {words}, which need the D and G of a Surface, not a {kind}"]


def compare_laws(
    surface: Spectrum,
    material: Material,
    loads: Float[ArrayLike, " k"] | Sequence[float],
    *,
    area: ScalarLike,
    L: ScalarLike | None = None,
    L_s: ScalarLike | None = None,
    mu_s: ScalarLike = 0.4,
    mu_m: ScalarLike = 0.25,
    laws: Mapping[str, Contact] | None = None,
    n: int = 128,
    seeds: int = 4,
    key: PRNGKeyArray | None = None,
    progress: bool = True,
) -> LawComparison:
    """Stiffness and real area of a joint by every contact law, and by boundary elements.

    The laws are the source's `FractalContact`, `AsperityContact`, `PerssonContact`, and others by
    name, each with P replaced by the loads. Boundary elements press periodic surfaces of the same D
    and G: K_n is the geometric mean over the seeds, the real area their mean, and alpha the slope
    of that K_n from load to load. They are elastic and frictionless. On an area larger than L^2
    surfaces lie side by side.

    Of a spectrum without D and G, `FractalContact` and `AsperityContact` are left out, and a line
    below the table says so. Boundary elements press its `topography` of side L, without the waves
    that are longer; a warning says if these hold more than a tenth of Sq.

    **Arguments:**

    - `surface`: that of the joint, a `Surface` or another `Spectrum`, as in `PerssonContact`.
    - `material`: that of the joint.
    - `loads`: (k,), rising normal loads [N].
    - `area`: nominal area [m^2].
    - `L`: longest wavelength [m], by default the side of the area; no wave is longer than the side.
      Of another spectrum, the side of the surfaces that are pressed, by default as long as gives
      its shortest wave four points.
    - `L_s`: shortest wavelength [m] of a `Surface`, by default 4 L/n.
    - `mu_s`, `mu_m`: static and smallest friction coefficient for laws with yield, by default 0.4
      and 0.25, the reference brake's.
    - `laws`: {name: contact law}, more laws to compare; by default none.
    - `n`: points of a surface along each side, 128 by default.
    - `seeds`: number of surfaces, 4 by default; 0 leaves boundary elements out.
    - `key`: JAX random key from which the surfaces are drawn, `jax.random.key(0)` by default.
    - `progress`: shows a bar.

    **Returns:** a `LawComparison`.

    **Raises:** `ValueError` unless loads increase and are above 0, area > 0, 2 L/n <= L_s <= L, n
    >= 8, seeds >= 0, mu_s > 0 and 0 <= mu_m <= 0.9, and for L_s beside another spectrum than a
    `Surface`; `RuntimeError` if boundary elements do not converge.
    """
    require_kind("surface", surface, Spectrum)
    require_kind("material", material, Material)
    for part in (surface, material):
        require_scalar(part)
    loads = jnp.atleast_1d(number("loads", np.asarray(loads), above=0))
    if loads.ndim > 1 or not (jnp.diff(loads) > 0).all():
        raise ValueError(f"loads must be a row of rising numbers, got {np.asarray(loads)}")
    area, n, seeds = scalar("area", area, above=0), whole("n", n, 8), whole("seeds", seeds, 0)
    side = jnp.sqrt(area)
    fractal = isinstance(surface, Surface)
    if fractal:
        L = side if L is None else jnp.minimum(scalar("L", L, above=0), side)
        L_s = 4 * L / n if L_s is None else scalar("L_s", L_s, above=0)
    elif L_s is not None:
        kind = type(surface).__name__
        raise ValueError(f"L_s is for a Surface; a {kind} has a shortest wavelength of its own")
    else:
        L_s = 2 * math.pi / surface.pieces().q[-1]
        L = n * L_s / 4 if L is None else scalar("L", L, above=0)
        L = jnp.minimum(L, side)
    L = ordered("L", L, "L_s", L_s)
    if seeds:
        ordered("L_s", L_s * (1 + 1e-9), "2 L/n", 2 * L / n)
    mu_m = scalar("mu_m", mu_m, at_least=0, at_most=MU_M_MAX)
    mu_s = ordered("mu_s", scalar("mu_s", mu_s, above=0), "mu_m", mu_m)
    all_laws: dict[str, Contact] = {}
    if isinstance(surface, Surface):
        all_laws["fractal"] = FractalContact(surface, material, loads[0])
        all_laws["asperity"] = AsperityContact(surface, material, loads[0], L_s)
    ends = (L, L_s) if fractal else ()
    all_laws["Persson"] = PerssonContact(surface, material, loads[0], area, *ends)
    for name, law in (laws or {}).items():
        require_kind(f"laws[{name!r}]", law, Contact)
        all_laws[name] = law
    curves = {name: _curve(law, loads, mu_s, mu_m) for name, law in all_laws.items()}
    if seeds:
        from tqdm import tqdm

        keys = jax.random.split(jax.random.key(0) if key is None else key, seeds)
        band: dict = {"L_s": L_s} if fractal else {}
        if not fractal:
            _warn_of_long_waves(surface, L, side)
        cells, total, quiet = area / L**2, seeds * len(loads), not flag("progress", progress)
        samples = []
        with tqdm(total=total, desc=BOUNDARY_ELEMENTS, unit="load", disable=quiet) as bar:
            for each in keys:
                heights = topography(surface, L, n, key=each, periodic=True, **band)
                for P in loads / cells:
                    pressed = boundary_element(heights, L / n, material, P)
                    samples.append((pressed.K_n * cells, pressed.area * cells))
                    bar.update()
        curves[BOUNDARY_ELEMENTS] = _average_seeds(np.reshape(samples, (seeds, -1, 2)), loads)
    left_out = () if fractal else ("fractal", "asperity")
    return LawComparison(surface, material, loads, area, L, L_s, curves, left_out)


def _warn_of_long_waves(surface: Spectrum, L, side, most: float = 0.1) -> None:
    """Warn if the waves between L and the side of the area hold more than `most` of Sq."""
    held, whole = (math.sqrt(surface.pieces(longest).moment(0)) for longest in (L, side))
    if held < (1 - most) * whole:
        warn_user(
            f"boundary elements of side L = {float(L):.3g} m hold {held / whole:.0%} of Sq: the "
            "longer waves need a larger L, and as many more points n"
        )


def _shown(values, i, form):
    number = math.nan if values is None else float(values[i])
    return f"{number:{form}}" if math.isfinite(number) else "-"


@eqx.filter_jit
def _curve(law: Contact, loads, mu_s, mu_m) -> LawCurve:
    def at(P):
        loaded = rebuild(law, {"P": P})
        K_n, K_t = loaded.stiffness(mu_s, mu_m)
        return K_n, (K_t, loaded.real_area(mu_m))

    def one(P):
        K_n, slope, (K_t, real_area) = jax.jvp(at, (P,), (jnp.ones_like(P),), has_aux=True)
        alpha = jnp.where(K_n > 0, P * slope / jnp.where(K_n > 0, K_n, 1), jnp.nan)
        return LawCurve(K_n, K_t, alpha, real_area)

    return jax.vmap(one)(loads)


def _average_seeds(samples, loads) -> LawCurve:
    """The curve of boundary elements from K_n and real area (seeds, k, 2)."""
    stiff = np.isfinite(samples[..., 0]).all(0)  # not in full contact
    log_K_n = np.log(np.where(stiff, samples[..., 0], np.nan))
    slope = np.full(len(loads), np.nan)
    if len(loads) > 1:
        slope = np.gradient(log_K_n.mean(0), np.log(loads))
    return LawCurve(
        K_n=jnp.asarray(np.where(stiff, np.exp(log_K_n.mean(0)), np.inf)),
        K_t=None,
        alpha=jnp.asarray(slope),
        real_area=jnp.asarray(samples[..., 1].mean(0)),
        scatter=jnp.asarray(log_K_n.std(0, ddof=1)) if len(samples) > 1 else None,
    )
