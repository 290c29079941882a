"""Test problems as plain numbers: mechanisms with joints, each with an attracting cycle.

A problem holds M, C, K, F and its joints: directions as vectors, V, the friction law with its
constants, and P, K_n, K_t where they are not zero. A joint without "normal" has the constant
normal force P; with "preload" false it is of the source's form. "start" is [x, x'], from which the
cycle is reached; "by" names quantities for derivatives. Numbers of the cycles are in
reference/mechanisms.json, made by reference/make_mechanisms.py.
"""

from typing import Any


def belt(m, c, k, V, P, friction) -> dict[str, Any]:
    """One mass on a belt, pressed by P."""
    joint = {"tangential": [1.0], "V": V, "P": P, "friction": friction}
    return {"M": [[m]], "C": [[c]], "K": [[k]], "F": [0.0], "joints": [joint]}


PROBLEMS: dict[str, dict[str, Any]] = {
    # Leine, van Campen, de Kraker and van den Steen, Nonlinear Dynamics 16, 41-54 (1998).
    "leine_1998": belt(1.0, 0.0, 1.0, 0.2, 1.0, ("hyperbolic", {"mu_s": 1.0, "delta": 3.0}))
    | {"start": [0.0, 0.0], "by": ["joints.0.V", "joints.0.P", "joints.0.friction.delta"]},
    # The friction law and its constants are those of Thomsen and Fidlin, Int. J. Non-Linear
    # Mechanics 38, 389 (2003); damping and speed are ours.
    "thomsen_2003": belt(
        1.0, 0.1, 1.0, 0.2, 1.0, ("stribeck", {"mu_s": 0.4, "mu_m": 0.25, "v_m": 0.5})
    )
    | {"start": [0.6, 0.0], "by": ["joints.0.V", "joints.0.friction.mu_m", "C.0.0"]},
    # Constants of Papangelo, Ciavarella and Hoffmann, Nonlinear Dynamics (2017).
    "papangelo_2017": belt(
        1.0, 0.1, 1.0, 1.0, 1.0, ("exponential", {"mu_s": 1.0, "mu_d": 0.5, "v_0": 0.5})
    )
    | {"start": [1.5, 0.0], "by": ["joints.0.V", "joints.0.P", "K.0.0"]},
    # Veraszto and Stepan, Int. J. Non-Linear Mechanics (2017), 10.1016/j.ijnonlinmec.2017.01.006:
    # friction 2 N + 4 N exp(-10 w) + 0.2 w. Equilibrium and cycle are both attracting.
    "veraszto_2017": belt(
        0.538, 5.746, 6957.0, 0.22, 10.0,
        ("exponential", {"mu_s": 0.6, "mu_d": 0.2, "v_0": 0.1, "viscous": 0.02}),
    )
    | {"start": [0.002, 0.0], "by": ["joints.0.V", "joints.0.P", "C.0.0", "M.0.0"]},
}  # fmt: skip
