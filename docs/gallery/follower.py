"""A follower load: Ziegler's double pendulum, and the effect of damping on it."""

import jax
import jax.numpy as jnp
import numpy as np

import fractaljax as fj

from .case import Case, CaseResult, Curve, Panel, closed


def _pendulum(b: float) -> fj.ParametricStructure:
    """Masses 2 and 1, springs and lengths 1, dampers beta b at the foot and b at the elbow."""
    stiffness = [(None, [[2.0, -1.0], [-1.0, 1.0]]), ("P", [[-1.0, 1.0], [0.0, 0.0]])]
    damping = [("b*beta", [[1.0, 0.0], [0.0, 0.0]]), ("b", [[1.0, -1.0], [-1.0, 1.0]])]
    parameters = {"P": 1.0, "b": b, "beta": 1.0}
    return fj.ParametricStructure(
        [[3.0, 1.0], [1.0, 1.0]], damping, stiffness, parameters=parameters
    )


def _published(beta, b=0.0):
    """The damped critical load of Herrmann and Jong [c/l]; b^2/(c m l^2) is the damping's part."""
    share = (4 * beta**2 + 33 * beta + 4) / (2 * (beta**2 + 7 * beta + 6))
    return share + beta * b**2 / 2


def _critical(model, beta):
    """The loads (n,) where squeal begins, by bisection in the growth rate."""
    growth = jax.jit(
        jax.vmap(lambda P, beta: fj.growth_rate(model.replace(P=P, beta=beta)), in_axes=(0, 0))
    )
    low, high = np.full(len(beta), 0.1), np.full(len(beta), 2.3)
    for _ in range(40):
        middle = (low + high) / 2
        grows = np.asarray(growth(jnp.asarray(middle), jnp.asarray(beta))) > 0
        low, high = np.where(grows, low, middle), np.where(grows, middle, high)
    return high


def _undamped() -> float:
    """The load where squeal begins without damping: where growth exceeds rounding."""
    model, low, high = _pendulum(0.0), 1.0, 2.3
    for _ in range(30):
        middle = (low + high) / 2
        unstable = len(fj.stability(model.replace(P=middle)).unstable()) > 0
        low, high = (low, middle) if unstable else (middle, high)
    return high


def _ziegler() -> CaseResult:
    beta = np.concatenate([[1.0, 4 + 5 * np.sqrt(2)], np.geomspace(0.05, 200.0, 41)])
    b, coalescence = 0.01, 7 / 2 - np.sqrt(2)  # P l/c at which the undamped modes coalesce
    loads, heavy = _critical(_pendulum(b), beta), _critical(_pendulum(0.3), beta[:1])
    checks = [
        closed("critical load, no damping [c/l]", coalescence, _undamped(), 1e-8),
        closed("critical load, equal light dampers [c/l]", 41 / 28, loads[0] - b**2 / 2, 1e-9),
        closed("critical load, equal dampers of 0.3 [c/l]", _published(1.0, 0.3), heavy[0], 1e-9),
        closed(
            "critical load, dampers 4 + 5 sqrt(2) to 1 [c/l]",
            coalescence + beta[1] * b**2 / 2,
            loads[1],
            1e-9,
        ),
    ]
    curves = [
        Curve(beta[2::2], _published(beta[2::2], b), "Herrmann and Jong 1965, damped", False),
        Curve(beta[2:], loads[2:], "fractaljax", True),
        Curve(beta[2:], np.full(41, coalescence), "Ziegler 1952, no damping", False, True),
    ]
    axes = "ratio of the dampers, foot to elbow [-]", "critical load P l/c [-]"
    return CaseResult(checks, [Panel(*axes, curves, {"xscale": "log"})])


CASES = (
    Case(
        "ziegler",
        "Double pendulum under a follower load: damping destabilises",
        "H. Ziegler, Ing. Arch. 20, 49 (1952); G. Herrmann, I.-C. Jong, J. Appl. Mech. 32, 592 "
        "(1965)",
        "10.1007/BF00536796",
        _ziegler,
    ),
)
