"""Judge contact laws by boundary elements, `python docs/make_contact_laws.py`."""

import functools
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from writing import run, small_png, table

import fractaljax as fj
from fractaljax._contact.compare import BOUNDARY_ELEMENTS

PAGE = Path(__file__).with_name("contact_laws.md")
PICTURE = PAGE.with_name("contact_laws.png")
DIMENSIONS = (2.1, 2.3, 2.5, 2.7, 2.9)
LOADS = np.geomspace(100.0, 1e4, 5)  # N
LIGHT = np.geomspace(1.0, 100.0, 5)  # N, where the highest hills carry
AREA, L, N = 1e-4, 1e-2, 256
SQ = 1e-6  # m, of every surface

INTRODUCTION = """\
# Contact laws and boundary elements

Five surfaces of Eq. 13 with the same height, Sq = 1 um over (10 mm)^2, and D from 2.1 to 2.9,
pressed by 100 to 10000 N. The material is that of the reference brake. Wavelengths run from 10 mm
to 0.16 mm. Boundary elements take {seeds} periodic surfaces of {n} x {n} points each; the scatter
is that of ln K_n between surfaces.

![K_n over the load for five D: Persson's law runs through the boundary elements](contact_laws.png)

"""

CLOSING = """\

What the table says:

- The fractal law is {low:.2g} to {high:.2g} times boundary elements. It is 0 where every contact is
  plastic, and it can ask for more real area than there is.
- The revised asperity law is {soft:.2g} to {stiff:.2g} times boundary elements where less than a
  third of the area touches.
- Persson's law is within {half:.0%} of boundary elements wherever less than half of the area
  touches, and within a factor of {full:.2f} up to the largest load.
- K_t/K_n is 0.824 at nu = 0.3 in Persson's law (Mindlin). In the fractal law it is {ratios}.

Published exponents alpha = d ln K_n/d ln P, and ours of the same surfaces:

{anchors}

Pohrt and Popov (Phys. Rev. Lett. 108, 104301, 2012) fit one power to boundary elements, from 0.51
to 0.77 for D = 2 to 3: here a straight line between. Pastewka et al. (Phys. Rev. E 87, 062809,
2013) give 1/(1 + H), H = 3 - D, for a finite surface at small loads, Campañá, Persson and Müser (J.
Phys. Condens. Matter 23, 085001, 2011) 1 for a large one. Ours are fitted from {light_low:g} to
{light_high:g} N, where the highest hills of the surface carry, and taken where a tenth of the area
touches or a little less. Towards full contact alpha grows without bound. Persson's law has
Pastewka's exponent as its limit; 1 N is not yet there. [validation.md](validation.md) has the same
three with their tolerances.

`fj.compare_laws(surface, material, loads, area=...)` and `fractaljax contact --area A` do the same
for a surface of your own.

Written by `python docs/make_contact_laws.py`.
"""


def surface(D: float) -> fj.Surface:
    """The surface of this D that is as high as the others."""
    contact: Any = fj.brake_scene().contact
    Sq = float(fj.roughness(fj.Surface(D, contact.surface.G), L, 4 * L / N).Sq)
    G = float(contact.surface.G) * (SQ / Sq) ** (1 / (D - 2))
    return fj.Surface(D, G)


@functools.cache
def comparison(D: float, seeds: int = 8, n: int = N, light: bool = False) -> fj.LawComparison:
    """The laws on the surface of this D, at its loads or at light ones."""
    material, L_s, loads = fj.brake_scene().contact.material, 4 * L / N, LIGHT if light else LOADS
    return fj.compare_laws(
        surface(D), material, loads, area=AREA, L_s=L_s, seeds=seeds, n=n, progress=False
    )


def anchors(**options) -> list[str]:
    """The table of published exponents beside ours, a row for each D."""
    head = ["D", "Pohrt and Popov", "boundary elements, light", "Pastewka et al.", "Persson, 1 N"]
    head += ["Campañá et al.", "boundary elements, a tenth", "Persson, a tenth"]
    rows = []
    for D in DIMENSIONS:
        light, heavy = comparison(D, **options, light=True).curves, comparison(D, **options).curves
        judge, law = heavy[BOUNDARY_ELEMENTS], heavy["Persson"]
        fitted, _ = np.polyfit(np.log(LIGHT), np.log(light[BOUNDARY_ELEMENTS].K_n), 1)
        tenth = max(np.flatnonzero(np.asarray(judge.real_area) < 0.11 * AREA))
        found = [0.51 + 0.26 * (D - 2), fitted, 1 / (4 - D), light["Persson"].alpha[0]]
        found += [1.0, judge.alpha[tenth], law.alpha[tenth]]
        rows.append([f"{D}", *map(number, found)])
    return table(head, rows)


def picture(**options):
    """The figure: K_n over the load, a panel for each D."""
    figure = fj.plot.new_figure(9.8, 6.8)
    *panels, last = figure.subplots(-(-(len(DIMENSIONS) + 1) // 3), 3, sharey=True).flat
    for i, (ax, D) in enumerate(zip(panels, DIMENSIONS, strict=True)):
        fj.plot.law_curves(comparison(D, **options), ax)
        ax.set_title(f"D = {D}, G = {float(surface(D).G):.2g} m", fontsize="medium")
        ax.get_legend().remove()
        if i % 3:
            ax.set_ylabel("")
    last.legend(*panels[0].get_legend_handles_labels(), loc="center", frameon=False)
    last.set_axis_off()
    return figure


def page(**options) -> str:
    """The text of contact_laws.md."""
    rows, fractal, asperity, persson, ratios = [], [], [], [], []
    for D in DIMENSIONS:
        found = comparison(D, **options)
        laws: dict[str, Any] = found.curves
        judge, source, theirs = laws[BOUNDARY_ELEMENTS], laws["fractal"], laws["Persson"]
        revised = laws["asperity"]
        touching = np.asarray(judge.real_area) / AREA
        fractal += [float(x) for x in source.K_n / judge.K_n if x > 0]
        asperity += [float(x) for x in (revised.K_n / judge.K_n)[touching < 1 / 3]]
        persson += list(zip(touching, np.abs(np.log(theirs.K_n / judge.K_n)), strict=True))
        ratios += [float(t / n) for t, n in zip(source.K_t, source.K_n, strict=True) if n > 0]
        for i, P in enumerate(LOADS):
            row = [f"{D}", f"{P:.0f}", f"{touching[i]:.2g}"]
            row += [f"{float(law.K_n[i]):.3g}" for law in (source, revised, theirs, judge)]
            row.append(f"{float(judge.scatter[i]):.0%}")
            row += [number(law.alpha[i]) for law in (source, revised, theirs, judge)]
            rows.append([*row, f"{float(source.real_area[i]) / AREA:.2g}"])
    names = ["asperity", "Persson", "boundary elements"]
    head = ["D", "P [N]", "A_r/A", "K_n fractal [N/m]", *names, "scatter"]
    head += ["alpha fractal", *names, "A_r/A fractal"]
    closing = CLOSING.format(
        low=min(fractal),
        high=max(fractal),
        soft=min(asperity),
        stiff=max(asperity),
        half=np.expm1(max(off for share, off in persson if share < 0.5)),
        full=np.exp(max(off for _, off in persson)),
        anchors="\n".join(anchors(**options)),
        light_low=LIGHT[0],
        light_high=LIGHT[-1],
        ratios=f"{min(ratios):.2f} to {max(ratios):.2f}",
    )
    introduction = INTRODUCTION.format(n=options.get("n", N), seeds=options.get("seeds", 8))
    return introduction + "\n".join(table(head, rows)) + "\n" + closing


def number(value) -> str:
    """Three digits, or a dash where there is none."""
    return f"{float(value):.2f}" if np.isfinite(value) else "-"


if __name__ == "__main__":
    mpl.use("agg")
    run({PAGE: lambda: page().encode(), PICTURE: lambda: small_png(picture())})
