"""Test problems as plain numbers: mechanisms with joints, each with an attracting cycle.

A problem holds M, C, K, F and its joints: directions as vectors, V, the friction law with its
constants, and P, K_n, K_t where they are not zero. A joint without "normal" has the constant
normal force P; with "preload" false it is of the source's form. "start" is [x, x'], from which the
cycle is reached; "by" names quantities for derivatives. Numbers of the cycles are in
reference/mechanisms.json, made by reference/make_mechanisms.py.
"""

import copy
from typing import Any


def mechanism(M, C, K, *joints, start, by, F=None) -> dict[str, Any]:
    """Of symmetric matrices, each by the rows of its upper triangle; it starts from rest at x.

    Directions are weights by degree of freedom; what begins with a number in `by` is of a joint.
    """
    n = len(M)
    whole = ([[X[min(i, j)][abs(i - j)] for j in range(n)] for i in range(n)] for X in (M, C, K))
    problem = dict(zip("MCK", whole, strict=True)) | {"F": n * [0.0] if F is None else F}
    for each in joints:
        for name in each.keys() & {"tangential", "normal"}:
            each[name] = [each[name].get(i, 0.0) for i in range(n)]
    places = [f"joints.{place}" if place[0].isdigit() else place for place in by.split()]
    return problem | {"joints": [*joints], "start": start + n * [0.0], "by": places}


def joint(friction, tangential, normal, V, P=None, K_n=None, K_t=None, preload=None):
    """What is not given is left out."""
    given = {"tangential": tangential, "normal": normal, "V": V, "P": P, "K_n": K_n, "K_t": K_t}
    given |= {"preload": preload, "friction": friction}
    return {name: value for name, value in given.items() if value is not None}


def law(kind, *names):
    """What makes a law of its numbers, in the order of their names."""
    return lambda *numbers: (kind, dict(zip(names, numbers, strict=False)))


coulomb, hyperbolic = law("coulomb", "mu"), law("hyperbolic", "mu_s", "delta")
exponential = law("exponential", "mu_s", "mu_d", "v_0", "viscous")
stribeck = law("stribeck", "mu_s", "mu_m", "v_m")
PROBLEMS: dict[str, dict[str, Any]] = {
    # Leine, van Campen, de Kraker and van den Steen, Nonlinear Dynamics 16, 41-54 (1998).
    "leine_1998": mechanism(
        [[1.0]],
        [[0.0]],
        [[1.0]],
        joint(hyperbolic(1.0, 3.0), {0: 1.0}, None, 0.2, 1.0),
        start=[0.0],
        by="0.V 0.P 0.friction.delta",
    ),
    # The friction law and its constants are those of Thomsen and Fidlin, Int. J. Non-Linear
    # Mechanics 38, 389 (2003); damping and speed are ours.
    "thomsen_2003": mechanism(
        [[1.0]],
        [[0.1]],
        [[1.0]],
        joint(stribeck(0.4, 0.25, 0.5), {0: 1.0}, None, 0.2, 1.0),
        start=[0.6],
        by="0.V 0.friction.mu_m C.0.0",
    ),
    # Constants of Papangelo, Ciavarella and Hoffmann, Nonlinear Dynamics (2017).
    "papangelo_2017": mechanism(
        [[1.0]],
        [[0.1]],
        [[1.0]],
        joint(exponential(1.0, 0.5, 0.5), {0: 1.0}, None, 1.0, 1.0),
        start=[1.5],
        by="0.V 0.P K.0.0",
    ),
    # Veraszto and Stepan, Int. J. Non-Linear Mechanics (2017), 10.1016/j.ijnonlinmec.2017.01.006:
    # friction 2 N + 4 N exp(-10 w) + 0.2 w. Equilibrium and cycle are both attracting.
    "veraszto_2017": mechanism(
        [[0.538]],
        [[5.746]],
        [[6957.0]],
        joint(exponential(0.6, 0.2, 0.1, 0.02), {0: 1.0}, None, 0.22, 10.0),
        start=[0.002],
        by="0.V 0.P C.0.0 M.0.0",
    ),
    # The source's case of section 3.3 at K_n = 4e8 N/m, as PLAIN of filippov.py.
    "source_form": mechanism(
        [[1.0, 0.0], [1.0]],
        [[12.566370614359172, 0.0], [70.37167544041137]],
        [[39478417.60435743, 0.0], [25266187.26678876]],
        joint(stribeck(0.4, 0.25, 0.5), {0: 1.0}, {1: 1.0}, 0.15, None, 4e8, 2e8, preload=False),
        F=[3.5355339059327373, -3.5355339059327373],
        start=[7.5e-06, 0.0],
        by="0.V 0.K_n 0.K_t 0.friction.mu_s",
    ),
    # Lift-off, stick and both directions of slip.
    "lift_off": mechanism(
        [[1.285, 0.0], [0.675]],
        [[0.072, 0.0049], [0.0497]],
        [[3.064, 1.198], [4.487]],
        joint(hyperbolic(0.87, 1.08), {1: 1.0}, {0: 1.0}, 0.53, 1.96, 6.5),
        start=[0.4, 1.6],
        by="0.P 0.V 0.K_n",
    ),
    # The switch of one face releases the other, which stuck; eight maxima of t.x in a period.
    "released": mechanism(
        [[0.598, -0.015], [0.73]],
        [[0.083, 0.0], [0.106]],
        [[1.896, 1.109], [1.259]],
        joint(hyperbolic(0.864, 0.382), {0: 1.01, 1: 0.618}, {1: 1.0}, 0.913, 1.963, 5.117, 2.71),
        start=[0.883, 0.58],
        by="0.P 0.V",
    ),
    # Two maxima of x1 in a period, lift-off between them.
    "two_maxima": mechanism(
        [[1.566, 0.0], [1.534]],
        [[0.1249, -0.0083], [0.092]],
        [[2.878, -0.29], [1.764]],
        joint(hyperbolic(0.78, 1.99), {1: 1.0}, {0: 1.0}, 0.39, 1.18, 10.9, 2.97),
        start=[1.1, 0.0],
        by="0.P 0.V K.0.0",
    ),
    # Both faces of the joint stick, one after the other.
    "second_face": mechanism(
        [[0.882, -0.014, 0.001], [1.087, 0.009], [0.836]],
        [[0.1756, -0.0141, -0.0253], [0.2178, 0.0239], [0.14]],
        [[4.368, -0.45, -0.857], [5.432, 0.792], [3.245]],
        joint(hyperbolic(0.98, 2.53), {2: 1.0}, {0: 1.0}, -0.24, 1.74, 3.6, 0.92),
        start=[-1.1, -0.4, 0.3],
        by="0.P 0.V 0.K_t",
    ),
    # Both faces stick, and the joint lifts off.
    "second_face_lift_off": mechanism(
        [[1.049, -0.002, 0.001], [1.674, -0.002], [1.269]],
        [[0.0286, -0.0017, 0.0001], [0.0579, -0.0061], [0.0468]],
        [[0.851, -0.428, 0.027], [4.531, -1.554], [4.183]],
        joint(coulomb(0.49), {2: 1.0}, {0: 1.0}, -0.88, 0.69, 7.8, 2.75),
        start=[-0.2, 0.5, 1.0],
        by="0.P 0.V 0.K_t",
    ),
    # The source's form on three degrees of freedom; the second face sticks.
    "source_second_face": mechanism(
        [[0.774, 0.023, 0.042], [1.098, -0.004], [0.687]],
        [[0.1069, -0.002, -0.0162], [0.1252, 0.007], [0.0839]],
        [[2.572, -0.076, -0.513], [2.864, 0.211], [1.956]],
        joint(hyperbolic(0.66, 1.12), {0: 1.0}, {1: 1.0}, 0.24, None, 2.4, 1.34, preload=False),
        F=[-1.129, -1.633, -0.552],
        start=[0.5, -0.9, 0.1],
        by="0.V 0.K_n F.0",
    ),
    # Two joints that stick together for a third of the period; the first has a lever arm.
    "stick_together": mechanism(
        [[1.0, 0.0, 0.0], [1.3, 0.0], [0.5]],
        [[0.2, 0.0, 0.0], [0.2, 0.0], [0.3]],
        [[1.8, -0.8, 0.1], [2.0, 0.0], [2.0]],
        joint(hyperbolic(0.8, 1.5), {0: 1.0}, {0: 0.2, 2: 1.0}, 0.15, 1.0, 3.0),
        joint(exponential(0.7, 0.3, 0.4), {1: 1.0}, None, 0.15, 1.0),
        start=[0.3, 0.1, 0.0],
        by="0.P 1.P 0.V 1.friction.v_0",
    ),
    # Three joints on three degrees of freedom; each sticks and two lift off.
    "three_joints": mechanism(
        [[1.127, -0.002, -0.01], [0.695, 0.0], [1.379]],
        [[0.1999, -0.052, -0.0427], [0.1674, 0.0645], [0.1875]],
        [[3.86, -1.331, -1.081], [3.511, 1.653], [3.26]],
        joint(hyperbolic(0.9, 2.46), {0: -0.37, 2: 1.0}, {1: 1.0, 2: 0.331}, 0.32, 1.42, 3.2),
        joint(coulomb(0.83), {1: 1.0}, {2: 1.0}, 0.29, 0.58, 11.5),
        joint(coulomb(0.85), {0: 0.037, 2: 1.0}, {1: 1.0, 2: -0.13}, -0.64, 0.68, 5.9),
        start=[0.2, 0.1, 0.3],
        by="0.P 1.P 0.V",
    ),
    # Two joints with second faces that stick and lift off.
    "four_dof": mechanism(
        [[1.645, 0.011, 0.0, -0.018], [1.079, 0.007, 0.009], [1.602, 0.017], [1.646]],
        [[0.3021, 0.0193, -0.0238, 0.0015], [0.1793, -0.0493, -0.0749], [0.2599, 0.0186], [0.1913]],
        [[5.384, 0.462, -0.587, 0.06], [3.066, -1.225, -1.862], [4.396, 0.438], [2.646]],
        joint(
            hyperbolic(0.82, 1.6), {0: -0.491, 3: 1.0}, {2: 1.0, 3: -0.178}, 0.96, 1.1, 11.8, 2.84
        ),
        joint(coulomb(0.94), {1: 0.175, 2: 1.0}, {0: 1.0, 2: 0.022}, 0.53, 0.88, 9.5, 3.67),
        start=[-0.3, -0.2, 0.3, -0.5],
        by="0.P 1.V 0.K_t",
    ),
    # Three joints, one of which sticks.
    "five_dof": mechanism(
        [
            [0.976, 0.002, -0.02, 0.008, -0.005],
            [1.373, 0.016, -0.017, 0.002],
            [1.533, -0.025, 0.011],
            [1.748, -0.003],
            [1.092],
        ],
        [
            [0.1573, 0.0307, -0.0525, 0.0379, 0.0046],
            [0.2201, -0.0071, 0.0401, -0.0165],
            [0.1469, -0.0075, -0.015],
            [0.1891, -0.0235],
            [0.1344],
        ],
        [
            [3.943, 1.069, -1.804, 1.311, 0.168],
            [5.504, -0.273, 1.428, -0.582],
            [2.691, -0.222, -0.542],
            [3.825, -0.817],
            [2.957],
        ],
        joint(
            exponential(0.98, 0.39, 0.34),
            {1: -0.025, 3: 1.0},
            {2: 1.0, 3: -0.296},
            0.31,
            0.73,
            4.0,
            2.72,
        ),
        joint(coulomb(0.46), {0: -0.003, 3: 1.0}, {1: 1.0, 3: -0.366}, 0.73, 1.13, 4.9),
        joint(coulomb(0.86), {0: 1.0, 3: 0.19}, {0: -0.193, 4: 1.0}, 0.95, 1.88, 6.2),
        start=[-0.1, 0.3, 0.8, 0.1, 0.5],
        by="0.P 0.V 2.P",
    ),
    # Two joints that stick; the second lifts off.
    "six_dof": mechanism(
        [
            [1.563, 0.014, 0.0, 0.0, 0.04, 0.028],
            [0.876, 0.014, 0.038, -0.014, 0.019],
            [1.937, -0.001, -0.012, 0.01],
            [1.075, -0.01, -0.001],
            [1.302, -0.016],
            [1.272],
        ],
        [
            [0.1905, 0.0471, -0.0287, -0.0037, -0.0408, -0.0125],
            [0.2466, -0.023, 0.0788, -0.0012, 0.0066],
            [0.1659, 0.0014, 0.0324, 0.0076],
            [0.1157, 0.0252, 0.0046],
            [0.1535, 0.0144],
            [0.1181],
        ],
        [
            [6.214, 2.588, -1.598, -0.206, -2.391, -0.777],
            [11.278, -1.321, 4.289, -0.026, 0.313],
            [3.788, 0.078, 1.844, 0.394],
            [3.416, 1.434, 0.257],
            [4.886, 0.848],
            [2.995],
        ],
        joint(hyperbolic(0.75, 1.38), {3: 1.0, 5: -0.561}, {2: 1.0, 3: 0.005}, 0.85, 1.29, 2.0),
        joint(
            exponential(0.77, 0.33, 0.4),
            {0: -0.299, 1: 1.0},
            {1: 0.328, 3: 1.0},
            0.68,
            0.94,
            7.0,
            0.81,
        ),
        start=[-0.9, -1.5, 0.4, 0.0, -1.4, -0.4],
        by="0.P 1.P M.0.0",
    ),
    # Three joints on eight degrees of freedom.
    "eight_dof": mechanism(
        [
            [0.814, -0.053, -0.008, 0.005, 0.035, -0.001, 0.04, -0.026],
            [1.685, 0.048, -0.012, -0.076, -0.055, -0.038, 0.039],
            [1.178, 0.009, 0.024, -0.009, 0.017, 0.018],
            [1.582, 0.005, 0.014, 0.042, -0.014],
            [1.533, 0.013, -0.043, -0.02],
            [1.128, 0.051, -0.01],
            [2.061, -0.009],
            [1.623],
        ],
        [
            [0.4591, -0.1024, 0.0865, 0.0547, 0.0191, -0.0029, -0.0805, 0.085],
            [0.5721, -0.198, 0.089, 0.1374, -0.0855, 0.0352, -0.0778],
            [0.5047, 0.007, -0.0153, -0.011, -0.2376, 0.0697],
            [0.3862, 0.2141, 0.0842, 0.0245, -0.0485],
            [0.367, 0.0303, -0.0614, -0.0772],
            [0.2589, -0.0109, -0.0672],
            [0.5367, 0.0222],
            [0.3248],
        ],
        [
            [10.274, -2.435, 2.113, 1.327, 0.426, -0.07, -2.004, 2.097],
            [12.062, -4.872, 2.181, 3.429, -2.02, 0.898, -1.938],
            [10.983, 0.162, -0.4, -0.258, -5.802, 1.677],
            [7.653, 5.205, 2.035, 0.55, -1.165],
            [7.238, 0.722, -1.447, -1.857],
            [5.055, -0.322, -1.624],
            [10.785, 0.551],
            [6.113],
        ],
        joint(
            exponential(0.83, 0.2, 0.45), {3: -0.364, 7: 1.0}, {0: 1.0, 7: -0.214}, 0.22, 0.99, 11.4
        ),
        joint(coulomb(0.49), {5: 1.0, 6: -0.446}, None, -0.81, 1.82),
        joint(coulomb(0.62), {1: 1.0}, {6: 1.0}, 0.33, 1.0, 4.7),
        start=[-0.7, 0.6, -0.7, 1.4, -0.5, -1.2, -1.0, -1.1],
        by="0.P 0.V C.0.0",
    ),
}


def changed(problem, places, values):
    """The problem with numbers changed at dotted places, as `by` names them."""
    problem = copy.deepcopy(problem)
    for place, value in zip(places, values, strict=True):
        *path, last = (int(key) if key.isdigit() else key for key in place.split("."))
        table = problem
        for key in path:
            table = table[key]
            table = table[1] if isinstance(table, tuple) else table  # (law, numbers)
        table[last] = value
    return problem
