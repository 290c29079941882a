"""Stiff and extreme: every public quantity over ranges far beyond any brake's, in one table."""

from collections.abc import Iterator
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from . import truths
from .extreme import programs
from .extreme.families import FAMILIES, family_rows
from .extreme.points import AREA, EDGE, JOINT, MECHANISM
from .extreme.single_calls import QUANTITIES, cycles, grazing, layers, quantity_row
from .page import cell, png, subplots, table
from .transients import K_N, KAPPA, MU_M, MU_S, OSCILLATOR, V_M, V

TITLE = "Stiff and extreme"
PACKAGES = ("numpy", "mpmath")
Result = dict[str, Any]


class Size(NamedTuple):
    """How much is measured."""

    points: int  # of each family
    exact: int  # of them, beside 60 digits
    gradients: int  # of them, beside differences of 60 digits


FULL, QUICK = Size(200_000, 400, 30), Size(200, 10, 2)
QUICKLY = ("equilibrium", "roughness", "identify")  # the others compile for too long
FOUND = """
- A joint of almost elastic contacts alone (sigma_y/E above 0.07, gamma near 1, D below 2.05): (a_l/a_e)^((5-2D)/2) overflowed, and a_l, A_r, Q_e and the derivatives of K_n were NaN. Fixed: the load balance continues as the straight line in ln a_l that it is there, and moments are computed from a_l, not from a_e.
- The same joints in forward mode: the derivative of x/(1 + x) formed x dx, which overflows. Fixed: the plastic share is 1/(1 + x).
- An eigenvalue that rounding makes 0 (xi = 1e4 beside K_n = 1e15 N/m) had a damping ratio of NaN, and so had all derivatives of the scene in reverse mode. Fixed: the ratio is 0 there.
- In float32 the margin's derivative was NaN above K_n/m = 1e11 1/s^2, where omega^8 overflows, and that of the critical friction below damping of 1e-10 omega, where its square underflows. Both fixed.
- Numbers below 2e-308 (1e-38 in float32) are 0 to compiled programs: beta = 2e-309 s in rayleigh_damping. Not changed.
- With friction above 1e3 and a direction of xi = 1e3 the growth rate is off by up to 3e-7 of the largest modulus, 7e-4 of omega: 24 for -15 1/s at mu = 3e6. Not fixed.
- Q_e is negative near a_l = a_e for nu below 0.05: Eq. 32 as printed, so K_t then exceeds that of sticking contacts. Not changed.
""".strip()  # noqa: E501


# The corners that were asked for ------------------------------------------------------------------

BRAKE = {"D": 2.4, "G": 1.342e-10, "gamma": 1.5, "E": 1.154e11, "nu": 0.3, "sigma_y": 3.55e8}
BRAKE |= {"H": 9.94e8, "P": 1907.3, "mu_s": 0.4, "mu_m": 0.25}
MASS = {"m": 1.0} | OSCILLATOR | {"V": V, "K_n": K_N, "K_t": KAPPA * K_N}
MASS |= {"mu_s": MU_S, "mu_m": MU_M, "v_m": V_M}
# (omega_2^2 + K_n) - (omega_1^2 + K_t) = 2 mu sqrt(K_n K_t) in whole numbers.
COALESCED = {"omega_1": 12500.0, "omega_2": 7500.0, "K_n": 4e8, "K_t": 1e8, "xi_1": 0.0}
COALESCED |= {"xi_2": 0.0, "mu_s": 0.5, "mu_m": 0.5}
CORNERS: list[dict[str, float]] = [
    {"D": 2 + EDGE},
    {"D": 3 - EDGE},
    {"D": 2.5},
    {"G": 1e-18},
    {"G": 1e-4},
    {"P": 1e-6},
    {"P": 1e12},
    {"D": 2 + EDGE, "sigma_y": 1e11, "H": 1e11, "gamma": 1.001},
    {"K_n": 1e3, "K_t": 5e2},
    {"K_n": 1e15, "K_t": 5e14},
    {"xi_1": 0.0, "xi_2": 0.0},
    {"xi_1": 1e3, "xi_2": 1e3},
    {"xi_1": 1e-8, "xi_2": 1e3},
    COALESCED,
]


def corner_rows() -> Iterator[tuple[Result, truths.Truth, list[float]]]:
    """K_n of the brake's joint, or growth rate of the reference mechanism, at each named corner.

    With the truth, and the numbers that it is given.
    """
    for changes in CORNERS:
        mechanism = not changes.keys() <= BRAKE.keys()
        numbers = list(((MASS if mechanism else BRAKE) | changes).values())
        name, beside = ("growth_rate", "modulus") if mechanism else ("K_n", "K_n")
        program = programs.growth_and_margin if mechanism else programs.contact_stiffness
        truth = truths.mechanism if mechanism else truths.joint
        label = ", ".join(f"{key} = {value:.7g}" for key, value in changes.items())
        row: Result = {"corner": label, "quantity": name}
        if changes is COALESCED:
            row["corner"] = "exact coalescence"
        for dtype in (np.float32, np.float64):
            x = np.array(numbers, dtype)
            exact = truth(*x.astype(float).tolist())
            row["value"] = float(jax.jit(program)(jnp.asarray(x))[name])
            size = exact[beside] or 1
            row[dtype.__name__] = float(abs(row["value"] - exact[name]) / size)
        yield row, truth, numbers


def measure(quick: bool) -> Result:
    """Rows of every family, single call, corner and motion."""
    size = QUICK if quick else FULL
    rows = [
        row
        for family in FAMILIES
        if not quick or family.name in QUICKLY
        for row in family_rows(family, *size)
    ]
    single = [quantity for quantity in QUANTITIES if not quick or quantity.name in QUICKLY]
    moving = {"cycles": cycles, "layers": layers, "grazing": grazing}
    return {
        "rows": rows,
        "others": [quantity_row(quantity) for quantity in single],
        "corners": [] if quick else [row for row, _, _ in corner_rows()],
        "motion": None if quick else {name: measured() for name, measured in moving.items()},
    }


# The page -----------------------------------------------------------------------------------------


def name_of(row: Result) -> str:
    """A quantity as the table shows it, with the public function it comes from."""
    return {
        "joint": f"contact_state: {row['quantity']}",
        "load of an area": "contact_load",
        "mechanism": {"real": "stability: eigenvalues"}.get(row["quantity"], row["quantity"]),
        "equilibrium": "equilibrium",
        "critical friction": "critical_friction",
        "roughness": f"roughness: {row['quantity']}",
    }[row["family"]]


def choice(result: Result) -> str:
    """One sentence: which precision to use."""
    bad = [
        sum(
            row[bits]["not_finite"] + row[bits]["not_finite_gradient"] - row[bits]["beyond_range"]
            for row in result["rows"]
            if row["quantity"] != "mu_c"
        )
        for bits in ("float64", "float32")
    ]
    return f"""Use float64 wherever a range is wide. Of {result["rows"][0]["float64"]["points"]}
        points of each family, {bad[0]} values or gradients are not finite where they should be, and
        {bad[1]} in float32, which is for ordinary brakes."""


def cells(row: Result) -> str:
    """One row of the main table."""
    pair = row["float64"], row["float32"]

    def counts(found):
        must = f" ({found['beyond_range']} beyond the range)" if found["beyond_range"] else ""
        return f"{found['not_finite']}, {found['not_finite_gradient']}{must}"

    return " | ".join(
        [
            name_of(row),
            f"{pair[0]['points']}, {pair[0]['exact_points']} of them exactly",
            *(f"{x['worst']:.1e}, {x['worst_beside_rounding']:.2g}" for x in pair),
            "; ".join(cell(x["gradient"], ".1e") for x in pair),
            *map(counts, pair),
            f"{row['slowest']}: {row['slowest_ratio']:.2f}",
            f"{row['seconds'] * 1e9:.3g}",
        ]
    )


def ranges(where: dict[str, Any]) -> str:
    """The ranges of a family, as one line."""
    return "; ".join(f"{name} {span}" for name, span in where.items())


def corner_blocks(rows: list[Result]) -> list[str]:
    """The table of the corners."""
    return [
        "## Corners",
        table(
            "corner | quantity | value | error, float64 | float32",
            (
                f"{r['corner']} | {r['quantity']} | {r['value']:.6g} | {r['float64']:.1e}"
                f" | {r['float32']:.1e}"
                for r in rows
            ),
        ),
        """The other numbers are those of the reference brake. Errors of K_n [N/m] are relative, 0
        where fully plastic; those of the growth rate [1/s] are beside the largest modulus of an
        eigenvalue. float32 is compared at inputs rounded to float32, which separate exactly
        coalescing eigenvalues by the root of its rounding unless float32 holds all inputs
        exactly.""",
    ]


def motion_blocks(found: Result) -> list[str]:
    """The tables of limit cycles and thin tanh layers."""
    grazing = [
        "Grazing: direction 1 of the reference scene sticks on one side only of this K_n, found to"
        " 1e-9.",
        table(
            "K_n [N/m] | share of sticking | period [s] | estimated error",
            (
                f"{r['K_n']:.10g} | {r['stick']:.1e} | {r['period']:.12g} | {r['error']:.1e}"
                for r in found["grazing"]
            ),
        ),
    ]
    return [
        "## Limit cycles and simulation",
        table(
            "scene | result | growth / omega | returns | period [s] | estimated error"
            " | trivial multiplier - 1 | time [ms] | non-finite",
            (
                f"{r['name']} | {r['result']} | {cell(r['growth_by_omega'], '.1e')} | {r['turns']}"
                f" | {cell(r['period'], '.6g')} | {cell(r['error'], '.1e')}"
                f" | {cell(r['trivial_multiplier_off'], '.1e')} | {r['seconds'] * 1e3:.3g}"
                f" | {r['non_finite'] or 'no'}"
                for r in found["cycles"]
            ),
        ),
        *(grazing if found["grazing"] else []),
        table(
            "eps [m/s] | result | steps | time [s] | off the exact cycle, scaled",
            (
                f"{r['eps']:.0e} | {r['result']} | {r['steps']} | {r['seconds']:.3g}"
                f" | {cell(r['off_the_exact_cycle'], '.1e')}"
                for r in found["layers"]
            ),
        ),
    ]


def page(result: Result) -> list[str]:
    """One sentence, the tables, the ranges, the defects that were found."""
    return [
        choice(result),
        table(
            "quantity | points | worst error, float64: itself, beside rounding"
            " | worst error, float32: the same | worst of the gradient: float64; float32"
            " | not finite, float64: value, gradient | not finite, float32: value, gradient"
            " | slowest tenth of the points, beside the median | time a point [ns]",
            map(cells, result["rows"]),
        ),
        """Errors are relative; of the tangential load Q_e beside the larger of itself and P, of
        plastic share and margin absolute, and of eigenvalues beside their largest modulus, against
        60 digits at the inputs as rounded. *Beside rounding*: divided by what rounding the inputs
        alone does to the exact value, eps (1 + sum |x dF/dx|/|F|). Far above 1, digits were lost on
        the way; near 1, they were never there, as towards D = 2, where ln a_e grows like
        1/(D - 2), and in float32 everywhere near an edge. Gradients are reverse mode's, by
        logarithms, beside their largest component; forward and reverse are both counted where not
        finite. *Beyond the range*: the derivative itself is above 1e37 in float64, as those by
        G = 1e-18 m are; what is left in float32 are steps towards a derivative that overflow, with
        damping above 1e6 omega or K_n above 1e14 N/m. critical_friction is infinite where K_t = 0:
        nothing squeals; a_e is infinite where ln a_e > 709: the rest is computed from its
        logarithm.""",
        f"""Joints: D to 2 + {EDGE:g} and 3 - {EDGE:g}; {ranges(JOINT)}; nu 0 to 0.5; SI units.
        Mechanisms: {ranges(MECHANISM)}; the force of both signs. Roughness: the same D, G and
        gamma; {ranges(AREA)}. In logarithms, D in logarithms to both ends; a part of the points has
        few or most of its inputs at the ends or in the middle of their range. Every program runs
        the same operations for all its points; the points are timed in ten parts by D or K_n.""",
        *(corner_blocks(result["corners"]) if result["corners"] else []),
        "## One call at a time",
        table(
            "quantity | ranges | cases | worst error | not finite"
            " | slowest case, beside the median | time: median [ms]",
            (
                f"{r['quantity']} | {r['ranges']} | {r['points']} | {r['worst']:.1e}"
                f" | {r['not_finite']} | {r['slowest']}: {r['slowest_ratio']:.2g}"
                f" | {r['seconds'] * 1e3:.3g}"
                for r in result["others"]
            ),
        ),
        """modal_damping: the ratio that comes back in 40 digits, weighted by frequency beside the
        highest. Structures: beside the largest modulus, 60 digits. hopf_boundary: growth rate on
        the branches beside the imaginary pair. topography: beside the largest height, wave by wave
        in extended doubles. identify: D, and ln G, beside those in other units. Not finite: cases
        whose error is not.""",
        *(motion_blocks(result["motion"]) if result["motion"] else []),
        "## Defects that the search found",
        FOUND,
    ]


def picture(result: Result) -> bytes:
    """Worst error of each quantity, in both precisions."""
    rows = [{"name": name_of(r)} | {k: r[k]["worst"] for k in LINES} for r in result["rows"]]
    rows += [{"name": r["quantity"], "float64": r["worst"]} for r in result["others"]]
    figure, ax = subplots(figsize=(9.5, 0.36 * len(rows) + 1.6))
    for name, (marker, colour, eps) in LINES.items():
        shown = [(max(row[name], 1e-18), i) for i, row in enumerate(rows) if name in row]
        ax.plot(*zip(*shown, strict=True), marker, color=colour, mec="k", ms=8, ls="", label=name)
        ax.axvline(eps, color="0.5", lw=0.8, ls=":", zorder=0)
        place: dict[str, Any] = {"xycoords": ("data", "axes fraction"), "xytext": (3, 3)}
        place |= {"textcoords": "offset points", "fontsize": 8, "color": "0.3"}
        ax.annotate(f"eps, {name}", (eps, 1), **place)
    ax.set_yticks(range(len(rows)), [row["name"] for row in rows])
    ax.invert_yaxis()
    ax.set(xscale="log", xlabel="worst error, as the page says beside what [-]")
    ax.grid(True, which="major", alpha=0.3)
    figure.legend(loc="outside lower right", ncols=2, fontsize="small")
    return png(figure)


LINES = {"float64": ("o", "tab:blue", 2.0**-52), "float32": ("s", "tab:orange", 2.0**-23)}
