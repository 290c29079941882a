"""Structures whose matrices depend on parameters, beside plain ones assembled by NumPy."""

import jax
import numpy as np
import pytest

import fractaljax as fj
from structures import matrices
from tools import both_modes

M, D, K = matrices(4)
rng = np.random.default_rng(5)
G = rng.standard_normal((4, 4))
G = 20.0 * (G - G.T)  # gyroscopic
N = 1e5 * rng.standard_normal((4, 4))  # circulatory
JOINT = fj.Joint(fj.FixedContact(3e6, 1.4e6), fj.Coulomb(0.1), (0, 2), (1, 3))
PARAMETERS = {"Omega": 3.0, "kr": 0.7}
TEXTS = dict(
    C=[(0.5, 2 * D), ("Omega", G)], K=[(1, K), ("kr", N), ("(Omega**2 - 1) * sqrt(4)", 1e4 * M)]
)
FUNCTIONS = dict(
    C=[(None, D), (lambda p: p["Omega"], G)],
    K=[(1.0, K), (lambda p: p["kr"], N), (lambda p: 2 * (p["Omega"] ** 2 - 1), 1e4 * M)],
)
FORMS = {"texts": TEXTS, "functions": FUNCTIONS}


def parametric(form, **more):
    return fj.ParametricStructure(M, **FORMS[form], joints=JOINT, parameters=PARAMETERS, **more)


def plain(Omega, kr):
    damping, stiffness = D + Omega * G, K + kr * N + 2 * (Omega**2 - 1) * 1e4 * M
    return fj.Structure(M, damping, stiffness, JOINT)


def growth(x, at):
    """The growth rate at (Omega, kr)."""
    return fj.growth_rate(x.replace(Omega=at[0], kr=at[1]))


@jax.jit
def answers(x, at):
    """With its slopes in both modes: one program."""
    return both_modes(lambda at: growth(x, at), at)


many = jax.jit(jax.vmap(growth, in_axes=(None, 0)))


@pytest.mark.parametrize("form", FORMS)
def test_matrices_are_their_sums(form):
    x = parametric(form).replace(Omega=2.0, kr=1.5)
    for name in "MCK":
        np.testing.assert_allclose(getattr(x, name), getattr(plain(2.0, 1.5), name), rtol=1e-14)
    assert x.replace(Omega=3.0, **{"joint_1.mu": 0.1}).joints[0].friction.mu_s == 0.1
    kept = x.replace(F=np.ones(4), M=2 * M)
    assert float(kept.parameters["Omega"]) == 2.0 and kept.F is not None
    np.testing.assert_allclose(kept.K, x.K)
    assert "Omega=2.0" in repr(x)


@pytest.mark.slow
@pytest.mark.parametrize("form", FORMS)
def test_growth_rate_and_its_derivatives(form):
    x = parametric(form)
    value, *slopes = answers(x, np.array([2.0, 1.5]))
    assert value == pytest.approx(float(fj.growth_rate(plain(2.0, 1.5))), rel=1e-9)
    h = 1e-4
    differences = [
        (fj.growth_rate(plain(2 + h, 1.5)) - fj.growth_rate(plain(2 - h, 1.5))) / (2 * h),
        (fj.growth_rate(plain(2.0, 1.5 + h)) - fj.growth_rate(plain(2.0, 1.5 - h))) / (2 * h),
    ]
    # Outside of a program too, where the checks of `replace` see numbers.
    eager = jax.jvp(lambda Omega: fj.growth_rate(x.replace(Omega=Omega, kr=1.5)), (2.0,), (1.0,))
    assert eager[1] == pytest.approx(float(slopes[0][0]), rel=1e-9)
    for slope in slopes:
        np.testing.assert_allclose(slope, differences, rtol=1e-5)
    places = np.array([[1.0, 1.5], [2.0, 1.5]])
    each = [float(answers(x, at)[0]) for at in places]
    np.testing.assert_allclose(many(x, places), each, rtol=1e-9)


@pytest.mark.slow
def test_parameters_in_sweeps_masses_and_refusals():
    x = parametric("texts")
    found = fj.sweep(fj.growth_rate, x, Omega=[1.0, 2.0], kr=[0.5, 1.5], progress=False)
    value = float(answers(x, np.array([2.0, 1.5]))[0])
    assert found.values[1, 1] == pytest.approx(value, rel=1e-9)
    x = fj.ParametricStructure(
        [("1 + a", M), ("a**2 - 0.25", 0.01 * np.eye(4))], D, K, parameters={"a": 0.5}
    )
    np.testing.assert_allclose(x.M, 1.5 * M, rtol=1e-14)
    with pytest.raises(ValueError, match="M must be positive definite"):
        x.replace(a=-1.05)
    x = fj.ParametricStructure(M, D, [(1, K), ("1/Omega", K)], parameters={"Omega": 1.0})
    with pytest.raises(ValueError, match=r"a coefficient of K at Omega = 0 must be finite"):
        x.replace(Omega=0.0)
    with pytest.raises(ValueError, match=r"structure has no quantity 'omega'; it has .*Omega"):
        fj.sweep(fj.growth_rate, x, omega=[1.0], progress=False)


@pytest.mark.slow
def test_boundaries_know_parameters():
    x = parametric("texts")
    boundary = fj.hopf_boundary(x, ("kr", 1.0, 30.0), ("Omega", 0.05, 5.0), lines=5)
    branch = boundary.branches[0]
    i = len(branch.x) // 2
    at = fj.stability(x.replace(kr=branch.x[i], Omega=branch.y[i]))
    assert abs(at.growth_rate) < 1e-6 * np.abs(at.eigenvalues).max()


def test_files(tmp_path):
    x = parametric("texts", F=np.ones(4))
    x.save(tmp_path / "x.toml")
    again = fj.load(tmp_path / "x.toml")
    assert isinstance(again, fj.ParametricStructure)
    again = again.replace(Omega=2.0, kr=1.5)
    for name in "MCKF":
        wanted = getattr(x.replace(Omega=2.0, kr=1.5), name)
        np.testing.assert_array_equal(getattr(again, name), wanted)
    with pytest.raises(ValueError, match=r"the coefficient of C, term 2 is a function"):
        parametric("functions").save(tmp_path / "y.toml")


REFUSED = {
    "the coefficient of K, term 1 needs the parameter 'mu'; given are Omega": dict(
        K=[("mu", K)], parameters={"Omega": 1.0}
    ),
    "coefficient must be a formula": dict(K=[("__import__('os')", K)]),
    "a coefficient must be a formula of parameters": dict(K=[("Omega(", K)]),
    "the coefficient of K, term 1 must be a finite number of these parameters, got '9": dict(
        K=[("9**9**9 + Omega", K)]
    ),
    "the coefficient of K, term 1 must be a finite number of these parameters, got '1/0'": dict(
        K=[("1/0", K)]
    ),
    "the coefficient of K, term 1 must be finite": dict(
        K=[("1/Omega", K)], parameters={"Omega": 0.0}
    ),
    "K, term 2 must have shape": dict(K=[(1, K), (2, np.eye(3))]),
    "the parameter mu has the name of another quantity": dict(parameters={"mu": 1.0}),
    "a parameter's name must be like": dict(parameters={"1x": 1.0}),
    "Omega must be a number": dict(parameters={"Omega": "fast"}),
    "parameters must be a mapping": dict(parameters=[1.0]),
}


@pytest.mark.parametrize("message", REFUSED)
def test_refused(message):
    given = dict(M=M, C=D, K=K, joints=JOINT) | REFUSED[message]
    with pytest.raises((ValueError, TypeError), match=message):
        fj.ParametricStructure(**given)


@pytest.mark.parametrize("coefficient", [2.0, "2", lambda p: 2.0, lambda p: 1.0 + (len(p) > 0)])
def test_a_coefficient_that_reads_no_parameter_is_a_number(coefficient):
    x = fj.ParametricStructure([(coefficient, np.eye(2))], None, np.eye(2), (), {"Omega": 1.0})
    assert x.sums["M"].coefficients == (None,)
    np.testing.assert_array_equal(x.M, 2 * np.eye(2))
    x = fj.ParametricStructure([("2*Omega", np.eye(2))], None, np.eye(2), (), {"Omega": 1.0})
    assert x.sums["M"].coefficients != (None,)
