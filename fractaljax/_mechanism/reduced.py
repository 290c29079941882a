"""Reduced structures: few degrees of freedom in place of many."""

from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import ArrayLike

from .._base.parts import Numbers, brief
from .mesh import Mesh
from .structure import ParametricStructure


class CoarseSpace:
    """A subspace of a reduced space with approximate modes; compared by identity."""

    def __init__(self, V: np.ndarray, W: np.ndarray, tol: float):
        self.V = V  # (r, k): q = V p
        self.W = W  # (r, k)
        self.tol = tol  # each eigenvalue s is within tol |s| of one of the reduced structure


class Reduction:
    """The basis and the accuracy of a reduced structure; compared by identity."""

    def __init__(
        self,
        V: np.ndarray,
        W: np.ndarray,
        names: tuple[str, ...] | None,
        over: dict[str, tuple[float, float]],
        band: tuple[float, float],
        tol: float,
        friction_slope: bool,
        residuals: np.ndarray,
        error: float,
        points: Sequence[dict[str, float]] = (),
        touched: np.ndarray | None = None,
        coarse: CoarseSpace | None = None,
    ):
        self.V = V  # (n, r): x = V q
        self.W = W  # (n, r)
        self.names = names  # of the n degrees of freedom
        self.over = over
        self.band = band  # [rad/s]
        self.tol = tol
        self.friction_slope = friction_slope
        self.residuals = residuals  # L^T Q^-1 R of the residuals of all terms, see `Space`
        self.points = list(points)  # parameters at which eigenvectors were computed
        self.touched = touched  # (m, n), `Structure._touched` of the large structure
        self.coarse = coarse  # None if it would save no time
        self.error = error  # largest at candidates and fresh points, relative to |s|


class ReducedStructure(ParametricStructure):
    """A structure of few degrees of freedom q (r,) with x = V q, as `reduce` returns it.

    It has the parameters, the joints and the mesh of the large structure and can be used like any
    structure. Only eigenvalues in `band` are those of the large structure, and only they count in
    its stability. `replace` of a matrix gives a plain structure.

    **Arguments:**

    - `M`, `C`, `K`, `joints`, `parameters`, `F`, `K_loss`: as in `ParametricStructure`, of the r
      degrees of freedom.
    - `reduction`: the basis, the band and the accuracy.
    - `mesh`: that of the large structure, by default none.
    """

    reduction: Reduction = eqx.field(static=True)  # the basis and the accuracy

    def __init__(
        self,
        M,
        C,
        K,
        joints,
        parameters,
        F,
        reduction: Reduction,
        mesh: Mesh | None = None,
        K_loss=None,
    ):
        self.reduction = reduction
        super().__init__(M, C, K, joints, parameters, F, K_loss=K_loss, mesh=mesh)

    @property
    def band(self) -> tuple[float, float]:
        """The range of |Im s| [rad/s] in which eigenvalues are those of the large structure."""
        return self.reduction.band

    @property
    def coarse(self) -> CoarseSpace | None:
        """A subspace with approximate modes, or None if it would save no time."""
        return self.reduction.coarse

    def _full_n(self, n: int) -> int:
        return len(self.reduction.V)

    def _matching_mesh(self) -> None:
        return None

    def _touched(self) -> np.ndarray | None:
        return self.reduction.touched

    def full(self, q: ArrayLike) -> Numbers:
        """Displacements or velocities (..., n) of all degrees of freedom from the reduced ones.

        **Arguments:**

        - `q`: (..., r), real or, as a mode shape, complex; a state (..., 2r) gives a state (...,
          2n).

        **Raises:** `ValueError` for another size.
        """
        q, V = jnp.asarray(q), jnp.asarray(self.reduction.V)
        if q.ndim == 0 or q.shape[-1] not in (self.n, 2 * self.n):
            raise ValueError(f"q must have {self.n} or {2 * self.n} numbers, got shape {q.shape}")
        halves = q.reshape(*q.shape[:-1], -1, self.n)
        return (halves @ V.T.astype(halves.dtype)).reshape(*q.shape[:-1], -1)

    @classmethod
    def from_file(cls, arguments: dict[str, Any]) -> "ReducedStructure":
        """The reduced structure of a file, from the arguments that `read_structure` returns."""
        about: dict[str, Any] = dict(arguments.pop("reduced"))
        keys = ("V", "W", "residuals", "over", "band", "tol", "friction_slope", "error")
        missing = [key for key in keys if about.get(key) is None]
        if missing:
            raise ValueError(f"[reduced] or its file of matrices lacks {', '.join(missing)}")
        names = about.pop("names", None)
        about["over"] = {name: tuple(ends) for name, ends in about["over"].items()}
        about["band"] = tuple(about["band"])
        about["residuals"] = about["residuals"][0] + 1j * about["residuals"][1]
        about["names"] = None if names is None else tuple(names)
        coarse: Any = [about.pop(f"coarse_{key}", None) for key in ("V", "W", "tol")]
        about["coarse"] = None if any(x is None for x in coarse) else CoarseSpace(*coarse)
        try:
            reduction = Reduction(**about)
        except TypeError:
            raise ValueError(f"[reduced] has an unknown key among {brief(list(about))}") from None
        rest = {key: x for key, x in arguments.items() if key not in ("names", "notes")}
        return cls(**{"parameters": {}, **rest}, reduction=reduction)

    def _more_tables(self):
        reduction = self.reduction
        coarse = {} if reduction.coarse is None else {"coarse_tol": reduction.coarse.tol}
        return {
            "reduced": {
                **coarse,
                "band": reduction.band,
                "tol": reduction.tol,
                "error": reduction.error,
                "friction_slope": reduction.friction_slope,
                "names": reduction.names,
                "points": reduction.points,
                "over": reduction.over,
            }
        }

    def _more_arrays(self):
        reduction = self.reduction
        more = {} if reduction.touched is None else {"touched": reduction.touched}
        if reduction.coarse is not None:
            more |= {"coarse_V": reduction.coarse.V, "coarse_W": reduction.coarse.W}
        return {
            **more,
            "V": reduction.V,
            "W": reduction.W,
            "residuals": np.stack([np.real(reduction.residuals), np.imag(reduction.residuals)]),
        }

    def _shown(self):
        yield f"n={self.n} of {len(self.reduction.V)}"
        yield f"error={self.reduction.error:.2g}"
        yield from (f"{name}={value}" for name, value in self.parameters.items())
        yield from self.joint_names
