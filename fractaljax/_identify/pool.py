"""Several measurements of one process: the scatter from one surface to the next.

What a measurement i finds is y_i = mu + b_i + e_i: the mean of the process, how the surface differs
from it, of covariance T, and the error of the measurement, of covariance V_i (random effects). T is
that of the restricted likelihood,

    -2 ln L = sum ln |T + V_i| + ln |sum W_i| + sum (y_i - mu)' W_i (y_i - mu),  W_i = (T + V_i)^-1,

with mu = (sum W_i)^-1 sum W_i y_i (Harville, J. Am. Stat. Assoc. 72, 320, 1977,
doi:10.1080/01621459.1977.10480998). The next surface scatters about mu by T + (sum W_i)^-1.
"""

import math
from collections.abc import Sequence

import numpy as np

from .._base.parts import require_kind
from .._surface.measured_spectrum import MeasuredSpectrum
from .._surface.surface import Surface
from .._surface.surface_scatter import SurfaceScatter, fractal_scatter
from .identify import Identification


def pool_surfaces(identifications: Sequence[Identification]) -> SurfaceScatter:
    """The surface of a process and its scatter, from several maps or profiles of it.

    Random effects: the scatter from one surface to the next is what the measurements differ by
    beyond their own errors, by restricted maximum likelihood; a measurement counts in the mean by
    the inverse of that scatter and its own error together. The result is the scatter of the next
    surface, with the error of the mean. From fewer than five measurements it is itself poorly
    known. All are pooled as a `Surface`, by D and ln m(q), if each is one; as a `SelfAffine`, if
    each is one of the two; else, of maps, as a `MeasuredSpectrum` of the waves that all have: the
    mean of their spectra at the same Sq, whose heights scatter by a common factor.

    **Arguments:**

    - `identifications`: two or more, of different places or parts.

    **Returns:** a `SurfaceScatter`, a tolerance of `design` and `squeal_probability`.

    **Raises:** `ValueError` for fewer than two, where a profile is beside what is neither a
    `Surface` nor a `SelfAffine`, and for maps without wavelengths in common.
    """
    every = list(identifications)
    for i, each in enumerate(every):
        require_kind(f"identifications[{i}]", each, Identification)
    if len(every) < 2:
        raise ValueError(f"identifications must be two or more, got {len(every)}")
    if all(isinstance(each.surface, Surface) for each in every):
        return _pool_fractal(every)
    laws = [each.self_affine.fits for each in every]
    if all(laws) and not any(isinstance(each.surface, MeasuredSpectrum) for each in every):
        return _pool_self_affine(every)
    spectra = [each.measured_spectrum for each in every]
    tables = [table for table in spectra if table is not None]
    if len(tables) < len(every):
        i = next(i for i, table in enumerate(spectra) if table is None)
        raise ValueError(
            f"identifications[{i}] is of a profile, and not all are a Surface or a SelfAffine: "
            "leave the profiles out, the spectra of maps are pooled with a scatter of height_factor"
        )
    return _pool_measured(tables, [each.level_error for each in every])


def _pool_measured(tables: list[MeasuredSpectrum], level_errors: list[float]) -> SurfaceScatter:
    low, high = max(table.q[0] for table in tables), min(table.q[-1] for table in tables)
    if not low < high:
        raise ValueError(
            f"identifications must have wavelengths in common: the longest is {2 * math.pi / low:g}"
            f" m of one and the shortest {2 * math.pi / high:g} m of another"
        )
    q = np.array([low, *(x for x in tables[0].q if low < x < high), high])
    log_C, errors = [], []
    for table in tables:
        x, C = np.log(table.q), np.asarray(table.C_table)
        log_C.append(np.interp(np.log(q), x, np.log(C)))
        errors.append(np.interp(np.log(q), x, np.asarray(table.ln_C_error)))
    squares = np.array([float(MeasuredSpectrum(q, np.exp(each)).moments()[0]) for each in log_C])
    variances = np.square(level_errors)[:, None, None]
    mean, between, of_mean = random_effects(np.log(squares)[:, None] / 2, variances)
    shape = np.mean(np.exp(log_C) / squares[:, None], axis=0)
    C, error = math.exp(2 * mean[0]) * shape, np.sqrt(np.sum(np.square(errors), axis=0))
    surface = MeasuredSpectrum(q, C, error / len(tables), height_factor=1.0)
    return SurfaceScatter(surface, ("ln height_factor",), between + of_mean)


def _pool_fractal(every: list[Identification]) -> SurfaceScatter:
    log_q = np.mean([math.log(each.q) for each in every])
    values, errors = [], []
    for each in every:
        # ln m(q) changes by (2D - 6) dln q.
        by = log_q - math.log(each.q)
        values.append([each.D, each.log_height + (2 * each.D - 6) * by])
        to = np.array([[1.0, 0.0], [2 * by, 1.0]])
        V = np.diag([each.D_standard_error**2, each.log_height_error**2])
        errors.append(to @ V @ to.T)
    mean, between, of_mean = random_effects(np.array(values), np.array(errors))
    C = between + of_mean
    by = -C[0, 1] / (2 * C[0, 0])  # to where ln m(q) is uncorrelated with D
    height = mean[1] + (2 * mean[0] - 6) * by
    covariance = np.diag([C[0, 0], C[1, 1] - C[0, 1] ** 2 / C[0, 0]])
    return fractal_scatter(mean[0], height, math.exp(log_q + by), covariance, every[0].gamma)


def _pool_self_affine(every: list[Identification]) -> SurfaceScatter:
    fits = [each.self_affine for each in every]
    free = np.array(
        [True, True, all(fit.has_rolloff for fit in fits), all(fit.lay != 1 for fit in fits)]
    )
    values = np.array([[math.log(f.Sq), f.H, math.log(f.rolloff), math.log(f.lay)] for f in fits])
    errors = np.array([fit.covariance[np.ix_(free, free)] for fit in fits])
    mean = values.mean(axis=0)
    covariance = np.zeros((4, 4))
    mean[free], between, of_mean = random_effects(values[:, free], errors)
    covariance[np.ix_(free, free)] = between + of_mean
    pooled = fits[0].pooled(mean, covariance, bool(free[2]), [f.shortest for f in fits])
    return pooled.surface_scatter


def random_effects(
    values: np.ndarray, errors: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The mean (k,), the covariance (k, k) between measurements, and that of the mean.

    Of `values` (n, k) with error covariances `errors` (n, k, k).
    """
    from scipy.optimize import minimize

    n, k = values.shape
    spread = np.cov(values.T, ddof=1).reshape(k, k)
    scale = np.sqrt(np.diagonal(spread) + np.einsum("ijj->j", errors) / n)
    scale = np.where(scale > 0, scale, 1)
    y, V = values / scale, errors / np.outer(scale, scale)
    rows, columns = np.tril_indices(k)

    def between(x):
        root = np.zeros((k, k))
        root[rows, columns] = x
        return root @ root.T

    def pooled(T):
        W = np.linalg.inv(T + V)
        of_mean = np.linalg.inv(W.sum(axis=0))
        return W, of_mean, of_mean @ np.einsum("ijk,ik->j", W, y)

    def deviance(x):
        T = between(x) + 1e-9 * np.eye(k)
        W, of_mean, mean = pooled(T)
        residuals = y - mean
        logs = np.linalg.slogdet(T + V)[1].sum() - np.linalg.slogdet(of_mean)[1]
        return logs + np.einsum("ij,ijk,ik->", residuals, W, residuals)

    # From the scatter that the errors leave, no less than a hundredth of it.
    excess = spread / np.outer(scale, scale) - V.mean(axis=0)
    size, vectors = np.linalg.eigh(excess)
    root = np.linalg.cholesky(vectors * np.maximum(size, 0.01) @ vectors.T)
    best = minimize(deviance, root[rows, columns], method="BFGS")
    T = between(best.x)
    _, of_mean, mean = pooled(T + 1e-9 * np.eye(k))
    return mean * scale, T * np.outer(scale, scale), of_mean * np.outer(scale, scale)
