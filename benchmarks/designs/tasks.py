"""Three designs of the reference brake, judged by the package and by a plain NumPy loop.

A design is scaled variables u in [0, 1]^v, as `fj.design` scales them. To judge it is to give one
row: the objective, then the requirements of `fj.design`, each at most 0 where it is met.
"""

import dataclasses
import functools
import math
from collections.abc import Callable, Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import fractaljax as fj

from ..growth.loops import brake, plain_numbers

TARGET = -math.pi  # largest growth rate allowed [1/s], the default of `fj.design` for this brake
GROWTH_SCALE = 2 * math.pi  # xi_1 omega_1 of this brake [1/s]
AREA_RATIO_MIN, SLIP_RATIO_MAX = 2.0, 0.9
LOGARITHMIC = ("G", "P", "omega_1", "omega_2")


@dataclasses.dataclass(frozen=True)
class DesignTask:
    """What is asked; hashable by its name."""

    name: str
    title: str
    bounds: Mapping[str, tuple[float, float]] = dataclasses.field(hash=False)
    conditions: Mapping[str, tuple[float, ...]] = dataclasses.field(
        default_factory=dict, hash=False
    )
    nearest: bool = False  # the least change is best, not the smallest growth rate

    @property
    def unit(self) -> str:
        """Of the objective."""
        return "-" if self.nearest else "1/s"

    @property
    def condition_count(self) -> int:
        """How many conditions every design is judged at."""
        return len(next(iter(self.conditions.values()))) if self.conditions else 1

    def quantities(self, u, exp: Callable = math.exp) -> dict[str, Any]:
        """The quantities of the scene at scaled variables u (v,)."""
        values = {}
        for i, (name, (low, high)) in enumerate(self.bounds.items()):
            if name in LOGARITHMIC:
                values[name] = exp(math.log(low) + u[i] * math.log(high / low))
            else:
                values[name] = low + u[i] * (high - low)
        return values

    def scaled(self, quantities: Mapping[str, float]) -> np.ndarray:
        """Scaled variables (v,) of quantities; those beyond a bound by a rounding are on it."""
        u = []
        for name, (low, high) in self.bounds.items():
            scale = math.log if name in LOGARITHMIC else float
            u.append((scale(quantities[name]) - scale(low)) / (scale(high) - scale(low)))
        return np.clip(u, 0, 1)

    @property
    def own(self) -> np.ndarray:
        """Scaled variables (v,) of the reference brake."""
        return self.scaled(brake())

    def starts(self, count: int) -> np.ndarray:
        """The brake's own design and designs spread at random (count, v)."""
        others = np.random.default_rng(0).uniform(size=(count - 1, len(self.bounds)))
        return np.vstack([self.own[None], others])


SURFACE: dict[str, tuple[float, float]] = {"D": (2.3, 2.8), "G": (1e-11, 1e-9)}
_LOADS, _FRICTIONS = np.meshgrid(np.linspace(1700, 2100, 5), np.linspace(0.35, 0.45, 5))
TASKS = (
    DesignTask("one condition", "D and G, one condition", SURFACE),
    DesignTask(
        "envelope",
        "D and G, worst of 25 conditions",
        SURFACE,
        {"P": tuple(_LOADS.ravel().tolist()), "mu_s": tuple(_FRICTIONS.ravel().tolist())},
    ),
    DesignTask(
        "five variables",
        "Nearest in D, G, P, omega_1, omega_2",
        SURFACE | {"P": (1000.0, 4000.0), "omega_1": (5000.0, 8000.0), "omega_2": (4000.0, 6500.0)},
        nearest=True,
    ),
)


@functools.cache
def least_stiffness() -> float:
    """K_n of the reference brake [N/m]: no design may be softer."""
    return float(fj.stiffness(fj.brake_scene())[0])


def requirements(np, K_n_min, growth, K_n, log_area_ratio, slip_ratio) -> list[Any]:
    """Each at most 0 where it is met, as `fj.design` scales them; `np` is NumPy or JAX's."""
    return [
        2 * (math.log(AREA_RATIO_MIN) - log_area_ratio),
        10 * (slip_ratio - SLIP_RATIO_MAX),
        np.arcsinh((growth - TARGET) / GROWTH_SCALE),
        1 - K_n / K_n_min,
    ]


def by_package(task: DesignTask) -> Callable[[jax.Array], jax.Array]:
    """Judges a design (v,) by the package: a traceable function to a row (1 + k,)."""
    scene, own, K_n_min = fj.brake_scene(), jnp.asarray(task.own), least_stiffness()

    def at(quantities):
        moved = scene.replace(**quantities)
        state = moved.contact.state(moved.friction.mu_s, moved.friction.mu_m)
        growth = fj.growth_rate(moved)
        ratios = state.log_area_ratio, state.slip_ratio
        return jnp.stack([growth, *requirements(jnp, K_n_min, growth, state.K_n, *ratios)])

    def judge(u):
        quantities = task.quantities(u, jnp.exp)
        if task.conditions:
            conditions = {name: jnp.asarray(values) for name, values in task.conditions.items()}
            row = jax.vmap(lambda condition: at(quantities | condition))(conditions).max(axis=0)
        else:
            row = at(quantities)
        return row.at[0].set(jnp.sum((u - own) ** 2)) if task.nearest else row

    return judge


def by_loop(task: DesignTask) -> Callable[[np.ndarray], np.ndarray]:
    """Judges a design (v,) by the loop of a user without the package: a row (1 + k,)."""
    b, own, K_n_min = brake(), task.own, least_stiffness()
    names = tuple(task.conditions)
    conditions = [
        dict(zip(names, row, strict=True)) for row in zip(*task.conditions.values(), strict=True)
    ]

    def judge(u):
        quantities, rows = task.quantities(u), []
        for condition in conditions or [{}]:
            numbers = plain_numbers(b | quantities | condition)
            growth, _, _, *state = numbers(quantities["D"], quantities["G"])
            rows.append([growth, *requirements(np, K_n_min, growth, *state)])
        row = np.max(rows, axis=0)
        if task.nearest:
            row[0] = np.sum((np.asarray(u) - own) ** 2)
        return row

    return judge
