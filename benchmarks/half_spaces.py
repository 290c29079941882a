"""The periodic elastic half-space by other programs: pressure and gap under a mean pressure.

Both take heights [m] on a grid of spacing dx [m], the modulus E [Pa] of the pair, the mean pressure
[Pa] and a tolerance over the rms height, and return the pressure [Pa] and the gap [m], which is
that of the surfaces up to a constant.
"""

import importlib
import importlib.util
from collections.abc import Callable
from typing import Any

import numpy as np

_MOST = 20_000  # iterations
Fields = tuple[np.ndarray, np.ndarray]


def tamaas(heights: np.ndarray, dx: float, E: float, mean: float, tolerance: float) -> Fields:
    """Tamaas' method of Polonsky and Keer for pressures (J. Open Source Softw. 5, 2121, 2020)."""
    package: Any = importlib.import_module("tamaas")
    model, heights = _model(package, heights, dx, E)
    kind = package.PolonskyKeerRey.pressure
    solver = package.PolonskyKeerRey(model, heights, tolerance, kind, kind)
    return _solved(model, solver, heights, mean)


def tamaas_saturated(
    heights: np.ndarray, dx: float, E: float, mean: float, tolerance: float, most: float
) -> Fields:
    """Tamaas' method for a surface that yields at the pressure `most` [Pa].

    It takes steps of one unit along the gap, so that it converges in units only in which the
    longest wave gives way by about 1 under a pressure of 1.
    """
    package: Any = importlib.import_module("tamaas")
    unit = max(heights.shape) * dx / np.pi  # m; of pressures it is E
    model, scaled = _model(package, heights / unit, dx / unit, 1.0)
    solver = package.KatoSaturated(model, scaled, tolerance, most / E)
    pressure, gap = _solved(model, solver, scaled, mean / E)
    return pressure * E, gap * unit


def _model(package: Any, heights: np.ndarray, dx: float, E: float) -> tuple[Any, np.ndarray]:
    package.set_log_level(package.LogLevel.error)
    size, shape = [n * dx for n in heights.shape], list(heights.shape)
    model = package.ModelFactory.createModel(package.model_type.basic_2d, size, shape)
    model.E, model.nu = E, 0.0  # E is that of the pair
    return model, np.array(heights)  # it may write there


def _solved(model: Any, solver: Any, heights: np.ndarray, mean: float) -> Fields:
    solver.max_iter = _MOST
    solver.solve(mean)
    return np.array(model.traction), np.array(model.displacement) - heights


def contact_mechanics(
    heights: np.ndarray, dx: float, E: float, mean: float, tolerance: float
) -> Fields:
    """ContactMechanics' method of Polonsky and Keer (contactengineering.github.io)."""
    package: Any = importlib.import_module("ContactMechanics")
    method: Any = importlib.import_module(
        "ContactMechanics.Optimization.ConstrainedConjugateGradients"
    )
    surfaces: Any = importlib.import_module("SurfaceTopography")
    size, point = tuple(n * dx for n in heights.shape), mean * dx**2
    found = method.constrained_conjugate_gradients(
        package.PeriodicFFTElasticHalfSpace(heights.shape, E, physical_sizes=size),
        surfaces.Topography(heights, size, periodic=True),
        external_force=point * heights.size,
        pentol=tolerance * heights.std(),
        forcetol=tolerance * point,
        thermotol=tolerance,
        maxiter=_MOST,
    )
    if not found.success:
        raise RuntimeError(found.message)
    return found.jac / dx**2, found.x - heights


PEERS: dict[str, tuple[str, Callable[..., Fields]]] = {
    "Tamaas": ("tamaas", tamaas),
    "ContactMechanics": ("ContactMechanics", contact_mechanics),
}


def installed() -> dict[str, Callable[..., Fields]]:
    """The peers that there are here."""
    return {
        name: solve for name, (package, solve) in PEERS.items() if importlib.util.find_spec(package)
    }


def residual(pressure: np.ndarray, heights: np.ndarray, dx: float, E: float) -> float:
    """Largest gap in contact or overlap outside it, over the rms height, by NumPy's transform."""
    x, y = (2 * np.pi * np.fft.fftfreq(n, dx) for n in heights.shape)
    q = np.hypot(x[:, None], y)
    compliance = np.divide(2 / E, q, out=np.zeros_like(q), where=q > 0)
    gap = np.real(np.fft.ifft2(compliance * np.fft.fft2(pressure))) - heights
    touches = pressure > 0
    gap -= gap[touches].mean()
    return float(max(np.abs(gap[touches]).max(), -gap.min()) / heights.std())
