"""Reduction of brakes of some 4,700 degrees of freedom: its time, memory and error; then points.

The industrial brake of N. Graebner, V. Mehrmann, S. Quraishi, C. Schroeder and U. von Wagner, Z.
Angew. Math. Mech. 96 (2016) 1388, where the variable FRACTALJAX_BRAKE names the folder of its
matrices, and the disc between two pads of notebooks/brakes.py. Ranges are drawn at random within
wide ones, and points within them. Beside: SciPy's `eigs` by shift-invert at every point, and the
article's own times.
"""

import functools
import importlib.util
import os
import resource
import statistics
import sys
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

import fractaljax as fj

from .page import columns, draw, png, subplots, table, verdict
from .timing import ended, seconds, started

TITLE = "Reduction of finite-element brakes"
PACKAGES = ("jaxlib", "numpy", "scipy", "scikit-fem")
FULL = {"angular": 36, "draws": 2, "checked": 4, "side": (12, 10, 10), "repeats": 7, "tol": 1e-8}
QUICK = {"angular": 12, "draws": 1, "checked": 1, "side": (3, 2, 2), "repeats": 2, "tol": 1e-8}
VARIABLE = "FRACTALJAX_BRAKE"
INDUSTRIAL, OWN = "industrial brake", "disc between two pads"
# Of the industrial brake: s, GB, ms a point with gradients, relative error.
WANTED = {"reduce_s": 60.0, "peak_GB": 2.0, "gradient_ms": 15.0, "error": 1e-8}
ARTICLE = {"reduce_s": 10.5, "point_s": 0.016, "full_s": 7.1, "vectors": 40}
NARROWEST = 0.2  # of the wide range of a parameter, what is drawn of it
ALONE = {"OPENBLAS_NUM_THREADS": "1"}  # threads of small problems wait for one another
STEP = 1e-4  # of a parameter, for the derivative of the matrices
Terms = list[tuple[Callable[[Mapping[str, Any]], Any], Any]]  # (coefficient, matrix)
Result = dict[str, Any]


class Model(NamedTuple):
    """A large model: terms of M, C and K, its parameters and the widest ranges of them."""

    terms: dict[str, Terms]
    parameters: dict[str, float]
    over: dict[str, tuple[float, float]]
    band: tuple[float, float]  # [rad/s]

    def matrices(self, p: Mapping[str, float]) -> list[Any]:
        """M, C and K, sparse, without the package."""
        return [sum(float(c(p)) * X for c, X in self.terms[name]) for name in "MCK"]

    def drawn(self, seed: int) -> "Model":
        """The same over ranges within these, drawn at random, and in their middle."""
        rng, over = np.random.default_rng(seed), {}
        for name, (low, high) in self.over.items():
            share = rng.uniform(NARROWEST, 1.0)
            start = low + rng.uniform(0.0, 1 - share) * (high - low)
            over[name] = float(start), float(start + share * (high - low))
        middle = {name: sum(ends) / 2 for name, ends in over.items()}
        return self._replace(over=over, parameters=self.parameters | middle)

    def points(self, count: int, seed: int) -> list[dict[str, float]]:
        """The corner of all high ends, and places inside the ranges, drawn at random."""
        low, high = np.array(list(self.over.values())).T
        drawn = np.random.default_rng(seed).uniform(size=(count, len(low)))
        drawn[0] = 1.0
        return [dict(zip(self.over, low * (1 - u) + high * u, strict=True)) for u in drawn]


def industrial(folder: str) -> Model:
    """The article's brake; `mu` scales all its friction, in stiffness and damping."""
    from scipy.sparse import load_npz

    X = {path.stem: load_npz(path) for path in Path(folder).glob("*.npz")}
    return Model(
        {
            "M": [(lambda p: 1.0, X["BMLL"])],
            "C": [
                (lambda p: 1.0, X["BDLL"]),
                (lambda p: p["Omega"], X["BYLL"]),
                (lambda p: p["mu"] / p["Omega"] - 1, X["BDIWLL"]),
                (lambda p: 1 / (2 * np.pi * 1600), X["BHLL"]),
            ],
            "K": [
                (lambda p: 1.0, X["BKLL"]),
                (lambda p: p["mu"] * p["kr"], X["BKQLL"]),
                (lambda p: p["Omega"] ** 2 - 1, X["BWLL"]),
            ],
        },
        {"Omega": 4 * np.pi, "kr": 1.0, "mu": 1.0},
        {"Omega": (2 * np.pi, 40 * np.pi), "kr": (0.1, 1.2), "mu": (0.8, 1.2)},
        (0.0, 20000.0),
    )


def disc(angular: int) -> Model:
    """The repository's own: springs and friction between disc and pads, `kr` scaling the latter."""
    from scipy.sparse import diags_array, lil_array

    place = Path(__file__).parents[1] / "notebooks" / "brakes.py"
    spec: Any = importlib.util.spec_from_file_location("brakes", place)
    brakes = importlib.util.module_from_spec(spec)
    sys.modules["brakes"] = brakes  # its dataclasses look for their module
    spec.loader.exec_module(brakes)
    made = brakes.disc_between_pads(angular)
    T, N = (lil_array((len(made.pairs), len(made.names))) for _ in range(2))
    for i, pair in enumerate(made.pairs):
        for rows, direction in zip((T, N), pair, strict=True):
            rows[i, list(direction)] = list(direction.values())
    T, N, X = T.tocsr(), N.tocsr(), made.matrices
    k_n = diags_array(3e8 * made.shares)
    k_t = 0.5 * k_n
    return Model(
        {
            "M": [(lambda p: 1.0, X["M"])],
            "C": [
                (lambda p: 1.0, fj.rayleigh_damping(X["M"], X["K"], 4.0, 1e-8)),
                (lambda p: p["Omega"], X["G"]),
            ],
            "K": [
                (lambda p: 1.0, X["K"] + N.T @ k_n @ N + T.T @ k_t @ T),
                (lambda p: p["mu"] * p["kr"], N.T @ k_t @ T - T.T @ k_n @ N),
                (lambda p: p["Omega"] ** 2, X["K_convective"] + X["K_centrifugal"]),
            ],
        },
        {"Omega": 10.0, "kr": 1.0, "mu": 0.4},
        {"Omega": (5.0, 20.0), "kr": (0.9, 1.1), "mu": (0.3, 0.5)},
        (2 * np.pi * 3000, 2 * np.pi * 5000),
    )


def by_scipy(model: Model, p: Mapping[str, float], count: int = 12) -> np.ndarray:
    """Eigenvalues in the band near four shifts, by `eigs` of the linear problem of twice the size.

    Not all of them: to find all, the number of shifts has to be tried.
    """
    from scipy.sparse import block_array, csc_array, eye_array
    from scipy.sparse.linalg import eigs

    (M, C, K), (low, high) = model.matrices(p), model.band
    n, unit, eig = M.shape[0], high, functools.partial(eigs, k=count, which="LM")
    one = eye_array(n)
    A = csc_array(block_array([[None, unit * one], [-K / unit, -C]]))
    B = csc_array(block_array([[one, None], [None, M]]))
    found: list[Any] = []
    for share in (0.125, 0.375, 0.625, 0.875):
        shift = 1j * (low + share * (high - low))
        found.append(eig(A.astype(complex), M=B, sigma=shift, return_eigenvectors=False))
    s: Any = np.concatenate(found)
    inside = (s.imag > low) & (s.imag < high) & (np.abs(s.real) < 0.3 * np.abs(s))
    return s[inside]


def refined(model: Model, p: Mapping[str, float], s: complex) -> tuple[complex, dict[str, complex]]:
    """An eigenvalue of the full matrices, and its derivatives by each parameter.

    Two-sided Rayleigh quotient iteration, and ds = -y dQ x/(y Q' x) with dQ a central difference.
    """
    from scipy.sparse import csc_array
    from scipy.sparse.linalg import splu

    M, C, K = model.matrices(p)
    x, y = np.random.default_rng(0).standard_normal((2, M.shape[0])) + 0j
    for _ in range(4):
        factors, slope = splu(csc_array(s**2 * M + s * C + K)), 2 * s * M + C
        x, y = factors.solve(slope @ x), factors.solve(slope.T @ y, trans="T")
        x, y = x / np.linalg.norm(x), y / np.linalg.norm(y)
        s = s - y @ ((s**2 * M + s * C + K) @ x) / (y @ (slope @ x))
    by = {}
    for name in model.over:
        h = STEP * p[name]
        ends = []
        for sign in (1, -1):
            M, C, K = model.matrices({**p, name: p[name] + sign * h})
            ends.append(y @ ((s**2 * M + s * C + K) @ x))
        by[name] = -(ends[0] - ends[1]) / (2 * h) / (y @ (slope @ x))
    return s, by


def peak() -> float:
    """The most memory that this process has held [GB]."""
    unit = 1 if sys.platform == "darwin" else 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit / 1e9


def in_this_process(
    name: str, seed: int, angular: int, checked: int, side: list[int], repeats: int, tol: float
) -> Result:
    """All numbers of one model over ranges drawn at random."""
    widest = industrial(os.environ[VARIABLE]) if name == INDUSTRIAL else disc(angular)
    model = widest.drawn(seed)
    M, C, K = (model.terms[key] for key in "MCK")
    full = fj.ParametricStructure(M, C, K, parameters=model.parameters)
    before = peak()
    start, cpu = time.perf_counter(), time.process_time()
    reduced = fj.reduce(full, model.over, model.band, tol)
    made = {"reduce_s": time.perf_counter() - start, "reduce_cpu_s": time.process_time() - cpu}
    made |= {"peak_GB": peak(), "before_GB": before}
    names = list(model.over)

    def growth(values):
        return fj.growth_rate(reduced.replace(**dict(zip(names, values, strict=True))))

    points = model.points(max(checked, repeats), seed)
    places = [np.array([p[each] for each in names]) for p in points]
    timed = {}
    for key, function in {"value": growth, "gradient": jax.value_and_grad(growth)}.items():
        program = jax.jit(function)
        timed[f"{key}_compile_s"] = seconds(program, places[0])[0]
        each = [seconds(program, place)[0] for place in places[:repeats]]
        timed[f"{key}_ms"] = 1e3 * statistics.median(each)
    fj.stability(reduced)  # compiled once, before it is timed
    rows = [
        one_point(model, reduced, p, jax.jit(jax.value_and_grad(growth))) for p in points[:checked]
    ]
    axes: Any = {
        key: np.linspace(*ends, count)
        for (key, ends), count in zip(model.over.items(), side, strict=True)
    }
    sweep_s, swept = seconds(
        lambda: np.asarray(fj.sweep(fj.growth_rate, reduced, progress=False, **axes).values)
    )
    return {
        "name": name,
        "seed": seed,
        "n": full.n,
        "r": reduced.n,
        "band": model.band,
        "over": model.over,
        "points_with_vectors": len(reduced.reduction.points),
        "estimate": reduced.reduction.error,
        **made,
        **timed,
        "rows": rows,
        "sweep": {
            "points": int(swept.size),
            "seconds": sweep_s,
            "squeal": float((swept > 0).mean()),
        },
    }


def one_point(model: Model, reduced: Any, p: Mapping[str, float], program: Callable) -> Result:
    """Errors and times at one point of the parameters."""
    scipy_s, wanted = seconds(by_scipy, model, p)
    own_s, modes = seconds(lambda: fj.stability(reduced.replace(**p)))
    s: Any = np.asarray(modes.eigenvalues)[np.asarray(modes.counted)]
    off = np.abs(wanted[:, None] - s[None]).min(axis=1) / np.abs(wanted)
    growth, by = program(np.array([p[name] for name in model.over]))
    critical = s[np.argmax(np.where(s.imag > 0, s.real, -np.inf))]
    exact, slopes = refined(model, p, critical)
    # A derivative counts by what its parameter, changed by its own size, does to |s|.
    slope = [
        abs(float(found) - slopes[name].real) * abs(p[name]) / abs(exact)
        for found, name in zip(by, model.over, strict=True)
    ]
    return {
        "point": dict(p),
        "compared": len(wanted),
        "error": float(off.max()),
        "growth": float(growth),
        "growth_error": abs(float(growth) - exact.real) / abs(exact),
        "slope_error": max(slope),
        "scipy_s": scipy_s,
        "stability_s": own_s,
    }


def measure(
    angular: int, draws: int, checked: int, side: tuple[int, ...], repeats: int, tol: float
) -> Result:
    """Each model in a Python of its own, so that its memory is its own, with one thread of BLAS."""
    arguments = {"angular": angular, "checked": checked, "side": side, "repeats": repeats}
    names = [INDUSTRIAL] * bool(os.environ.get(VARIABLE)) + [OWN]
    models = [
        ended(started(__name__, ALONE, name=name, seed=seed, tol=tol, **arguments))
        for name in names
        for seed in range(draws)
    ]
    first = [
        model | {"error": max(row["error"] for row in model["rows"])}
        for model in models
        if model["name"] == names[0]
    ]
    words = {
        "reduce_s": "reduction [s]",
        "peak_GB": "largest memory of the process [GB]",
        "gradient_ms": "growth rate with its gradient, a point [ms]",
        "error": "largest error of an eigenvalue beside SciPy's, of |s|",
    }
    heads = [
        {
            "what": f"{names[0]}: {what}",
            "value": max(model[key] for model in first),
            "wanted": [0, WANTED[key]],
        }
        for key, what in words.items()
    ]
    return {"headline": heads, "tol": tol, "repeats": repeats, "draws": draws, "models": models}


def page(result: Result) -> list[str]:
    models = result["models"]
    first = models[0]
    heads = [f"{head['what'].split(': ')[1]} {head['value']:.2g} ({verdict(head)})"
             for head in result["headline"]]  # fmt: skip
    blocks = [
        f"""Reduce once over the ranges that count, then ask: the {first["name"]} of {first["n"]}
        degrees of freedom becomes {first["r"]} in {first["reduce_s"]:.3g} s, and a growth rate with
        its gradient takes {first["gradient_ms"]:.3g} ms.""",
        f"""Of {result["draws"]} draws of the ranges the worst: {"; ".join(heads)}. The article
        reduces the industrial brake to {ARTICLE["vectors"]} vectors in {ARTICLE["reduce_s"]} s,
        with {ARTICLE["point_s"]} s a speed after that and {ARTICLE["full_s"]} s in full, on its own
        machine, over the speed alone, and without gradients or a bound on the error.""",
    ]
    if first["name"] != INDUSTRIAL:
        blocks.append(f"Industrial brake: not run: no matrices in the folder {VARIABLE}.")
    rows = [model | {"sweep_s": model["sweep"]["seconds"], "count": model["sweep"]["points"]}
            for model in models]  # fmt: skip
    blocks += [
        table(
            "model | ranges | degrees of freedom | reduced to | points with eigenvectors |"
            " reduction [s] | memory [GB], before | estimated error | growth rate [ms] |"
            " with gradient [ms] | compile [s] | one sweep: points | [s]",
            rows,
            "{name} | {seed} | {n} | {r} | {points_with_vectors} | {reduce_s:.3g} | {peak_GB:.2f},"
            " {before_GB:.2f} | {estimate:.1e} | {value_ms:.3g} | {gradient_ms:.3g} |"
            " {gradient_compile_s:.2g} | {count} | {sweep_s:.3g}",
        )
    ]
    for model in models:
        ranges = ", ".join(
            f"{name} {low:.4g} to {high:.4g}" for name, (low, high) in model["over"].items()
        )
        blocks += [
            f"""The {model["name"]}, ranges {model["seed"]}: {model["band"][0]:.5g} to
            {model["band"][1]:.5g} rad/s, over {ranges}; {model["sweep"]["squeal"]:.0%} of the
            points of the sweep squeal. At their high ends, and at points drawn at random:""",
            table(
                "point | compared | eigenvalues | growth rate | its gradient | growth rate [1/s] |"
                " SciPy eigs [s] | all modes, reduced [s]",
                [
                    row | {"at": ", ".join(f"{x:.4g}" for x in row["point"].values())}
                    for row in model["rows"]
                ],
                "{at} | {compared} | {error:.1e} | {growth_error:.1e} | {slope_error:.1e} |"
                " {growth:.4g} | {scipy_s:.2f} | {stability_s:.3g}",
            ),
        ]
    return [
        *blocks,
        f"""Tolerance {result["tol"]:.0e} of |s|. Ranges are drawn at random, by seed, within wide
        ones; each holds a fifth of them or more. Errors are of |s|: of eigenvalues against SciPy's
        `eigs`, shift-invert of the linear problem of twice the size at four shifts, 12 eigenvalues
        each; of the growth rate and its gradient (times each parameter) against a two-sided
        Rayleigh quotient iteration with the full matrices. Where SciPy's ARPACK is less exact than
        the reduction, the error is its own. Each model has a Python of its own, whose largest
        memory counts matrices, JAX and what reduction takes, and one thread of OpenBLAS
        (OPENBLAS_NUM_THREADS=1); times of points are medians of {result["repeats"]}.""",
    ]


def picture(result: Result) -> bytes:
    """Error over the time of a point."""
    pairs = -(-len(result["models"]) // 2)
    figure, panels = subplots(pairs, 2, figsize=(8.3, 4 * pairs), squeeze=False)
    for ax, model in zip(panels.flat, result["models"], strict=False):
        rows = model["rows"]
        lines = [
            (*columns(rows, "stability_s", "error"), "C0o", "reduced, all modes"),
            ([model["gradient_ms"] / 1e3] * len(rows), *columns(rows, "slope_error"), "C1s",
             "reduced, gradient"),
        ]  # fmt: skip
        for row in rows:
            ax.axvline(row["scipy_s"], color="0.6", ls="--")
        ax.axhline(result["tol"], color="k", lw=0.8)
        title = f"{model['name']}, ranges {model['seed']}"
        draw(ax, lines, "time of a point [s]; dashed: SciPy", "error, of |s| [-]", title)
    return png(figure)
