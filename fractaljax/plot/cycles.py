"""Several limit cycles beside one another, or along a quantity."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from jaxtyping import ArrayLike

from .._base.parts import brief
from .._dynamics.cycle import LimitCycle
from .axes import Axes, ensure_axes, legend_above, new_figure
from .cycle import phase_portrait, spectrum
from .panels import Panels


def cycles(
    results: Mapping[str, LimitCycle], *, direction: int = 1, joint: int | None = None
) -> Panels:
    """Phase portrait and spectrum of one displacement, a row for each cycle; returns their axes.

    All rows have the same axes.

    **Arguments:**

    - `results`: {name of the row: limit cycle}.
    - `direction`, `joint`: as in `phase_portrait`.

    **Raises:** `TypeError` unless there is a name for each; `ValueError` if there are no cycles,
    and as `phase_portrait`.
    """
    if not isinstance(results, Mapping):
        raise TypeError(
            "results must be a mapping such as {'name': limit_cycle(scene)}, "
            f"got {brief(results)}"
        )
    if not results:
        raise ValueError("there must be at least one limit cycle to draw")
    figure = new_figure(10.4, 0.5 + 3.6 * len(results))
    parts: Any = figure.subfigures(len(results), 1, squeeze=False)
    portraits, spectra = [], []
    for part, (name, cycle) in zip(parts[:, 0], results.items(), strict=True):
        part.suptitle(name, x=0.01, ha="left", fontweight="bold", fontsize="medium")
        left, right = part.subplots(1, 2)
        portraits.append(phase_portrait(cycle, left, direction=direction, joint=joint))
        spectra.append(spectrum(cycle, right, direction=direction, joint=joint))
    for column in (portraits, spectra):
        for which in "xy":
            low, high = np.transpose([getattr(ax, f"get_{which}lim")() for ax in column])
            for ax in column:
                ax.set(**{f"{which}lim": (low.min(), high.max())})
    for ax in spectra:  # stems start from the common lower limit
        (stems,) = ax.collections
        bottom, _ = ax.get_ylim()
        stems.set_segments([[(f, bottom), (f, a)] for (f, _), (_, a) in stems.get_segments()])
    return Panels(figure)


def amplitudes(
    results: LimitCycle,
    over: ArrayLike,
    ax: Axes | None = None,
    *,
    label: str,
    slopes: ArrayLike | None = None,
) -> Axes:
    """Peak-to-peak amplitudes [um] of all directions over a quantity, for a batch of cycles.

    Gaps are members without a cycle.

    **Arguments:**

    - `results`: a batch (n,) of limit cycles, as `jax.vmap` gives it.
    - `over`: (n,), values of the quantity.
    - `ax`: axes to draw in, by default those of a new figure.
    - `label`: the name of the quantity with its unit.
    - `slopes`: (n,), the derivative of the amplitude of direction 1 with respect to the quantity [m
      per unit], drawn as a few tangents; by default none.

    **Raises:** `ValueError` for a batch or slopes whose shape is not that of `over` (n,).
    """
    x = np.asarray(over, float)
    if x.ndim != 1 or results.period.shape != x.shape:
        shapes = f"{x.shape} and {results.period.shape}"
        raise ValueError(f"over must have the shape (n,) of the batch, got {shapes}")
    ax = ensure_axes(ax)
    amplitude = np.asarray(results.amplitude) * 1e6
    handles = []
    for i, row in enumerate(amplitude.T):
        line = ("o-", "s-", "^-", "d-")[i % 4]
        handles += ax.plot(x, row, line, ms=4, lw=1.3, label=f"direction {i + 1}")
    if slopes is not None:
        slope = np.asarray(slopes, float) * 1e6
        if slope.shape != x.shape:
            raise ValueError(f"slopes must have shape {x.shape}, got {slope.shape}")
        # Six tangents that do not touch: each is 0.18 of the axis long.
        reach = 0.09 * np.ptp(x) * np.array([[-1], [1]])
        shown = np.unique(np.linspace(0, len(x) - 1, 6).astype(int))
        style: dict[str, Any] = {"color": "k", "lw": 1.1, "zorder": 3}
        ends = x[shown] + reach, amplitude[shown, 0] + slope[shown] * reach
        handles += ax.plot(*ends, label="derivative of direction 1", **style)[:1]
    ax.set_xlabel(label)
    ax.set_ylabel("peak-to-peak amplitude [µm]")
    legend_above(ax, handles)
    return ax
