"""The source's Figs. 7 to 10 drawn, and what its text says of them checked in numbers.

`python docs/make_figures_7_to_10.py` writes figures_7_to_10.md and its pictures.
"""

import functools
from collections import Counter
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np
from writing import run, small_png, table

import fractaljax as fj
from fractaljax.plot.maps import vibration_modes

PAGE = Path(__file__).with_name("figures_7_to_10.md")
POINTS = 400  # a side
KAPPA = 0.15  # where the source has its Hopf point
# Friction (None: an axis) and K_n/(4e8 N/m). The axes of the source are lost in its scan. These
# show the whole unstable region, except for a friction above 1.
PANELS = {
    "7": (None, 1.0),
    "8": (None, 8.0),
    "9a": (0.1, 1.0),
    "9b": (0.2, 1.0),
    "9c": (0.2, 0.4),
    "9d": (0.3, 1.0),
}


def scene_of(panel: str) -> fj.Scene:
    """The scene of a panel: the source's section 3.2 with constant friction."""
    mu, factor = PANELS[panel]
    contact = fj.FixedContact(4e8 * factor, 2e8 * factor)
    return fj.Scene(contact, fj.Coulomb(mu or 0.4), fj.brake_scene().oscillator)


@functools.cache
def modes_of(panel: str, points: int = POINTS) -> fj.Sweep:
    """Both modes over friction, or the ratio of frequencies, and the stiffness ratio kappa."""
    x, y = np.linspace(0.0025, 1, points), np.linspace(0.0025, 1, points)
    name = "mu"
    if PANELS[panel][0] is not None:
        x, y, name = np.linspace(0.02, 6, points), np.linspace(0, 1.6, points), "omega_1/omega_2"
    axes: dict[str, Any] = {name: x, "K_t/K_n": y}
    return fj.sweep(fj.stability, scene_of(panel), progress=False, **axes)


def at_ratio(panel, kappa):
    """The scene of a panel with K_t = kappa K_n."""
    scene = scene_of(panel)
    return scene.replace(K_t=kappa * scene.contact.K_n)


def critical_friction(panel, kappa):
    """The friction where squeal begins."""
    return float(fj.critical_friction(at_ratio(panel, kappa)))


def critical_ratio(panel, mu):
    """The kappa below 0.95 where squeal begins at a friction, by bisection."""
    low, high = 1e-4, 0.95  # the critical friction falls between them
    for _ in range(50):
        middle = (low + high) / 2
        low, high = (middle, high) if critical_friction(panel, middle) > mu else (low, middle)
    return high


def critical_frequency(panel, mu, kappa):
    """Frequency [kHz] on the boundary."""
    return float(fj.stability(at_ratio(panel, kappa).replace(mu=mu)).frequency) / 1e3


class Map:
    """One panel as arrays (kappa, x)."""

    def __init__(self, panel):
        result, scene = modes_of(panel), scene_of(panel)
        self.x, self.y = result.points
        self.growth = result.growth_rate.T
        self.low, self.high = (vibration_modes(result)[1][..., i].T / 1e3 for i in (0, 1))
        self.unstable = self.growth > 0
        x, y = self.x[None, :], self.y[:, None]
        K_n, omega_2 = float(scene.contact.K_n), float(scene.oscillator.omega_2)
        mu, omega_1 = x, float(scene.oscillator.omega_1)
        if PANELS[panel][0] is not None:
            mu, omega_1 = float(scene.friction.mu_s), x * omega_2
        apart = omega_1**2 + y * K_n - omega_2**2 - K_n  # m = 1 kg
        # Without damping the frequencies meet inside, and nowhere else.
        self.coupled = np.abs(apart) < 2 * mu * np.sqrt(y) * K_n
        self.ridge = np.where(y <= 1.3, np.abs(apart), np.inf).argmin(axis=0)

    @property
    def area(self):
        """Unstable share of the map, %."""
        return 100 * self.unstable.mean()

    @property
    def coupling(self):
        """Mean frequency of the two modes where they are coupled and unstable [kHz]."""
        return ((self.low + self.high) / 2)[self.coupled & self.unstable]


def percent(mask):
    """Share of true ones, %."""
    return f"{100 * np.mean(mask):.1f} %"


def falls(gap, axis, where):
    """Share of neighbours along an axis, both in `where`, between which the gap falls."""
    ahead, behind = np.moveaxis(gap, axis, 0)[1:], np.moveaxis(gap, axis, 0)[:-1]
    both = np.moveaxis(where, axis, 0)
    return percent((ahead < behind)[both[1:] & both[:-1]])


def patterns(unstable):
    """Shares of the columns by their sequence as kappa grows: S stable, U unstable."""
    words = ("".join("SU"[key] for key, _ in groupby(column)) for column in unstable.T.tolist())
    return {word: n / unstable.shape[1] for word, n in sorted(Counter(words).items())}


def friction_claims(maps):
    """Rows (what the source says, verdict, numbers) of Figs. 7 and 8."""
    seven, eight = maps["7"], maps["8"]
    gap, apart = seven.high - seven.low, ~seven.coupled
    below = apart & (seven.y[:, None] < 0.95)
    early = seven.unstable & ~seven.coupled
    mus = (0.2, 0.4, 0.6, 0.8, 1.0)
    hopf = ", ".join(
        f"{critical_ratio('7', mu):.4f} and {critical_ratio('8', mu):.4f} at mu = {mu:g}"
        for mu in mus
    )
    ends = [critical_ratio("7", mu) for mu in (0.9, 0.1)]
    rate = eight.growth[seven.unstable & eight.unstable]
    rate = rate / seven.growth[seven.unstable & eight.unstable]
    c = [critical_friction(panel, KAPPA) for panel in "78"]
    scene = scene_of("7")
    squares = float(scene.oscillator.omega_2**2 - scene.oscillator.omega_1**2)
    meeting = 1 + squares / float(scene.contact.K_n)
    off = [(eight.growth > 0) != (seven.growth > 0)]
    return [
        (
            "The unstable region is where the frequencies are coupled (7a and 7c, 8a and 8c)",
            "roughly",
            f"{percent(seven.unstable[seven.coupled])} of where the undamped frequencies are equal"
            f" is unstable, but {percent(early[seven.unstable])} of the unstable region (Fig. 8:"
            f" {percent((eight.unstable & ~eight.coupled)[eight.unstable])}) is not there: unequal"
            " damping destabilises modes that are still apart, by up to"
            f" {gap[early].max():.2f} kHz",
        ),
        (
            "The two frequencies tend to each other as mu and kappa grow",
            "holds up to kappa = 0.96",
            f"outside coupling the gap falls with mu at {falls(gap, 1, apart)} of the points, and"
            f" with kappa at {falls(gap, 0, below)} of those below kappa = 0.95; from"
            f" kappa = {meeting:.4f}, where the uncoupled frequencies are equal, it opens again",
        ),
        (
            "Small kappa and large mu: squeal of lower frequency; large kappa and small mu: of"
            " higher",
            "holds",
            f"on the boundary {critical_frequency('7', 0.9, ends[0]):.3f} kHz at (mu, kappa) ="
            f" (0.9, {ends[0]:.3f}), {critical_frequency('7', 0.1, ends[1]):.3f} kHz at"
            f" (0.1, {ends[1]:.3f})",
        ),
        (
            "With 8 K_n the trends are nearly the same",
            "holds",
            f"{percent(off)} of the points change sides; where both are unstable the growth rate"
            f" is {np.median(rate):.2f} times as large (median; sqrt(8) = {np.sqrt(8):.2f})",
        ),
        (
            "The coupling frequency increases obviously with K_n",
            "holds",
            f"{seven.coupling.min():.2f} to {seven.coupling.max():.2f} kHz becomes"
            f" {eight.coupling.min():.2f} to {eight.coupling.max():.2f} kHz; the mean is"
            f" {eight.coupling.mean() / seven.coupling.mean():.3f} times as high",
        ),
        (
            "The unstable area increases obviously with K_n",
            "does not hold",
            f"{seven.area:.2f} % of the map at K_n, {eight.area:.2f} % at 8 K_n: it shrinks,"
            " if anything. (Its section 3.3 and third conclusion say that stiffness promotes"
            " stability.)",
        ),
        (
            "The Hopf point, kappa = 0.15, does not change with K_n",
            "roughly, and at one mu only",
            f"at kappa = 0.15 squeal begins at mu = {c[0]:.7f} with K_n and {c[1]:.7f} with 8 K_n"
            f" (at kappa = 0.5 with K_n: {critical_friction('7', 0.5):.7f}); at mu = {c[0]:.4f} the"
            f" Hopf point moves to kappa = {critical_ratio('8', c[0]):.4f}. With K_n and 8 K_n it"
            f" is {hopf}",
        ),
    ]


def frequency_claims(maps):
    """Rows of Figs. 9 and 10."""
    a, b, c, d = (maps[f"9{letter}"] for letter in "abcd")
    sus = {letter: patterns(maps[f"9{letter}"].unstable) for letter in "abcd"}
    words = "; ".join(
        f"({letter}) " + ", ".join(f"{word} {100 * share:.1f} %" for word, share in found.items())
        for letter, found in sus.items()
    )
    places = [int(np.abs(b.x - ratio).argmin()) for ratio in (0.5, 2, 3.5)]
    ridge = "; ".join(
        f"kappa {b.y[rows.min()]:.2f} to {b.y[rows.max()]:.2f} at omega = {b.x[i]:.2f}"
        for i in places
        if (rows := np.flatnonzero(b.unstable[:, i])).size
    )
    top = [(b.low[b.ridge[i], i] + b.high[b.ridge[i], i]) / 2 for i in places]
    lower = [(c.low < b.low), (c.high < b.high)]
    changes = "; ".join(
        f"{name} by {100 * np.median(moved):.2f} % in the median, {100 * moved.max():.1f} % at most"
        for name, moved in [
            ("the first", np.abs(d.low / a.low - 1)),
            ("the second", np.abs(d.high / a.high - 1)),
        ]
    )
    mean, inside = (b.low + b.high) / 2, b.coupled & b.unstable
    rises = [falls(-mean, axis, inside) for axis in (1, 0)]
    return [
        (
            "9c to 9d, mu and K_n larger: the unstable region grows",
            "holds",
            f"{c.area:.2f} % to {d.area:.2f} % of the map",
        ),
        (
            "9a to 9c, mu larger and K_n smaller: no obvious change of the unstable region",
            "roughly",
            f"{a.area:.2f} % to {c.area:.2f} %, {c.area / a.area:.2f} times, but another place:"
            f" {percent((a.unstable & c.unstable)[a.unstable | c.unstable])} of their union is in"
            " both",
        ),
        (
            '9a, b and "c" (d is meant, c has another K_n), mu larger: the unstable area grows',
            "holds",
            f"{a.area:.2f} %, {b.area:.2f} %, {d.area:.2f} %",
        ),
        (
            "As omega and kappa grow: stable, unstable, stable",
            "roughly",
            f"share of the values of omega, upwards in kappa to {b.y[-1]:g}: {words}. Above"
            f" omega = {a.x[a.unstable.any(axis=0)].max():.2f} in (a),"
            f" {c.x[c.unstable.any(axis=0)].max():.2f} in (c) it is stable for every kappa. As"
            " omega vanishes so does the damping along the belt, 2 xi_1 omega_1: at"
            f" omega = {a.x[0]:g} in (a) {percent(a.unstable[:, 0])} of the values of kappa are"
            " unstable",
        ),
        (
            "Small omega with large kappa squeals, and large omega with small kappa",
            "holds",
            f"in (b) {ridge}",
        ),
        (
            "10b to 10c, K_n smaller: both natural frequencies decrease",
            "holds",
            f"the first at {percent(lower[0])} of the points, the second at {percent(lower[1])};"
            f" by {100 * (1 - np.median(c.low / b.low)):.0f} % and"
            f" {100 * (1 - np.median(c.high / b.high)):.0f} % (median)",
        ),
        (
            "10a, b, d, mu larger: no obvious change of the frequencies",
            "roughly",
            f"mu from 0.1 to 0.3 moves {changes}",
        ),
        (
            "The coupling frequency increases with omega and kappa",
            "in one of them at a time only",
            f"inside coupling in (b) it rises with omega at {rises[0]} of the points and with"
            f" kappa at {rises[1]}; but along the region, where one grows as the other falls, it"
            f" does not change: {top[0]:.3f}, {top[1]:.3f}, {top[2]:.3f} kHz at omega = 0.5, 2, 3.5"
            " on the line of equal uncoupled frequencies, sqrt(omega_2^2 + K_n/m) all along",
        ),
    ]


INTRODUCTION = """\
# The source's Figs. 7 to 10

Real part and frequency of both modes by the source's Eq. 43 with constant friction. Figs. 7 and 8
show them over friction mu and stiffness ratio kappa = K_t/K_n, for K_n = 4e8 N/m and 8 times that.
Figs. 9 and 10 show them over omega = omega_1/omega_2, at its omega_2, and kappa, for mu = 0.1, 0.2,
0.2, 0.3 and K_n = 4e8, 4e8, 1.6e8, 4e8 N/m. The axes of the source are lost in its scan. Here mu
and kappa go up to 1 in the first two, and omega to 6 and kappa to 1.6 in the others.

    result = fj.sweep(fj.stability, scene, **{"mu": mu, "K_t/K_n": kappa})
    fj.plot.growth_map(result)           # also frequency_map, mode_lines, mode_surfaces, modes

`fj.sweep` takes any quantities of any scene. Shares of an area below are shares of a map with
400 x 400 points.
"""


def figure(number: int, points: int = POINTS):
    """Fig. 7, 8, 9 or 10 as maps."""
    if number < 9:
        return fj.plot.modes(modes_of(str(number), points)).figure
    drawn = fj.plot.new_figure(11.2, 9.2 if number == 9 else 17)
    rows = drawn.subplots(2, 2).reshape(4, 1) if number == 9 else drawn.subplots(4, 2)
    for letter, row in zip("abcd", rows, strict=True):
        result = modes_of(f"9{letter}", points)
        for mode, ax in enumerate(row, start=1):
            if number == 9:
                fj.plot.growth_map(result, ax)
            else:
                fj.plot.frequency_map(result, ax, mode=mode)
            ax.set_title(f"({letter}) {ax.get_title(loc='left')}", fontsize="medium", loc="left")
    return drawn


PICTURES = {
    "figure_7.png": ("Fig. 7: K_n = 4e8 N/m", lambda: figure(7)),
    "figure_7_surfaces.png": (
        "The real parts of Fig. 7 as surfaces, as the source draws them",
        lambda: fj.plot.mode_surfaces(modes_of("7")).figure,
    ),
    "figure_8.png": ("Fig. 8: K_n = 3.2e9 N/m", lambda: figure(8)),
    "figure_9.png": ("Fig. 9: growth rate over omega and kappa", lambda: figure(9)),
    "figure_10.png": ("Fig. 10: frequencies over omega and kappa", lambda: figure(10)),
}


def page() -> str:
    """The text of figures_7_to_10.md."""
    maps, lines = {panel: Map(panel) for panel in PANELS}, [INTRODUCTION]
    for title, rows, names in [
        ("Figs. 7 and 8", friction_claims(maps), list(PICTURES)[:3]),
        ("Figs. 9 and 10", frequency_claims(maps), list(PICTURES)[3:]),
    ]:
        lines += [f"## {title}", "", *table(["the source says", "verdict", "numbers"], rows), ""]
        lines += [f"![{PICTURES[name][0]}]({name})\n" for name in names]
    return "\n".join([*lines, "Written by `python docs/make_figures_7_to_10.py`.", ""])


if __name__ == "__main__":
    run(
        {
            PAGE.with_name(name): lambda draw=draw: small_png(draw())
            for name, (_, draw) in PICTURES.items()
        }
        | {PAGE: lambda: page().encode()}
    )
