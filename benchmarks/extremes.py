"""Stiff and extreme: every public quantity over ranges far beyond any brake's, in one table."""

import dataclasses
from collections.abc import Callable, Iterator
from typing import Any

import jax
import jax.numpy as jnp
import mpmath
import numpy as np
from tqdm import tqdm

from . import truths
from .extreme import points, programs
from .extreme.single_calls import QUANTITIES, cycles, grazing, layers, quantity_row
from .page import png, subplots, table
from .timing import seconds
from .transients import K_N, KAPPA, MU_M, MU_S, OSCILLATOR, V_M, V

TITLE = "Stiff and extreme"
PACKAGES = ("numpy", "mpmath")
# Points of each family; of them beside 60 digits; and of these beside differences of 60 digits.
FULL = {"count": 200_000, "exact": 400, "gradients": 30}
QUICK = {"count": 200, "exact": 10, "gradients": 2, "few": ("equilibrium", "roughness", "identify")}
PARTS, REPEATS = 10, 5  # of all points, timed apart
BEYOND = 1e37  # where a derivative leaves the range of a float32, or a step towards it does
Result = dict[str, Any]
FOUND = """
- A joint of almost elastic contacts alone (sigma_y/E above 0.07, gamma near 1, D below 2.05): (a_l/a_e)^((5-2D)/2) overflowed, and a_l, A_r, Q_e and the derivatives of K_n were NaN. Fixed: the load balance continues as the straight line in ln a_l that it is there, and moments are computed from a_l, not from a_e.
- The same joints in forward mode: the derivative of x/(1 + x) formed x dx, which overflows. Fixed: the plastic share is 1/(1 + x).
- An eigenvalue that rounding makes 0 (xi = 1e4 beside K_n = 1e15 N/m) had a damping ratio of NaN, and so had all derivatives of the scene in reverse mode. Fixed: the ratio is 0 there.
- In float32 the margin's derivative was NaN above K_n/m = 1e11 1/s^2, where omega^8 overflows, and that of the critical friction below damping of 1e-10 omega, where its square underflows. Both fixed.
- Numbers below 2e-308 (1e-38 in float32) are 0 to compiled programs: beta = 2e-309 s in rayleigh_damping. Not changed.
- With friction above 1e3 and a direction of xi = 1e3 the growth rate is off by up to 3e-7 of the largest modulus, 7e-4 of omega: 24 for -15 1/s at mu = 3e6. Not fixed.
- Q_e is negative near a_l = a_e for nu below 0.05: Eq. 32 as printed, so K_t then exceeds that of sticking contacts. Not changed.
""".strip()  # noqa: E501


# Families of quantities that come from rows of numbers


@dataclasses.dataclass(frozen=True)
class Kind:
    """Rows of numbers: how many columns, rows from places, exact values, what orders the parts."""

    columns: int
    rows: Callable[[np.ndarray], np.ndarray]
    truth: truths.Truth
    sorted_by: tuple[int, str]


@dataclasses.dataclass(frozen=True)
class Family:
    """Quantities that come from the same rows."""

    name: str
    kind: Kind
    program: Callable[[jax.Array], dict[str, jax.Array]]
    quantities: dict[str, str]  # and beside what their error is taken: themselves, or another
    moved: tuple[int, ...] = ()  # columns by which derivatives are compared


JOINT = Kind(points.JOINT_COLUMNS, points.joints, truths.joint, (0, "D"))
MECHANISM = Kind(points.MECHANISM_COLUMNS, points.mechanisms, truths.mechanism, (7, "K_n"))
AREA = Kind(points.ROUGHNESS_COLUMNS, points.areas, truths.roughness, (0, "D"))
CONTACT = {"a_l": "a_l", "K_n": "K_n", "K_t": "K_t", "Q_e": "load", "plastic_share": "1"}
MODES = {"growth_rate": "modulus", "real": "modulus", "margin": "1"}
HEIGHTS = {"Sq": "Sq", "Sdq": "Sdq"}
FAMILIES = (
    Family("joint", JOINT, programs.state, CONTACT, (0, 1, 7)),
    Family("load of an area", JOINT, programs.load_there_and_back, {"P": "P"}),
    Family("mechanism", MECHANISM, programs.squeal, MODES, (7, 8, 9)),
    Family("equilibrium", MECHANISM, programs.rest, {"x_0": "x_0"}),
    Family("critical friction", MECHANISM, programs.critical_friction, {"mu_c": "mu_c"}, (1, 7, 8)),
    Family("roughness", AREA, programs.roughness, HEIGHTS, (0, 1)),
)


def family_rows(family: Family, count: int, exact: int, gradients: int) -> list[Result]:
    """A row for each quantity of the family: both precisions side by side."""
    kind = family.kind
    x = kind.rows(points.places(np.random.default_rng(3), count, kind.columns))
    x = x[np.argsort(x[:, kind.sorted_by[0]], kind="stable")]
    chosen = np.linspace(0, count - 1, exact).astype(int)
    rows: dict[str, Result] = {n: {"family": family.name, "quantity": n} for n in family.quantities}
    double: dict[str, np.ndarray] = {}  # forward derivatives
    for inputs in (x, points.single(x)):
        bits = f"float{8 * inputs.itemsize}"
        value, forward, _ = programs.of_rows(family.program)
        found, by_forward = value(inputs), forward(inputs)
        if not double:
            double = {name: np.asarray(by_forward[name]) for name in rows}
            timed = times(value, inputs, kind)
        sampled = tqdm(inputs[chosen].astype(float).tolist(), desc=f"{family.name}, {bits}")
        truth = [kind.truth(*point) for point in sampled]
        for name, beside in family.quantities.items():
            # Alone: an infinite derivative must not spoil those of the other quantities.
            alone = jax.jacrev(lambda x, name=name: family.program(x)[name])
            reverse = np.asarray(jax.jit(jax.vmap(alone))(inputs))
            columns = x[chosen].reshape(exact, *[1] * (double[name].ndim - 2), -1)
            off = errors(
                np.asarray(found[name])[chosen],
                [row[name] for row in truth],
                [scale(row, beside) for row in truth],
                double[name][chosen] * columns,
                float(jnp.finfo(inputs.dtype).eps),
            )
            worst, beside_rounding = np.nanmax(off, axis=0).tolist()
            by_mode = np.asarray(by_forward[name]), reverse
            rows[name] |= timed
            rows[name][bits] = {
                "points": count,
                "exact_points": exact,
                "worst": worst,
                "worst_beside_rounding": beside_rounding,
                "gradient": gradient_error(family, name, inputs, reverse, gradients),
            } | not_finite(found[name], by_mode, double[name])
    return list(rows.values())


def scale(row: Result, beside: str) -> Any:
    """What an error is taken beside, from the truth of a row."""
    if beside == "1":
        return 1.0
    return max(map(abs, row[beside])) if isinstance(row[beside], list) else abs(row[beside])


def errors(found, truth, scales, moved, eps) -> list[tuple[float, float]]:
    """Errors beside the scale, and beside what rounding of the inputs alone would make of it.

    NaN where that is not finite; what is not finite itself is counted elsewhere.
    """
    off = []
    for value, exact, size, slope in zip(found, truth, scales, moved, strict=True):
        exact, wide = exact if isinstance(exact, list) else [exact], mpmath.mpf(size or 1)
        if not mpmath.isfinite(wide) or not np.isfinite(value).all():
            continue
        pairs = zip(np.ravel(value).tolist(), exact, strict=True)
        lost = max(abs(mpmath.mpf(v) - e) / wide for v, e in pairs)
        condition = float(np.abs(slope).reshape(len(exact), -1).sum(axis=1).max())
        rounding = eps * (1 + mpmath.mpf(condition) / wide)
        off.append((float(lost), float(lost / rounding) if np.isfinite(condition) else np.nan))
    return off


def gradient_error(family, name, inputs, reverse, count) -> float | None:
    """Worst error of the derivative by ln x, beside the largest compared or the value's scale."""
    if not family.moved or reverse.ndim != 2 or name in ("Q_e", "plastic_share"):
        return None
    worst, moved = 0.0, list(family.moved)
    for i in np.linspace(0, len(inputs) - 1, count).astype(int):
        row = inputs[i].astype(float)
        truth = truths.slopes(family.kind.truth, name, row.tolist(), family.moved)
        weights, truth = np.abs(row[moved]), np.array(truth, float)
        found = reverse[i].astype(float)[moved]
        size = float(scale(family.kind.truth(*row.tolist()), family.quantities[name]))
        size = max(np.abs(truth * weights).max(), size)
        if size > 0 and np.isfinite(size) and np.isfinite(found).all():
            worst = max(worst, float((np.abs(found - truth) * weights).max() / size))
    return worst


def not_finite(value, by_mode, double) -> dict[str, int]:
    """How many points have one in the value, in a derivative; and of these how many must."""

    def rows(bad):
        return int(bad.reshape(len(bad), -1).any(axis=1).sum())

    bad = ~np.isfinite(by_mode).all(axis=0)
    return {
        "not_finite": rows(~np.isfinite(np.asarray(value))),
        "not_finite_gradient": rows(bad),
        "beyond_range": rows(bad & ~(np.abs(double) < BEYOND)),
    }


def times(program, inputs: np.ndarray, kind: Kind) -> Result:
    """Time of a point, and the slowest tenth of the points in order of one column."""
    size = len(inputs) // PARTS
    chunks = [jnp.asarray(inputs[i * size : (i + 1) * size]) for i in range(PARTS)]
    jax.block_until_ready(program(chunks[0]))
    taken = [[seconds(program, chunk)[0] / size for chunk in chunks] for _ in range(REPEATS)]
    ratios = np.median(taken / np.median(taken, axis=1, keepdims=True), axis=0)
    slowest, (column, label) = int(ratios.argmax()), kind.sorted_by
    ends = inputs[slowest * size, column], inputs[(slowest + 1) * size - 1, column]
    return {
        "seconds": float(np.median(taken)),
        "slowest": f"{label} from {ends[0]:.7g} to {ends[1]:.7g}",
        "slowest_ratio": float(ratios[slowest]),
    }


# The corners that were asked for

BRAKE = {"D": 2.4, "G": 1.342e-10, "gamma": 1.5, "E": 1.154e11, "nu": 0.3, "sigma_y": 3.55e8}
BRAKE |= {"H": 9.94e8, "P": 1907.3, "mu_s": 0.4, "mu_m": 0.25}
MASS = {"m": 1.0} | OSCILLATOR | {"V": V, "K_n": K_N, "K_t": KAPPA * K_N}
MASS |= {"mu_s": MU_S, "mu_m": MU_M, "v_m": V_M}
# (omega_2^2 + K_n) - (omega_1^2 + K_t) = 2 mu sqrt(K_n K_t) in whole numbers.
COALESCED = {"omega_1": 12500.0, "omega_2": 7500.0, "K_n": 4e8, "K_t": 1e8, "xi_1": 0.0}
COALESCED |= {"xi_2": 0.0, "mu_s": 0.5, "mu_m": 0.5}
CORNERS: list[dict[str, float]] = [
    *({"D": D} for D in (2 + points.EDGE, 3 - points.EDGE, 2.5)),
    *({"G": G} for G in (1e-18, 1e-4)),
    *({"P": P} for P in (1e-6, 1e12)),
    {"D": 2 + points.EDGE, "sigma_y": 1e11, "H": 1e11, "gamma": 1.001},
    *({"K_n": K, "K_t": K / 2} for K in (1e3, 1e15)),
    *({"xi_1": x, "xi_2": y} for x, y in ((0.0, 0.0), (1e3, 1e3), (1e-8, 1e3))),
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
        program = programs.growth_and_margin if mechanism else programs.state
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


def measure(count: int, exact: int, gradients: int, few: tuple[str, ...] = ()) -> Result:
    """Rows of every family, single call, corner and motion; or of a few of them alone."""
    families = [family for family in FAMILIES if not few or family.name in few]
    single = {name: of for name, of in QUANTITIES.items() if not few or name in few}
    moving = {"cycles": cycles, "layers": layers, "grazing": grazing}
    return {
        "rows": [row for f in families for row in family_rows(f, count, exact, gradients)],
        "others": [quantity_row(name, *of) for name, of in single.items()],
        "corners": [] if few else [row for row, _, _ in corner_rows()],
        "motion": None if few else {name: measured() for name, measured in moving.items()},
    }


# The page


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


def counts(found: Result) -> str:
    """Values and gradients that are not finite."""
    must = f" ({found['beyond_range']} beyond the range)" if found["beyond_range"] else ""
    return f"{found['not_finite']}, {found['not_finite_gradient']}{must}"


def ranges(where: dict[str, Any]) -> str:
    """The ranges of a family, as one line."""
    return "; ".join(f"{name} {span}" for name, span in where.items())


def corner_blocks(rows: list[Result]) -> list[str]:
    return [
        "## Corners",
        table(
            "corner | quantity | value | error, float64 | float32",
            rows,
            "{corner} | {quantity} | {value:.6g} | {float64:.1e} | {float32:.1e}",
        ),
        """The other numbers are those of the reference brake. Errors of K_n [N/m] are relative, 0
        where fully plastic; those of the growth rate [1/s] are beside the largest modulus of an
        eigenvalue. float32 is compared at inputs rounded to float32, which separate exactly
        coalescing eigenvalues by the root of its rounding unless float32 holds all inputs
        exactly.""",
    ]


def motion_blocks(found: Result) -> list[str]:
    grazing = [
        "Grazing: direction 1 of the reference scene sticks on one side only of this K_n, found to"
        " 1e-9.",
        table(
            "K_n [N/m] | share of sticking | period [s] | estimated error",
            found["grazing"],
            "{K_n:.10g} | {stick:.1e} | {period:.12g} | {error:.1e}",
        ),
    ]
    return [
        "## Limit cycles and simulation",
        table(
            "scene | result | growth / omega | returns | period [s] | estimated error"
            " | trivial multiplier - 1 | time [ms] | non-finite",
            (row | {"why": row["non_finite"] or "no"} for row in found["cycles"]),
            "{name} | {result} | {growth_by_omega:.1e} | {turns} | {period:.6g} | {error:.1e}"
            " | {trivial_multiplier_off:.1e} | {seconds!m:.3g} | {why}",
        ),
        *(grazing if found["grazing"] else []),
        table(
            "eps [m/s] | result | steps | time [s] | off the exact cycle, scaled",
            found["layers"],
            "{eps:.0e} | {result} | {steps} | {seconds:.3g} | {off_the_exact_cycle:.1e}",
        ),
    ]


def page(result: Result) -> list[str]:
    rows, bits = result["rows"], ("float64", "float32")
    finite = [row for row in rows if row["quantity"] != "mu_c"]
    signs = {"not_finite": 1, "not_finite_gradient": 1, "beyond_range": -1}
    bad = [sum(n * row[b][key] for row in finite for key, n in signs.items()) for b in bits]

    def shown(row):
        both = {b: row[b] | {"counts": counts(row[b])} for b in bits}
        return row | both | {"name": name_of(row)}

    return [
        f"""Use float64 wherever a range is wide. Of {rows[0]["float64"]["points"]} points of each
        family, {bad[0]} values or gradients are not finite where they should be, and {bad[1]} in
        float32, which is for ordinary brakes.""",
        table(
            "quantity | points | worst error, float64: itself, beside rounding"
            " | worst error, float32: the same | worst of the gradient: float64; float32"
            " | not finite, float64: value, gradient | not finite, float32: value, gradient"
            " | slowest tenth of the points, beside the median | time a point [ns]",
            map(shown, rows),
            "{name} | {float64.points}, {float64.exact_points} of them exactly"
            " | {float64.worst:.1e}, {float64.worst_beside_rounding:.2g}"
            " | {float32.worst:.1e}, {float32.worst_beside_rounding:.2g}"
            " | {float64.gradient:.1e}; {float32.gradient:.1e}"
            " | {float64.counts} | {float32.counts}"
            " | {slowest}: {slowest_ratio:.2f} | {seconds!n:.3g}",
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
        f"""Joints: D to 2 + {points.EDGE:g} and 3 - {points.EDGE:g}; {ranges(points.JOINT)}; nu 0
        to 0.5; SI units. Mechanisms: {ranges(points.MECHANISM)}; the force of both signs.
        Roughness: the same D, G and gamma; {ranges(points.AREA)}. In logarithms, D in logarithms to
        both ends; a part of the points has few or most of its inputs at the ends or in the middle
        of their range. Every program runs the same operations for all its points; the points are
        timed in ten parts by D or K_n.""",
        *(corner_blocks(result["corners"]) if result["corners"] else []),
        "## One call at a time",
        table(
            "quantity | ranges | cases | worst error | not finite"
            " | slowest case, beside the median | time: median [ms]",
            result["others"],
            "{quantity} | {ranges} | {points} | {worst:.1e} | {not_finite}"
            " | {slowest}: {slowest_ratio:.2g} | {seconds!m:.3g}",
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


LINES = {"float64": ("o", "tab:blue", 2.0**-52), "float32": ("s", "tab:orange", 2.0**-23)}


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
