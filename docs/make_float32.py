"""What float32 costs: measure it and write float32.md, `python docs/make_float32.py`.

Every point is rounded to float32 first and computed twice from there, in float32 and in float64,
so that the errors are those of the arithmetic and not of the inputs.
"""

from collections.abc import Callable
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from writing import run, table

import fractaljax as fj

PAGE = Path(__file__).with_name("float32.md")
POINTS = 2000  # a place
VARIED = ("D", "G", "P", "omega_1", "xi_1", "mu_s", "mu_m")
VALUES = ("a_l", "K_n", "K_t", "growth rate")

Points = dict[str, np.ndarray]


def brake(dtype=jnp.float64) -> fj.Scene:
    """The reference brake with every number in one dtype."""
    return jax.tree.map(lambda x: x.astype(dtype), fj.brake_scene())


def state_of(scene) -> fj.ContactState:
    """The joint of a scene."""
    return scene.contact.state(scene.friction.mu_s, scene.friction.mu_m)


@jax.jit
@jax.vmap
def joints(points: dict[str, jax.Array]) -> fj.ContactState:
    """The joints of many variations of the brake, in float64."""
    return state_of(brake().replace(**points))


@jax.jit
def measured(scene: fj.Scene, points: dict[str, jax.Array]) -> dict[str, jax.Array]:
    """Values (n,), and their derivatives to D and ln G (n, 2), in the dtype of the scene."""

    def quantities(x, point):
        changed = scene.replace(**point | {"D": x[0], "G": x[1]})
        state = state_of(changed)
        values = jnp.stack([state.a_l, state.K_n, state.K_t, fj.growth_rate(changed)])
        return values, (values, state.log_area_ratio, state.a_e, fj.stability(changed).eigenvalues)

    def one(point):
        x = jnp.stack([point["D"], point["G"]])
        slopes, (values, log_ratio, a_e, eigenvalues) = jax.jacfwd(quantities, has_aux=True)(
            x, point
        )
        found = {name: values[i] for i, name in enumerate(VALUES)}
        found |= {f"d {name}": slopes[i] * jnp.stack([1, x[1]]) for i, name in enumerate(VALUES)}
        return found | {
            "ln(a_l/a_e)": log_ratio,
            "a_e": a_e,
            "omega": jnp.max(jnp.abs(eigenvalues)),
        }

    return jax.vmap(one)(points)


# --- The places


def log_uniform(rng, low, high, n=POINTS):
    """Random numbers, even in the logarithm."""
    return np.exp(rng.uniform(np.log(low), np.log(high), n))


def both_sides(rng, low, high):
    """Random offsets, even in the logarithm, of either sign."""
    return log_uniform(rng, low, high) * rng.choice([-1, 1], POINTS)


def filled(**points) -> Points:
    """Points as given and elsewhere those of the brake."""
    numbers = {"D": 2.4, "G": 1.342e-10, "P": 1907.3, "omega_1": 6283.185307179586}
    numbers |= {"xi_1": 0.001, "mu_s": 0.4, "mu_m": 0.25} | points
    return {name: np.broadcast_to(np.asarray(numbers[name], float), POINTS) for name in VARIED}


def loaded(D, log_load, **points) -> Points:
    """Points whose G puts ln(P / P at a_l = a_e, all plastic) where it is asked for."""
    # With G = 1 m every joint is fully plastic, and there ln(a_l/a_e) is that number.
    start = filled(D=D, G=1.0, **points)
    G = np.exp((np.asarray(joints(start).log_area_ratio) - log_load) / 2)
    return start | {"G": G}


def typical(rng) -> Points:
    """Random over the domain, away from every regime boundary."""
    found = []
    while sum(len(part["D"]) for part in found) < POINTS:
        some = filled(
            D=rng.uniform(2.15, 2.85, POINTS),
            G=log_uniform(rng, 1e-14, 1e-7),
            P=log_uniform(rng, 1e1, 1e5),
            mu_s=rng.uniform(0.3, 0.8, POINTS),
        )
        state = joints(some)
        kept = np.asarray((state.log_area_ratio > 0.5) & (state.slip_ratio < 0.9))
        found.append({name: x[kept] for name, x in some.items()})
    return {name: np.concatenate([p[name] for p in found])[:POINTS] for name in VARIED}


def near_two_and_a_half(rng) -> Points:
    """D = 2.5 and beside it, where the power laws turn into logarithms."""
    offset = np.where(rng.random(POINTS) < 0.1, 0, both_sides(rng, 1e-7, 1e-2))
    return filled(D=2.5 + offset, G=log_uniform(rng, 5e-11, 3e-10), mu_s=0.8)


def near_fully_plastic(rng) -> Points:
    """a_l close to a_e, on both sides."""
    return loaded(rng.uniform(2.3, 2.8, POINTS), both_sides(rng, 1e-4, 1e-1))


def near_gross_slip(rng) -> Points:
    """Q_e just below mu_s P, found by bisection in ln(P / P at a_l = a_e)."""
    D, reserve = rng.uniform(2.3, 2.7, POINTS), log_uniform(rng, 1e-4, 1e-1)
    low, high = np.full(POINTS, 1e-3), np.full(POINTS, 30.0)
    for _ in range(50):
        middle = (low + high) / 2
        beyond = np.asarray(joints(loaded(D, middle)).slip_ratio) > 1 - reserve
        low, high = np.where(beyond, low, middle), np.where(beyond, middle, high)
    return loaded(D, low)


def towards_two(rng) -> Points:
    """D close to 2: the brake is fully plastic there for every G."""
    return filled(D=rng.uniform(2.02, 2.1, POINTS), G=log_uniform(rng, 1e-14, 1e-8))


def towards_three(rng) -> Points:
    """D close to 3, elastic-plastic."""
    return loaded(rng.uniform(2.9, 2.98, POINTS), rng.uniform(0.5, 8, POINTS), mu_s=0.8)


def near_coalescence(rng) -> Points:
    """Two modes that just met: equal damping, |a - b| just below 2 mu sqrt(K_n K_t)/m."""
    start = loaded(rng.uniform(2.3, 2.6, POINTS), rng.uniform(0.5, 2, POINTS), mu_s=0.25)
    # mu_s = mu_m: no slope of the friction law, which would part the modes again.
    state, brake_ = joints(start), brake().oscillator
    K_n, K_t = np.asarray(state.K_n), np.asarray(state.K_t)
    coupling = 2 * 0.25 * np.sqrt(K_n * K_t) * (1 - log_uniform(rng, 1e-4, 1e-1))
    omega_2, xi_2 = float(brake_.omega_2), float(brake_.xi_2)
    omega_1 = np.sqrt(omega_2**2 + K_n - K_t - coupling)  # m = 1 kg
    return start | {"omega_1": omega_1, "xi_1": xi_2 * omega_2 / omega_1}


PLACES: dict[str, Callable[[np.random.Generator], Points]] = {
    "typical: elastic-plastic, away from every boundary": typical,
    "D = 2.5, and 1e-7 to 1e-2 beside it": near_two_and_a_half,
    "near fully plastic: ln load 1e-4 to 1e-1 on both sides of a_l = a_e": near_fully_plastic,
    "near gross slip: 1 - Q_e/(mu_s P) from 1e-4 to 1e-1": near_gross_slip,
    "D -> 2: 2.02 to 2.1, all fully plastic": towards_two,
    "D -> 3: 2.9 to 2.98": towards_three,
    "modes that just met: coupling 1e-4 to 1e-1 beyond flutter": near_coalescence,
}


# --- The errors


def errors_at(place: str) -> dict[str, str]:
    """The cell of every quantity at a place: median and worst error, and what overflowed."""
    points = PLACES[place](np.random.default_rng(0))
    rounded = {name: jnp.asarray(x, jnp.float32) for name, x in points.items()}
    low = measured(brake(jnp.float32), rounded)
    wide = jax.tree.map(lambda x: x.astype(jnp.float64), (brake(jnp.float32), rounded))
    exact = {name: np.asarray(x) for name, x in measured(*wide).items()}
    if any(x.dtype != jnp.float32 for x in low.values()):
        raise TypeError("the library left float32")
    return {
        name: cell(np.asarray(low[name], float), exact[name], exact["omega"], name)
        for name in exact
        if name != "omega"
    }


def cell(low: np.ndarray, exact: np.ndarray, omega: np.ndarray, name: str) -> str:
    """Median and worst error, relative to the value, to the gradient's length, or to omega."""
    if exact.ndim == 2:
        off, scale = np.linalg.norm(low - exact, axis=1), np.linalg.norm(exact, axis=1)
    else:
        off, scale = np.abs(low - exact), omega if name == "growth rate" else np.abs(exact)
    if not scale.any():
        return "0" if not off.any() else "not 0"
    finite = np.isfinite(off)
    kept = finite & (scale > 0)
    errors = off[kept] / scale[kept]
    text = f"{np.median(errors):.0e}, {np.max(errors):.0e}"
    return text if finite.all() else f"{text}; {'inf' if np.isinf(low).any() else 'nan'} in part"


INTRODUCTION = """\
# What float32 costs

fractaljax computes in the dtype of its inputs and sets no global flag: without
`jax.config.update("jax_enable_x64", True)`, which is yours to call, JAX makes everything float32.
The `fractaljax` command and the examples use float64.

- **Fine in float32:** areas, stiffness and the growth rate itself for maps, pictures and searches,
  everywhere in the domain. Areas are carried as logarithms, so D -> 2 and D = 2.5 are no worse
  than elsewhere by more than the sensitivity of the model there.
- **Mind the sign of a growth rate close to 0.** Its error is a share of omega, not of itself: at
  omega = 2e4 rad/s a growth rate within the worst value below, times omega, has no certain sign.
- **Use float64** to converge a design, for gradients near gross slip, near a_l = a_e and where two
  modes meet (the derivative is infinite there), and wherever a gradient is compared with
  differences: in float32 a difference has two or three digits.
{broken}- **What overflows:** `a_e` is infinite in float32 once ln a_e > 88.7, for the brake below
  D = {overflow:.2f}; `log_area_ratio`, the stiffness and the growth rate do not need it.
  A roughness G below 1e-38 m underflows.

Each cell is the median and the worst relative error over 2000 variations of the reference brake,
float32 against float64 from the same float32 inputs. The growth rate's is relative to omega, the
largest modulus of the eigenvalues; a gradient's, to (D, ln G), is relative to its own length. Where
the exact value is 0 at every point the cell says whether float32 has it 0 as well.
"""


BROKEN = """\
- **Not usable in float32:** gradients of the growth rate of stiff joints. The tables below say
  "nan in part" where some are not numbers, and the worst of the others there are wrong.
"""


def overflow_of_a_e() -> float:
    """The D below which the brake's a_e exceeds the largest float32."""
    D = np.linspace(2.02, 2.4, POINTS)
    a_e = np.asarray(joints(filled(D=D)).a_e)
    return float(D[a_e > np.finfo(np.float32).max].max())


def page() -> str:
    """The text of float32.md."""
    cells = {place: errors_at(place) for place in PLACES}
    nan = any("nan" in text for row in cells.values() for text in row.values())
    introduction = INTRODUCTION.format(broken=BROKEN if nan else "", overflow=overflow_of_a_e())
    lines = [introduction, "## Values", "", *grid(cells, [*VALUES, "ln(a_l/a_e)", "a_e"])]
    lines += ["", "## Gradients to (D, ln G)", "", *grid(cells, [f"d {v}" for v in VALUES])]
    return "\n".join([*lines, "", "Written by `python docs/make_float32.py`.", ""])


def grid(cells: dict[str, dict[str, str]], columns: list[str]) -> list[str]:
    """A table with a row a place."""
    rows = [[place, *(row[column] for column in columns)] for place, row in cells.items()]
    return table(["where", *columns], rows)


if __name__ == "__main__":
    run({PAGE: lambda: page().encode()})
