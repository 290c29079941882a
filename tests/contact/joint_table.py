"""The 40-digit joints of tests/reference/contact.json, and the library on as many rows at once."""

import json
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import fractaljax as fj
from fractaljax._base.parts import substitute
from tools import both_modes

INPUTS = ("D", "G", "gamma", "E", "nu", "sigma_y", "H", "P", "mu_s", "mu_m")
TABLED = ("D", "G", "P")  # inputs with derivatives in the table: by D, ln G, ln P
COLUMNS_OF_TABLED = [INPUTS.index(name) for name in TABLED]
ABSOLUTE = np.isin(INPUTS, ["D", "nu", "mu_s", "mu_m"])  # the others move by their logarithm

_FILE = Path(__file__).parents[1] / "reference" / "contact.json"
ROWS = json.loads(_FILE.read_text(encoding="utf-8"))["rows"]
INPUT = np.array([[row[name] for name in INPUTS] for row in ROWS])
REGIME = np.array([row["regime"] for row in ROWS])
VALUE = {
    name: np.array([row[name] for row in ROWS], float)
    for name in ("ln_a_l", "ln_a_e", "K_n", "K_t", "A_r", "Q_e", "plastic_share")
}
VALUE["slip_ratio"] = np.array([row["slip"] for row in ROWS], float)
VALUE["a_l"] = np.exp(VALUE["ln_a_l"])
LOG_SLOPE = {
    name: np.array([row[f"dln_{name}"] or [np.nan] * 3 for row in ROWS], float)
    for name in ("a_l", "K_n", "K_t")
}
MATERIAL = fj.Material(1.154e11, 0.3, 3.55e8, 9.94e8)
BRAKE = fj.FractalContact(fj.Surface(2.4, 1.342e-10), MATERIAL, 1907.3)


def _state(x):
    # Not by `contact_state`, which refuses rows in which mu_m exceeds mu_s.
    contact = substitute(BRAKE, dict(zip(INPUTS[:8], x[:8], strict=True)))
    return contact.state(x[8], x[9])


@jax.jit
@jax.vmap
def _everything(x):
    state = _state(x)
    names = [name for name in vars(state) if name != "regime"]

    def numbers(move):
        values = vars(_state(jnp.where(ABSOLUTE, x + move, x * jnp.exp(move))))
        return jnp.stack([values[name] for name in names])

    _, *slopes = both_modes(numbers, jnp.zeros_like(x))
    return state, *(dict(zip(names, slope, strict=True)) for slope in slopes)


def everything(x, dtype: Any = np.float64):
    """State, forward and reverse derivatives (n, 10) of joints x (n, 10).

    Derivatives are by each input, or by its logarithm. All calls share one compiled program.
    """
    padded = np.pad(x, ((0, len(ROWS) - len(x)), (0, 0)), mode="edge")
    computed = _everything(jnp.asarray(padded, dtype))
    return jax.tree.map(lambda leaf: np.asarray(leaf)[: len(x)], computed)


def reference_joints(**changes):
    """Rows of the reference joint, with some inputs changed to arrays of one length."""
    x = np.tile(INPUT[0], (max(map(np.size, changes.values())), 1))
    for name, values in changes.items():
        x[:, INPUTS.index(name)] = values
    return x
