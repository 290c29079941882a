"""Stability under preload: M x'' + C x' + K x = F + sum_j [(P - N) n + mu(w) N t], N = P + K_n n.x.

The oracle writes the forces of every joint down as functions of x and x', solves for the
sliding equilibrium, differentiates by differences in 40 digits, and takes the eigenvalues of the
state matrix.
"""

import functools
from typing import Any

import jax
import jax.numpy as jnp
import mpmath as mp
import numpy as np
import pytest

import fractaljax as fj
from fractaljax._stability.summary import stability_table, structure_table
from structures import matrices

MODES = (jax.jacfwd, jax.jacrev)
DIGITS = 40
slow = pytest.mark.slow

LAWS: dict[type, Any] = {  # mu(w) of the numbers of a law
    fj.Coulomb: lambda w, mu: mu + 0 * w,
    fj.Stribeck: lambda w, mu_s, mu_m, v_m: (
        mu_s + (mu_s - mu_m) / 2 * ((w / v_m) ** 3 - 3 * w / v_m)
    ),
    fj.ExponentialStribeck: lambda w, mu_s, mu_d, v_0, viscous: (
        mu_d + (mu_s - mu_d) * mp.exp(-w / v_0) + viscous * w
    ),
    fj.HyperbolicStribeck: lambda w, mu_s, delta: mu_s / (1 + delta * w),
}
NAMES = {
    fj.Coulomb: ("mu",),
    fj.Stribeck: ("mu_s", "mu_m", "v_m"),
    fj.ExponentialStribeck: ("mu_s", "mu_d", "v_0", "viscous"),
    fj.HyperbolicStribeck: ("mu_s", "delta"),
}


def rows(n, direction):
    """The row of a direction, by what the documentation says of each kind."""
    if isinstance(direction, np.ndarray):
        return list(direction)
    row = [0.0] * n
    if isinstance(direction, tuple):
        row[direction[0]], row[direction[1]] = 1.0, -1.0
    elif isinstance(direction, dict):
        for dof, weight in direction.items():
            row[dof] = weight
    else:
        row[direction] = 1.0
    return row


class Oracle:
    """A mechanism in working precision; quantities by joint and name, "0.K_n", can be moved."""

    def __init__(self, M, C, K, F, joints):
        self.M, self.C, self.K, self.F = (np.asarray(x, float) for x in (M, C, K, F))
        self.n, self.joints, self.numbers = len(self.M), joints, {}
        for i, joint in enumerate(joints):
            self.numbers |= {f"{i}.{name}": float(x) for name, x in joint["numbers"].items()}

    def forces(self, numbers, x, v, frozen=None):
        """The forces of the joints; with `frozen` friction they have no slope."""
        total = mp.matrix(self.n, 1)
        for i, joint in enumerate(self.joints):
            own = {name: numbers[f"{i}.{name}"] for name in joint["numbers"]}
            mu = lambda w, own=own, law=joint["law"]: LAWS[law](w, *(own[k] for k in NAMES[law]))  # noqa: E731
            t, n = joint["t"], joint["n"]
            tx, tv = (mp.fdot(t, y) for y in (x, v))
            nx, nv = (mp.fdot(n, y) if n else mp.mpf(0) for y in (x, v))
            if frozen:
                tv = nv = mp.mpf(0)
            P = own["P"] if joint["pressed"] or not n else mp.mpf(0)
            N = P + (own["K_n"] * nx if n else 0)
            for k in range(self.n):
                total[k] += mu(own["V"] - tv) * N * t[k] - own["K_t"] * tx * t[k]
                if n:
                    total[k] += (P - N) * n[k] - mu(own["V"] - nv) * own["K_t"] * tx * n[k]
        return total

    def state_matrix(self, numbers, slope):
        """The state matrix about the equilibrium, and the equilibrium x_0."""
        zero, h = mp.matrix(self.n, 1), mp.mpf(10) ** (-DIGITS // 3)
        M, C, K, F = (mp.matrix(x.tolist()) for x in (self.M, self.C, self.K, self.F))
        K_all, base = K.copy(), self.forces(numbers, zero, zero)
        for k in range(self.n):  # affine in x
            step = zero.copy()
            step[k] = 1
            K_all[:, k] = K[:, k] - (self.forces(numbers, step, zero) - base)
        x_0 = mp.lu_solve(K_all, F + base)
        C_all = C.copy()
        for k in range(self.n):
            up, down = zero.copy(), zero.copy()
            up[k], down[k] = h, -h
            ends = [self.forces(numbers, x_0, v, not slope) for v in (up, down)]
            C_all[:, k] = C[:, k] - (ends[0] - ends[1]) / (2 * h)
        A = mp.zeros(2 * self.n)
        A[: self.n, self.n :] = mp.eye(self.n)
        A[self.n :, : self.n], A[self.n :, self.n :] = -(M**-1) * K_all, -(M**-1) * C_all
        return A, x_0

    def exact(self):
        return {name: mp.mpf(x) for name, x in self.numbers.items()}

    def eigenvalues(self, slope=True, numbers=None):
        A, _ = self.state_matrix(numbers or self.exact(), slope)
        return mp.eig(A, left=False, right=False)

    def normal_forces(self):
        numbers = self.exact()
        _, x_0 = self.state_matrix(numbers, True)
        return [
            float(numbers[f"{i}.P"] + (numbers[f"{i}.K_n"] * mp.fdot(j["n"], x_0) if j["n"] else 0))
            if j["pressed"] or not j["n"]
            else np.nan
            for i, j in enumerate(self.joints)
        ]

    def slope_of(self, name):
        """d(growth rate)/d(a quantity), by differences."""
        h, ends = mp.mpf(self.numbers[name]) * mp.mpf(10) ** -12, []
        for sign in (1, -1):
            numbers = self.exact()
            numbers[name] += sign * h
            ends.append(max(s.real for s in self.eigenvalues(numbers=numbers)))
        return float((ends[0] - ends[1]) / (2 * h))


def joint(law, numbers, K_n, K_t, t, n=None, V=0.2, P: Any = None, preload=True):
    """A joint of the program, and the same for the oracle."""
    contact = fj.FixedContact(K_n, K_t, P)
    own = dict(zip(NAMES[law], numbers, strict=True)) | {"K_n": K_n, "K_t": K_t, "V": V}
    own |= {} if P is None else {"P": P}
    pressed = preload and n is not None
    made = fj.Joint(contact, law(*numbers), t, n, V, preload)
    return made, {"law": law, "numbers": own, "t": t, "n": n, "pressed": pressed}


def structure_of(n, F, *joints, seed=0):
    M, C, K = matrices(n, seed)
    made = {f"j{i}": each for i, (each, _) in enumerate(joints)}
    exact = [
        each | {"t": rows(n, each["t"]), "n": each["n"] is not None and rows(n, each["n"])}
        for _, each in joints
    ]
    x = fj.Structure(M, C, K, made, F=F)
    return x, Oracle(M, C, K, np.zeros(n) if F is None else F, exact)


def scene_of(law, numbers, K_n, K_t, P, **changes):
    """The mass on the belt, which the oracle has as a mechanism of two degrees of freedom."""
    scene = fj.Scene(fj.FixedContact(K_n, K_t, P), law(*numbers), BRAKE.oscillator, True)
    scene = scene.replace(**changes)
    o: Any = {name: float(x) for name, x in vars(scene.oscillator).items()}
    _, exact = joint(law, numbers, K_n, K_t, 0, 1, o["V"], P)
    M, K = o["m"] * np.eye(2), np.diag([o["m"] * o["omega_1"] ** 2, o["m"] * o["omega_2"] ** 2])
    C = 2 * o["m"] * np.diag([o["xi_1"] * o["omega_1"], o["xi_2"] * o["omega_2"]])
    F = o["F"] / np.sqrt(2) * np.array([1, -1])
    exact |= {"t": rows(2, 0), "n": rows(2, 1)}
    return scene, Oracle(M, C, K, F, [exact])


BRAKE = fj.brake_scene()
LEVER, PULL = np.array([0.6, 0.0, 0.8, 0.1]), np.linspace(200.0, -150.0, 4)
STRIBECK, COULOMB = (fj.Stribeck, (0.5, 0.3, 0.6)), (fj.Coulomb, (0.45,))
EXPONENTIAL = (fj.ExponentialStribeck, (0.5, 0.2, 0.15, 0.1))
HYPERBOLIC = (fj.HyperbolicStribeck, (0.5, 1.5))
PROBLEMS = {
    "scene": lambda: scene_of(*STRIBECK, 4e8, 2e8, 1907.3),
    "scene, K_t = 0": lambda: scene_of(*EXPONENTIAL, 4e8, 0.0, 300.0, F=80.0),
    "scene, pulled": lambda: scene_of(*HYPERBOLIC, 2e8, 1e8, 500.0, F=-300.0),
    "scene, coulomb": lambda: scene_of(*COULOMB, 4e8, 1e8, 100.0, V=0.3),
    "one joint": lambda: structure_of(4, None, joint(*STRIBECK, 3e6, 1e6, (0, 2), 1, P=400.0)),
    "lever arms": lambda: structure_of(
        4, PULL, joint(*EXPONENTIAL, 3e6, 1e6, {0: 1.0, 3: -0.25}, LEVER, P=700.0)
    ),
    "constant normal force": lambda: structure_of(
        4, PULL, joint(*HYPERBOLIC, 3e6, 1e6, LEVER, P=300.0, preload=False)
    ),
    "three kinds": lambda: structure_of(
        4,
        PULL,
        joint(*STRIBECK, 3e6, 1.4e6, (0, 2), (1, 3), 0.2, 900.0),
        joint(*EXPONENTIAL, 5e6, 2e6, 2, LEVER, 0.3, preload=False),
        joint(*HYPERBOLIC, 5e6, 1e6, {1: 0.7, 2: -0.7}, None, 0.1, 250.0),
    ),
}
EACH = pytest.mark.parametrize("name", PROBLEMS)


@functools.cache
def problem(name):
    with mp.workdps(DIGITS):
        return PROBLEMS[name]()


@pytest.fixture(autouse=True)
def _forty_digits():
    with mp.workdps(DIGITS):
        yield


@pytest.mark.parametrize("slope", [True, False])
@EACH
def test_eigenvalues_and_normal_forces(name, slope):
    """All eigenvalues, what follows from them, and the force on each joint at the equilibrium."""
    x, oracle = problem(name)
    wanted = sorted(oracle.eigenvalues(slope), key=lambda s: -s.real)
    size = float(max(map(abs, wanted)))
    found = fj.stability(x, slope)
    apart = np.abs(np.array(found.eigenvalues)[:, None] - np.array(wanted, complex)[None])
    assert apart.min(axis=0).max() < 1e-12 * size and apart.min(axis=1).max() < 1e-12 * size
    growth = float(wanted[0].real)
    assert float(fj.growth_rate(x, slope)) == pytest.approx(growth, abs=1e-12 * size)
    assert (float(fj.margin(x, friction_slope=slope)) > 0) == (growth < 0)
    if isinstance(x, fj.Structure):
        least = float(min(-s.real / abs(s) for s in wanted))
        assert float(found.margin) == pytest.approx(least, abs=1e-12)
    forces: Any = found.normal_force
    np.testing.assert_allclose(forces, oracle.normal_forces(), rtol=1e-11)


@slow
@EACH
def test_gradients(name):
    """By every quantity of every joint, in both modes, against differences in 40 digits."""
    x, oracle = problem(name)
    places = {
        quantity: quantity.split(".")[1] if isinstance(x, fj.Scene) else f"j{quantity}"
        for quantity, value in oracle.numbers.items()
        if value and not (quantity.endswith("V") and name == "scene, coulomb")
    }
    at = {place: jnp.asarray(oracle.numbers[quantity]) for quantity, place in places.items()}
    wanted = {place: oracle.slope_of(quantity) for quantity, place in places.items()}
    scale = max(abs(wanted[place] * float(at[place])) for place in at)
    assert scale > 0
    for mode in MODES:
        found = jax.jit(mode(lambda values: fj.growth_rate(x.replace(**values))))(at)
        for place, slope in wanted.items():
            rounding = 1e-10 * scale / float(at[place])
            assert float(found[place]) == pytest.approx(slope, rel=1e-8, abs=rounding), place


@pytest.mark.parametrize("name", ["scene", "three kinds"])
def test_vmapped_is_looped(name):
    x, _ = problem(name)
    loads = np.array([100.0, 700.0, 3000.0])
    many = jax.vmap(lambda P: fj.growth_rate(x.replace(P=P)))(loads)
    one = [fj.growth_rate(x.replace(P=P)) for P in loads]
    np.testing.assert_allclose(many, one, rtol=1e-10)
    assert len(set(np.round(np.asarray(many), 6))) == 3  # the load counts


@pytest.mark.parametrize("name", [name for name in PROBLEMS if name.startswith("scene")])
def test_a_scene_is_its_structure(name):
    scene, _ = problem(name)
    same = fj.Structure.from_scene(scene)
    assert same.joints[0].preload and same.joints[0].normal_load == scene.contact.P
    found, wanted = (fj.stability(x) for x in (same, scene))
    size = float(np.abs(wanted.eigenvalues).max())
    np.testing.assert_allclose(found.eigenvalues, wanted.eigenvalues, rtol=0, atol=1e-12 * size)
    np.testing.assert_allclose(found.normal_force, wanted.normal_force, rtol=1e-12)
    o, (K_n, K_t) = scene.oscillator, fj.stiffness(scene)
    x_1, x_2 = fj.equilibrium(o, K_n, K_t, scene.friction.mu(o.V), scene.contact.P)
    force = float(scene.contact.P + K_n * x_2)
    assert force == pytest.approx(float(wanted.normal_force[0]), rel=1e-11) and float(x_1) > 0


# --- known figures ------------------------------------------------------------------------


def test_the_reference_brake():
    """The load turns the slope of friction from stabilising to destabilising."""
    brake = BRAKE.replace(preload=True)
    constant = fj.Structure.from_scene(brake).replace(**{"joint_1.normal": None})
    damping = [fj.assemble(constant, slope)[1][0, 0] for slope in (True, False)]
    assert float(damping[0] - damping[1]) == pytest.approx(-781.04, abs=0.01)  # mu' P, N = P
    assert float(fj.growth_rate(BRAKE)) == pytest.approx(22.080110, abs=1e-6)
    assert float(fj.growth_rate(brake)) > 600
    designed = brake.replace(D=2.4319698833358783, G=1.2340705508799051e-10)
    assert float(fj.growth_rate(designed)) == pytest.approx(416, abs=1)


@pytest.mark.parametrize("how", ["springs", "lever", "matrix"])
def test_hoffmanns_minimal_model(how):
    """K = [[2, 1 - 4/3 mu], [1, 2]], M = I: flutter from mu = 3/4 exactly."""

    def growth(mu):
        friction, P = fj.Coulomb(mu), 1.0
        if how == "matrix":
            K, joints = [[2, 1 - 4 / 3 * mu], [1, 2]], {}
        elif how == "springs":
            K = [[2, 1], [1, 2 - 4 / 3]]
            joints = fj.Joint(fj.FixedContact(4 / 3, 0.0, P), friction, 0, 1, preload=True)
        else:  # the same joint with arms of 2 and of 1/2: t n^T is as it was, n n^T is not
            K = [[2, 1], [1, 2 - 1 / 3]]
            joints = fj.Joint(
                fj.FixedContact(4 / 3, 0.0, P), friction, {0: 2.0}, np.array([0, 0.5]), None, True
            )
        return fj.stability(fj.Structure(np.eye(2), None, K, joints))

    below, above = growth(0.75 - 1e-9), growth(0.75 + 1e-9)
    assert not below.unstable()
    # sqrt(-1 (1 - 4/3 mu))/(2 sqrt(2)) beyond coalescence
    wanted = np.sqrt(4e-9 / 3) / np.sqrt(8)
    assert float(above.growth_rate) == pytest.approx(wanted, rel=1e-6)


# --- onset of squeal ----------------------------------------------------------------------

ONSETS = {
    "closed form": BRAKE.replace(
        contact=fj.FixedContact(4e8, 2e8, 500.0), friction=fj.Coulomb(0.3), preload=True
    ),
    "slope": BRAKE.replace(contact=fj.FixedContact(4e8, 2e8, 20.0), V=0.4, preload=True),
    "fractal": BRAKE.replace(preload=True, xi_1=0.05, xi_2=0.05),
}


@pytest.mark.parametrize("name", [pytest.param("fractal", marks=slow), "closed form", "slope"])
def test_critical_friction(name):
    """No growth below it, growth beyond."""
    scene = ONSETS[name]
    critical = float(fj.critical_friction(scene))
    here = float(scene.friction.mu(scene.oscillator.V))
    law = scene.friction
    growths = [
        float(fj.growth_rate(scene.replace(friction=law.times(critical / here * x))))
        for x in (0.5, 1 - 1e-9, 1 + 1e-9)
    ]
    assert growths[0] < 0 and growths[1] < 0 < growths[2]
    stated = float(fj.critical_friction(scene.replace(preload=False)))
    assert (stated == pytest.approx(critical, rel=1e-12)) == (name == "closed form")


@slow
def test_boundary():
    """Every point of it has a growth rate of 0; a scene without the load has another."""
    scene = ONSETS["slope"]
    window = ("P", 8.0, 60.0), ("mu", 0.05, 0.4)
    found = fj.hopf_boundary(scene, *window, lines=9)
    assert found.branches
    for branch in found.branches:
        for P, mu in zip(branch.x[::5], branch.y[::5], strict=True):
            law = scene.friction.times(mu / float(scene.friction.mu(0.4)))
            growth = fj.growth_rate(scene.replace(P=P, friction=law))
            assert abs(float(growth)) < 1e-6
        assert np.ptp(branch.y) > 0.01  # it depends on the load


# --- open joints --------------------------------------------------------------------------


def lifted():
    """F pulls the joint open: P - K_n x of nearly F/sqrt(2) on a stiff contact."""
    scene, _ = problem("scene")
    structure, _ = problem("lever arms")
    return scene.replace(F=5000.0), structure.replace(P=1.0, F=-np.abs(PULL) * LEVER)


@pytest.mark.parametrize("which", [0, 1])
def test_an_open_joint_has_no_number(which):
    """NaN everywhere, and the force that says why; the tables say it in a line."""
    x = lifted()[which]
    found: Any = fj.stability(x)
    assert found.normal_force[0] < 0
    assert np.isnan(found.eigenvalues).all()
    for question in (fj.growth_rate, fj.margin):
        assert np.isnan(question(x)) and np.isnan(question(x, friction_slope=False))
    table = (stability_table, structure_table)[which]
    with pytest.raises(ValueError, match=r"open at (its|the) equilibrium: .*P \+ K_n .* is -\d"):
        table(x)
    closed = x.replace(P=1e5)
    assert np.isfinite(fj.growth_rate(closed)) and "normal force [N]" in table(closed)


def test_it_opens_where_the_normal_force_is_0():
    """The load at which it is 0 is found from the forces; the numbers end there."""
    scene = lifted()[0]
    P = float(scene.contact.P - fj.stability(scene).normal_force[0] * _by_P(scene))
    forces = [fj.stability(scene.replace(P=P * x)).normal_force[0] for x in (1 - 1e-9, 1 + 1e-9)]
    assert forces[0] < 0 < forces[1]
    growths = [fj.growth_rate(scene.replace(P=P * x)) for x in (1 - 1e-9, 1 + 1e-9)]
    assert np.isnan(growths[0]) and np.isfinite(growths[1])


def _by_P(scene):
    return 1 / jax.grad(lambda P: fj.stability(scene.replace(P=P)).normal_force[0])(1e4)


def test_friction_that_opens_the_joint_first():
    """Below the critical friction of a nearly open joint it is open: no number."""
    scene = ONSETS["closed form"].replace(F=700.0)
    assert float(fj.stability(scene.replace(mu=0.01)).normal_force[0]) > 0
    assert np.isnan(fj.critical_friction(scene))
    assert np.isfinite(fj.critical_friction(scene.replace(P=5000.0)))
    with pytest.raises(ValueError, match=r"cannot be computed at .*the joint may be open there"):
        fj.hopf_boundary(scene, ("P", 100.0, 900.0), ("mu", 0.1, 0.5), lines=5)


def test_a_free_body_has_no_pressed_equilibrium():
    """Friction would carry it away."""
    contact = fj.FixedContact(4e6, 0.0, 100.0)
    free = fj.Structure(
        np.eye(2), None, np.diag([0.0, 1e6]), fj.Joint(contact, fj.Coulomb(0.3), 0, 1, preload=True)
    )
    with pytest.raises(Exception, match="no static equilibrium"):
        jax.block_until_ready(fj.growth_rate(free))
    with pytest.raises(ValueError, match="friction of the preloaded joints have no static"):
        structure_table(free)


def test_float32():
    for name in ("scene", "three kinds"):
        x, _ = problem(name)
        small = jax.tree.map(lambda leaf: leaf.astype(jnp.float32), x)
        found = fj.growth_rate(small)
        assert found.dtype == jnp.float32
        assert float(found) == pytest.approx(float(fj.growth_rate(x)), rel=2e-2)


def test_without_preload_there_is_no_normal_force():
    """Neither of a scene nor of a structure in the source's form."""
    for x in (BRAKE, fj.Structure.from_scene(BRAKE)):
        assert fj.stability(x).normal_force is None
