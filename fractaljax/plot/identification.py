"""A measured power spectrum, and the power law identified in it."""

from typing import Any

import numpy as np

from ..measured.identify import Identification
from ..measured.spectrum import theoretical_spectrum
from ..surface.surfaces import Surface
from .axes import legend_above, new_axes


def power_spectrum(result: Identification, ax: Any = None) -> Any:
    """The measured one-sided spectrum over frequency; that of a map over |(f_x, f_y)|."""
    ax = new_axes() if ax is None else ax
    spectrum = result.spectrum
    ax.loglog(spectrum.f, spectrum.power, "-", color="0.72", lw=0.9, label="measured", zorder=1)
    ax.set_xlabel("frequency f [1/m]")
    of = "of the profile" if spectrum.kind == "profile" else "of the map, over |f|"
    ax.set_ylabel(f"power spectral density {of} [m³]")
    return ax


def identification(result: Identification, ax: Any = None) -> Any:
    """Means over bins with standard errors, the fit, its band, and what else is known.

    The band is white, what the fit does not use is grey. A dashed line is the law by the structure
    function, a dotted one the instrument's limit.
    """
    ax = power_spectrum(result, ax)
    law, (low, high) = result.law, result.band
    left, right = result.spectrum.f[0] / 1.2, result.spectrum.nyquist * 1.1
    for ends in ((left, low), (high, right)):
        ax.axvspan(*ends, color="0.93", lw=0, zorder=0)
    handles = [ax.lines[0]]
    handles.append(
        ax.errorbar(
            law.f,
            law.power,
            # An error bar that reaches zero has no end on this axis.
            [law.power * np.minimum(law.error, 0.95), law.power * law.error],
            fmt="o",
            color="k",
            ms=4.5,
            lw=1.1,
            capsize=2,
            label="means over bins",
        )
    )
    f = np.geomspace(low, high, 200)
    label = f"D = {result.D:.3f} ± {result.D_standard_error:.3f}, G = {result.G:.3g} m"
    handles += ax.loglog(f, law(f), "-", color="#0072b2", lw=2, label=label)
    other = result.second_opinion
    if 0 < other.G < np.inf:
        surface = Surface(other.D, other.G, result.gamma)
        line = theoretical_spectrum(surface, f, result.spectrum.kind)
        label = f"structure function: D = {other.D:.3f} ± {other.D_standard_error:.3f}"
        handles += ax.loglog(f, line, "--", color="#d55e00", lw=1.6, label=label)
    if result.limit < result.spectrum.nyquist:
        label = f"instrument's limit {result.limit:.3g} 1/m"
        handles.append(ax.axvline(result.limit, color="k", ls=":", lw=1.2, label=label))
    ax.set_xlim(left, right)
    legend_above(ax, handles)
    return ax
