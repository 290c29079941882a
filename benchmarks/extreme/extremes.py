"""Stiff and extreme: every public quantity over ranges far beyond any brake's, in one table."""

import dataclasses
from collections.abc import Callable, Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from .. import truths
from ..cycles.reference import K_N, KAPPA, MU_M, MU_S, OSCILLATOR, V_M, V
from ..page import cell, png, subplots, table, versions
from ..timing import others_running, ran_on, this_machine
from . import cycles as cycle_extremes, programs
from .others import OTHERS, motion, other_row
from .points import AREA, EDGE, JOINT, MECHANISM
from .rows import FAMILIES, family_rows


@dataclasses.dataclass(frozen=True)
class Size:
    """How much is measured."""

    points: int  # of each family
    exact: int  # of them, beside 60 digits
    gradients: int  # of them, beside differences of 60 digits


FULL, QUICK = Size(200_000, 400, 30), Size(200, 10, 2)
QUICK_FAMILIES = ("equilibrium", "roughness")  # the others compile for too long

# What a quantity's derivative or value may be without an end, and why that is no defect.
WHY = {
    "mu_c": "infinite where K_t = 0: nothing squeals",
    "a_e": "infinite where ln a_e > 709: its logarithm is what the rest is computed from",
}
FOUND = [
    "A joint of almost elastic contacts alone (sigma_y/E above 0.07, gamma near 1, D below 2.05):"
    " (a_l/a_e)^((5-2D)/2) overflowed, and a_l, A_r, Q_e and the derivatives of K_n were NaN."
    " Mended: the load balance goes on as the straight line in ln a_l that it is there, and moments"
    " are taken from a_l, not from a_e.",
    "The same joints in forward mode: the derivative of x/(1 + x) formed x dx, which overflows."
    " Mended: the plastic share is 1/(1 + x).",
    "An eigenvalue that rounding makes 0 (xi = 1e4 beside K_n = 1e15 N/m) had a damping ratio of"
    " NaN, and so all of the scene's derivatives in reverse mode. Mended: the ratio is 0 there.",
    "In float32 the margin's derivative was NaN above K_n/m = 1e11 1/s^2, where omega^8 overflows,"
    " and that of the critical friction below damping of 1e-10 omega, where its square underflows."
    " Both mended.",
    "Numbers below 2e-308 (1e-38 in float32), which compiled programs take for 0: beta = 2e-309 s"
    " in rayleigh_damping. Left as it is.",
    "With friction above 1e3 and a direction of xi = 1e3 the growth rate is off by up to 3e-7 of"
    " the largest modulus, 7e-4 of omega: 24 for -15 1/s at mu = 3e6. Not mended.",
    "Q_e is negative near a_l = a_e for nu below 0.05: Eq. 32 as printed, so K_t then exceeds"
    " that of sticking contacts. Left as it is.",
]


def name_of(quantity: str, family: str) -> str:
    """A quantity as the table shows it, with the public function it comes from."""
    return {
        "joint": f"contact_state: {quantity}",
        "load of an area": "contact_load",
        "mechanism": {"real": "stability: eigenvalues"}.get(quantity, quantity),
        "equilibrium": "equilibrium",
        "critical friction": "critical_friction",
        "roughness": f"roughness: {quantity}",
    }[family]


# ---------------------------------------------------------------------------------------------
# The corners that were asked for
# ---------------------------------------------------------------------------------------------

BRAKE = {"D": 2.4, "G": 1.342e-10, "gamma": 1.5, "E": 1.154e11, "nu": 0.3, "sigma_y": 3.55e8}
BRAKE |= {"H": 9.94e8, "P": 1907.3, "mu_s": 0.4, "mu_m": 0.25}
MASS = {"m": 1.0} | OSCILLATOR | {"V": V, "K_n": K_N, "K_t": KAPPA * K_N}
MASS |= {"mu_s": MU_S, "mu_m": MU_M, "v_m": V_M}
# (omega_2^2 + K_n) - (omega_1^2 + K_t) = 2 mu sqrt(K_n K_t) in whole numbers.
COALESCED = {"omega_1": 12500.0, "omega_2": 7500.0, "K_n": 4e8, "K_t": 1e8, "xi_1": 0.0}
COALESCED |= {"xi_2": 0.0, "mu_s": 0.5, "mu_m": 0.5}

JOINT_CORNERS = [
    {"D": 2 + EDGE},
    {"D": 3 - EDGE},
    {"D": 2.5},
    {"G": 1e-18},
    {"G": 1e-4},
    {"P": 1e-6},
    {"P": 1e12},
    {"D": 2 + EDGE, "sigma_y": 1e11, "H": 1e11, "gamma": 1.001},
]
MASS_CORNERS = [
    {"K_n": 1e3, "K_t": 5e2},
    {"K_n": 1e15, "K_t": 5e14},
    {"xi_1": 0.0, "xi_2": 0.0},
    {"xi_1": 1e3, "xi_2": 1e3},
    {"xi_1": 1e-8, "xi_2": 1e3},
]


def corners() -> Iterator[tuple[str, str, Callable, Callable, list[float]]]:
    """Each named corner, its quantity, program and truth, and the numbers both are given."""
    kinds = [
        (BRAKE, JOINT_CORNERS, programs.contact_stiffness, truths.joint, "K_n"),
        (MASS, MASS_CORNERS, programs.growth_and_margin, truths.mechanism, "growth_rate"),
        (MASS | COALESCED, [{}], programs.growth_and_margin, truths.mechanism, "growth_rate"),
    ]
    for base, changed, program, truth, name in kinds:
        for changes in changed:
            label = ", ".join(f"{key} = {value:.7g}" for key, value in changes.items())
            numbers = list((base | changes).values())
            yield label or "exact coalescence", name, program, truth, numbers


def corner_rows() -> list[dict[str, Any]]:
    """K_n of the brake's joint, and growth rate of the reference mechanism, at named corners."""
    rows = []
    for corner, name, program, truth, numbers in corners():
        row: dict[str, Any] = {"corner": corner, "quantity": name}
        for dtype in (np.float64, np.float32):
            x = np.array(numbers, dtype)
            exact = truth(*x.astype(float).tolist())
            value = float(jax.jit(program)(jnp.asarray(x))[name])
            size = exact["modulus" if name == "growth_rate" else name]
            row |= {dtype.__name__: float(abs(value - exact[name]) / (size if size else 1))}
            if dtype == np.float64:
                row["value"] = value
        rows.append(row)
    return rows


# ---------------------------------------------------------------------------------------------
# Measuring
# ---------------------------------------------------------------------------------------------


def measure(quick: bool = False) -> dict[str, Any]:
    """Every number of the benchmark, ready for JSON."""
    size, busy = (QUICK if quick else FULL), others_running()
    families = [f for f in FAMILIES if not quick or f.name in QUICK_FAMILIES]
    rows = [
        row
        for family in families
        for row in family_rows(family, size.points, size.exact, size.gradients)
    ]
    others = [other for other in OTHERS if not quick or other.quantity == "identify"]
    return {
        "quick": quick,
        "machine": this_machine(busy),
        "versions": versions("jax", "numpy", "mpmath"),
        "rows": rows,
        "others": [other_row(other, quick) for other in others],
        "corners": [] if quick else corner_rows(),
        "motion": None if quick else motion(quick),
        "found": FOUND,
    }


# ---------------------------------------------------------------------------------------------
# Showing
# ---------------------------------------------------------------------------------------------

HEADINGS = [
    "quantity",
    "points",
    "worst error, float64: itself, beside rounding",
    "worst error, float32: the same",
    "worst of the gradient: float64; float32",
    "not finite, float64: value, gradient",
    "not finite, float32: value, gradient",
    "slowest tenth of the points, beside the median",
    "time a point [ns]",
]


def choice(result: dict[str, Any]) -> str:
    """One sentence: which precision to take."""
    bad = {bits: 0 for bits in ("float64", "float32")}
    for bits in bad:
        bad[bits] = sum(
            row[bits]["not_finite"] + row[bits]["not_finite_gradient"] - row[bits]["beyond_range"]
            for row in result["rows"]
            if row["quantity"] != "mu_c"
        )
    count = result["rows"][0]["float64"]["points"]
    return (
        f"Take float64 wherever a range is wide: of {count} points of each family"
        f" {bad['float64']} values or gradients are not finite for another reason than that they"
        f" must be, and {bad['float32']} in float32, which is for ordinary brakes."
    )


def cells(row: dict[str, Any]) -> list[str]:
    """One row of the main table."""
    double, single = row["float64"], row["float32"]

    def counts(found):
        must = f" ({found['beyond_range']} beyond the range)" if found["beyond_range"] else ""
        return f"{found['not_finite']}, {found['not_finite_gradient']}{must}"

    return [
        name_of(row["quantity"], row["family"]),
        f"{double['points']}, {double['exact_points']} of them exactly",
        f"{double['worst']:.1e}, {double['worst_beside_rounding']:.2g}",
        f"{single['worst']:.1e}, {single['worst_beside_rounding']:.2g}",
        f"{cell(double['gradient'], '.1e')}; {cell(single['gradient'], '.1e')}",
        counts(double),
        counts(single),
        f"{row['slowest']}: {row['slowest_ratio']:.2f}",
        f"{row['seconds'] * 1e9:.3g}",
    ]


def other_cells(row: dict[str, Any]) -> list[str]:
    """One row of the table of single calls."""
    return [
        row["quantity"],
        row["ranges"],
        str(row["points"]),
        f"{row['worst']:.1e}",
        str(row["not_finite"]),
        f"{row['slowest']}: {row['slowest_ratio']:.2g}",
        f"{row['seconds'] * 1e3:.3g}",
    ]


def ranges(where: dict[str, Any]) -> str:
    """The ranges of a family, as one line."""
    return "; ".join(f"{name} {span}" for name, span in where.items())


def text(result: dict[str, Any]) -> str:
    """The Markdown page: one sentence, the tables, the ranges, what was found."""
    lines = [
        "# Stiff and extreme",
        "",
        choice(result),
        "",
        *table(HEADINGS, [cells(row) for row in result["rows"]]),
        "",
        "Errors are relative, of tangential load Q_e beside the larger of itself and P, of plastic"
        " share and margin absolute, and of eigenvalues beside their largest modulus, against 60"
        " digits at the inputs as rounded. *Beside rounding*: divided by what rounding the inputs"
        " alone does to the exact value, eps (1 + sum |x dF/dx|/|F|); far from 1 the digits were"
        " lost on the way, near it they were not there to begin with, as towards D = 2, where"
        " ln a_e grows like 1/(D - 2), and in float32 everywhere near an edge. Gradients are"
        " reverse mode's, by logarithms, beside their largest component; forward and reverse are"
        " both counted where not finite. *Beyond the range*: the derivative itself is above 1e37 in"
        " float64, as those by G = 1e-18 m are; what is left in float32 are steps towards a"
        " derivative that overflow, with damping above 1e6 omega or K_n above 1e14 N/m."
        f" critical_friction is {WHY['mu_c']}; a_e is {WHY['a_e']}.",
        "",
        f"Joints: D to 2 + {EDGE:g} and 3 - {EDGE:g}; {ranges(JOINT)}; nu 0 to 0.5; SI units."
        f" Mechanisms: {ranges(MECHANISM)}; the force of both signs. Roughness: the same D, G and"
        f" gamma; {ranges(AREA)}. In logarithms, D in logarithms to both ends; a part of the points"
        " has few or most of its inputs at the ends or in the middle of their range. Every program"
        " runs the same operations for all its points; the points are timed in ten parts by D"
        " or K_n.",
        "",
    ]
    if result["corners"]:
        lines += [
            "## Corners",
            "",
            *table(
                ["corner", "quantity", "value", "error, float64", "float32"],
                [
                    [
                        row["corner"],
                        row["quantity"],
                        f"{row['value']:.6g}",
                        f"{row['float64']:.1e}",
                        f"{row['float32']:.1e}",
                    ]
                    for row in result["corners"]
                ],
            ),
            "",
            "The other numbers are those of the reference brake. K_n [N/m] relative, 0 where fully"
            " plastic; growth rate [1/s] beside the largest modulus of an eigenvalue. float32 is"
            " compared at inputs rounded to float32, which part exactly coalescing eigenvalues by"
            " the root of its rounding if any input is not one of its numbers.",
            "",
        ]
    lines += [
        "## One call at a time",
        "",
        *table(
            [
                "quantity",
                "ranges",
                "cases",
                "worst error",
                "not finite",
                "slowest case, beside the median",
                "time: median [ms]",
            ],
            [other_cells(row) for row in result["others"]],
        ),
        "",
        "modal_damping: the ratio that comes back in 40 digits, weighted by frequency beside the"
        " highest. Structures: beside the largest modulus, 60 digits. hopf_boundary: growth rate on"
        " the branches beside the imaginary pair. topography: beside the largest height, wave by"
        " wave in extended doubles. identify: D, and ln G, beside those in other units. Not finite:"
        " cases whose error is not.",
        "",
    ]
    if result["motion"]:
        lines += motion_section(result["motion"])
    lines += ["## What the search found", "", *(f"- {found}" for found in result["found"]), ""]
    return "\n".join([*lines, ran_on(result), ""])


def motion_section(found: dict[str, Any]) -> list[str]:
    """The lines about limit cycles and thin tanh layers."""
    lines = ["## Limit cycles and simulation", ""]
    lines += [*cycle_extremes.extreme_table(found["cycles"]), ""]
    if found["grazing"]:
        lines += [
            "Grazing: direction 1 of the reference scene sticks on one side only of this K_n,"
            " found to 1e-9.",
            "",
            *table(
                ["K_n [N/m]", "share of sticking", "period [s]", "estimated error"],
                [
                    [
                        f"{row['K_n']:.10g}",
                        f"{row['stick']:.1e}",
                        f"{row['period']:.12g}",
                        f"{row['error']:.1e}",
                    ]
                    for row in found["grazing"]
                ],
            ),
            "",
        ]
    return [*lines, *cycle_extremes.stiff_table(found["layers"]), ""]


def picture(result: dict[str, Any]) -> bytes:
    """Worst error of each quantity, in both precisions."""
    rows: list[tuple[str, Any, Any]] = [
        (name_of(r["quantity"], r["family"]), r["float64"], r["float32"]) for r in result["rows"]
    ]
    rows += [(r["quantity"], r, None) for r in result["others"]]
    names = [name for name, _, _ in rows]
    figure, ax = subplots(figsize=(9.5, 0.36 * len(rows) + 1.6))
    columns = [("float64", "o", "tab:blue", [double for _, double, _ in rows])]
    columns += [("float32", "s", "tab:orange", [single for _, _, single in rows])]
    for label, marker, colour, found in columns:
        shown = [(i, row["worst"]) for i, row in enumerate(found) if row is not None]
        x = [max(worst, 1e-18) for _, worst in shown]
        y = [i for i, _ in shown]
        ax.plot(x, y, marker, color=colour, mec="k", ms=8, ls="", label=label)
    for eps, label in ((2.0**-52, "eps, float64"), (2.0**-23, "eps, float32")):
        ax.axvline(eps, color="0.5", lw=0.8, ls=":", zorder=0)
        ax.annotate(
            label,
            (eps, 1),
            xycoords=("data", "axes fraction"),
            xytext=(3, 3),
            textcoords="offset points",
            fontsize=8,
            color="0.3",
        )
    ax.set_yticks(range(len(rows)), names)
    ax.invert_yaxis()
    ax.set(xscale="log", xlabel="worst error, as the page says beside what [-]")
    ax.grid(True, which="major", alpha=0.3)
    figure.legend(loc="outside lower right", ncols=2, fontsize="small")
    return png(figure, dpi=110)
