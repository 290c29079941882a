"""A measured power spectrum, and the power law identified in it."""

from typing import Any

import numpy as np

from .._identify.identify import Identification
from .._identify.spectrum import theoretical_spectrum
from .._surface.surface import Surface
from .axes import Axes, ensure_axes, legend_above


def power_spectrum(result: Identification, ax: Axes | None = None) -> Axes:
    """The measured one-sided spectrum over frequency, for a map over |(f_x, f_y)|.

    **Arguments:**

    - `result`: as `identify` returns it.
    - `ax`: axes to draw in, by default those of a new figure.
    """
    ax, spectrum = ensure_axes(ax), result.spectrum
    ax.loglog(spectrum.f, spectrum.power, "-", color="0.72", lw=0.9, label="measured", zorder=1)
    ax.set_xlabel("frequency f [1/m]")
    of = "of the profile" if spectrum.kind == "profile" else "of the map, over |f|"
    ax.set_ylabel(f"power spectral density {of} [m³]")
    return ax


def identification(result: Identification, ax: Axes | None = None) -> Axes:
    """The spectrum, its means over bins with standard errors, and the fitted power law.

    The fit uses the white band only. A dashed line is the power law of the structure function, a
    dotted one the limit of the instrument.

    **Arguments:**

    - `result`: as `identify` returns it.
    - `ax`: axes to draw in, by default those of a new figure.
    """
    ax = power_spectrum(result, ax)
    law, (low, high) = result.law, result.band
    left, right = result.spectrum.f[0] / 1.2, result.spectrum.nyquist * 1.1
    for ends in ((left, low), (high, right)):
        ax.axvspan(*ends, color="0.93", lw=0, zorder=0)
    # An error bar that reaches zero has no end on a logarithmic axis.
    bars = [law.power * np.minimum(law.error, 0.95), law.power * law.error]
    style: dict[str, Any] = {"fmt": "o", "color": "k", "ms": 4.5, "lw": 1.1, "capsize": 2}
    handles = [ax.lines[0], ax.errorbar(law.f, law.power, bars, label="means over bins", **style)]
    f = np.geomspace(low, high, 200)
    words = f"D = {result.D:.3f} ± {result.D_standard_error:.3f}, G = {result.G:.3g} m"
    handles += ax.loglog(f, law(f), "-", color="#0072b2", lw=2, label=words)
    other = result.structure_function
    if 0 < other.G < np.inf:
        surface = Surface(other.D, other.G, result.gamma)
        line = theoretical_spectrum(surface, f, result.spectrum.kind)
        words = f"structure function: D = {other.D:.3f} ± {other.D_standard_error:.3f}"
        handles += ax.loglog(f, line, "--", color="#d55e00", lw=1.6, label=words)
    if result.limit < result.spectrum.nyquist:
        words = f"limit of the instrument {result.limit:.3g} 1/m"
        handles.append(ax.axvline(result.limit, color="k", ls=":", lw=1.2, label=words))
    ax.set_xlim(left, right)
    legend_above(ax, handles)
    return ax
