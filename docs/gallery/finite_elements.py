"""A finite-element brake whose matrices are published."""

import functools
import os
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from scipy.sparse import csc_array, load_npz
from scipy.sparse.linalg import splu

import fractaljax as fj

from .case import NUMERICAL, Case, CaseResult, Check, Curve, Panel, numerical

_VARIABLE = "FRACTALJAX_BRAKE"
_MATRICES = "BMLL", "BDLL", "BYLL", "BDIWLL", "BHLL", "BKLL", "BKQLL", "BWLL"


def _missing() -> str:
    folder = os.environ.get(_VARIABLE, "")
    if not folder:
        return (
            f"no matrices: set {_VARIABLE} to the folder that holds {', '.join(_MATRICES)} (.npz)"
        )
    lacking = [name for name in _MATRICES if not (Path(folder) / f"{name}.npz").is_file()]
    return (
        f"no {', '.join(lacking)} (.npz) in {folder}, the folder of {_VARIABLE}" if lacking else ""
    )


@functools.cache
def _matrices(folder: str) -> dict:
    return {name: csc_array(load_npz(Path(folder) / f"{name}.npz")) for name in _MATRICES}


def _terms(X, Omega, kr):
    """M, C and K of the article at a speed [rad/s] and a friction factor."""
    C = X["BDLL"] + Omega * X["BYLL"] + (1 / Omega - 1) * X["BDIWLL"]
    C = C + X["BHLL"] / (2 * np.pi * 1600)
    K = X["BKLL"] + kr * X["BKQLL"] + (Omega**2 - 1) * X["BWLL"]
    return X["BMLL"], C, K


def _eigenvalue(X, start, kr=1.0, steps=4):
    """The eigenvalue of the full matrices nearest a number, and its derivative by kr, by SciPy.

    Two-sided Rayleigh quotient iteration.
    """
    M, C, K = _terms(X, 4 * np.pi, kr)
    s, rng = start, np.random.default_rng(0)
    x, y = rng.standard_normal((2, M.shape[0])) + 0j
    for _ in range(steps):
        factors, slope = splu(csc_array(s**2 * M + s * C + K)), 2 * s * M + C
        x, y = factors.solve(slope @ x), factors.solve(slope.T @ y, trans="T")
        x, y = x / np.linalg.norm(x), y / np.linalg.norm(y)
        s = s - y @ ((s**2 * M + s * C + K) @ x) / (y @ (slope @ x))
    return s, -(y @ (X["BKQLL"] @ x)) / (y @ ((2 * s * M + C) @ x))


def _brake() -> CaseResult:
    X = _matrices(os.environ[_VARIABLE])
    damping = [
        (1, X["BDLL"]),
        ("Omega", X["BYLL"]),
        ("1/Omega - 1", X["BDIWLL"]),
        ("1/(2*pi*1600)", X["BHLL"]),
    ]
    stiffness = [(1, X["BKLL"]), ("kr", X["BKQLL"]), ("Omega**2 - 1", X["BWLL"])]
    parameters = {"Omega": 4 * np.pi, "kr": 1.0}
    full = fj.ParametricStructure(X["BMLL"], damping, stiffness, parameters=parameters)
    band = 0.0, 20000.0  # rad/s
    reduced = fj.reduce(full, {"kr": (0.9, 1.1)}, band, progress=False)

    def eigenvalues(kr):
        return fj.stability(reduced.replace(kr=kr)).eigenvalues

    kr = np.linspace(0.9, 1.1, 21)
    spectra = np.asarray(jax.jit(jax.vmap(eigenvalues))(jnp.asarray(kr)))
    checks, curves = [], []
    # The unstable eigenvalues at Omega = 4 pi and kr = 1, to start SciPy's iteration from.
    for start in (74.8 + 17399.6j, 5.47 + 4932.24j, 1e-4 + 5130.605j):
        exact, slope = _eigenvalue(X, start)
        column: Any = np.array([row[np.abs(row - start).argmin()] for row in spectra])
        name, eigenvalue = f"of the mode at {abs(start) / (2e3 * np.pi):.3f} kHz", column[10]
        # The reduction's tolerance is relative to the whole eigenvalue.
        margin = 1e-8 * abs(exact)
        for part, theirs, ours in (
            (f"growth rate {name} [1/s]", exact.real, eigenvalue.real),
            (f"frequency {name} [rad/s]", exact.imag, eigenvalue.imag),
        ):
            checks.append(Check(part, float(theirs), float(ours), margin, NUMERICAL))

        def tracked(kr, start=start):
            s = eigenvalues(kr)
            return s[jnp.argmin(jnp.abs(s - start))]

        ours = complex(jax.jvp(tracked, (1.0,), (1.0,))[1])
        part = f"d(growth rate)/d(friction) {name} [1/s]"
        if abs(slope.real) > margin / 0.1:  # smaller ones are below what the reduction resolves
            checks.append(numerical(part, slope.real, ours.real, 1e-6))
        at = kr[::10]
        theirs = [_eigenvalue(X, column[10 * i], value, 2)[0].real for i, value in enumerate(at)]
        label = f"{abs(start) / (2e3 * np.pi):.3f} kHz"
        curves.append(Curve(at, theirs, f"the full matrices by SciPy, {label}", False))
        curves.append(Curve(kr, column.real, f"fractaljax, {reduced.n} of {full.n}, {label}", True))
    panel = Panel("friction, times that of the model [-]", "growth rate [1/s]", curves)
    return CaseResult(checks, [panel])


CASES = (
    Case(
        "brake",
        "Disc brake of 4669 degrees of freedom",
        "N. Graebner, V. Mehrmann, S. Quraishi, C. Schroeder, U. von Wagner, Z. Angew. Math. Mech. "
        "96, 1388 (2016)",
        "10.1002/zamm.201500217",
        _brake,
        _missing,
    ),
)
