"""The margin of stability against Hurwitz determinants and roots in 40 digits, and its picture."""

from fractions import Fraction

import jax
import jax.numpy as jnp
import mpmath as mp
import numpy as np
import pytest

import fractaljax as fj
from fractaljax.mechanism.oscillator import Linearised
from fractaljax.modes.margin import least, margin_of
from fractaljax.modes.stability import _critical_eigenvalue
from tools import DOCS, assert_same_picture, load_script, reference_scene

EPS = np.finfo(float).eps

_margins = jax.jit(jax.vmap(margin_of))
_growths = jax.jit(jax.vmap(lambda lin: _critical_eigenvalue(lin).real))


def flat(a, b, c_1, c_2, g, shift):
    return margin_of(Linearised(a, b, c_1, c_2, g), shift)


_hessian = jax.jit(jax.hessian(lambda x: flat(*x)))
_gradients = [jax.jit(mode(flat, argnums=range(6))) for mode in (jax.jacfwd, jax.jacrev)]


@pytest.fixture(autouse=True)
def _forty_digits():
    with mp.workdps(40):
        yield


# --- independent truths -------------------------------------------------------------------


def exact_least(total, product):
    return total - mp.sqrt(total**2 - 2 * product)


def exact_margin(a, b, c_1, c_2, g, shift=0.0):
    """The margin from the coefficients of the shifted polynomial, by the Hurwitz determinant."""
    a, b, c_1, c_2, g, s = (mp.mpf(x) for x in (a, b, c_1, c_2, g, shift))
    omega = mp.sqrt(a + b)
    a, b, c_1, c_2, g, s = (
        x / omega**k for x, k in zip((a, b, c_1, c_2, g, s), (2, 2, 1, 1, 4, 1), strict=True)
    )
    p = [a * b + g, c_1 * b + c_2 * a, a + b + c_1 * c_2, c_1 + c_2, mp.mpf(1)]
    # Taylor coefficients about the shift.
    q = [sum(mp.binomial(k, j) * p[k] * s ** (k - j) for k in range(j, 5)) for j in range(4)]
    H_3 = q[1] * (q[3] * q[2] - q[1]) - q[3] ** 2 * q[0]
    E = q[2] ** 2 - 4 * q[0] + q[3] * q[1]
    u = exact_least(q[3], exact_least(E, 2 * H_3) / 2)
    heavy = c_1**2 + c_2**2
    return exact_least(u + q[0] / heavy, u * q[0] / heavy) / mp.sqrt(2)


def exact_growth(a, b, c_1, c_2, g):
    """Largest real part of the roots in 40 digits, in units of sqrt(a + b)."""
    a, b, c_1, c_2, g = (mp.mpf(x) for x in (a, b, c_1, c_2, g))
    omega = mp.sqrt(a + b)
    p = [c_1 + c_2, a + b + c_1 * c_2, c_1 * b + c_2 * a, a * b + g]
    companion = mp.zeros(4)
    for k in range(4):
        companion[0, k] = -p[k] / omega ** (k + 1)
        if k:
            companion[k, k - 1] = 1
    return max(s.real for s in mp.eig(companion, left=False, right=False))


# --- random systems -----------------------------------------------------------------------


def logarithmic(rng, low, high, n):
    return 10 ** rng.uniform(low, high, n)


def systems(n, low=-5, high=-1, signs=(1,), coalescing=False, seed=0):
    """Columns a, b, c_1, c_2, g: damping of 10^low..10^high beside a and b of 0.1..10."""
    rng = np.random.default_rng(seed)
    a, b = logarithmic(rng, -1, 1, n), logarithmic(rng, -1, 1, n)
    c_1, c_2 = (logarithmic(rng, low, high, n) * rng.choice(signs, n) for _ in range(2))
    g = logarithmic(rng, -6, 1, n) * a * b
    if coalescing:  # within 1e-8..1e-1 of the exceptional point
        b = a + 2 * np.sqrt(g) * (1 + rng.choice([-1, 1], n) * logarithmic(rng, -8, -1, n))
    return a, b, c_1, c_2, g


FAMILIES = {
    "light": {},
    "driven": {"signs": (-1, 1)},
    "coalescing": {"coalescing": True},
    "driven and coalescing": {"signs": (-1, 1), "coalescing": True},
    "strong": {"low": -1, "high": 1},
    "strong and driven": {"low": -1, "high": 1, "signs": (-1, 1)},
    "anything": {"low": -3, "high": 3, "signs": (-1, 1)},
    "anything, coalescing": {"low": -3, "high": 3, "signs": (-1, 1), "coalescing": True},
}


def shifts(columns, growth, seed=1):
    """No shift; up and down by all sizes; and close to the growth rate itself, on both sides."""
    rng, n = np.random.default_rng(seed), len(growth)
    omega = np.sqrt(columns[0] + columns[1])
    near = np.abs(growth) * logarithmic(rng, -5, 0, n) * rng.choice([-1, 1], n)
    far = logarithmic(rng, -5, 0, n) * rng.choice([-1, 1], n) * omega
    return {"none": 0 * omega, "any": far, "near": growth + near}


# --- the sign -----------------------------------------------------------------------------


@pytest.mark.parametrize("family", FAMILIES.values(), ids=FAMILIES.keys())
def test_positive_exactly_where_stable(family):
    """20,000 systems, each with three shifts: the sign of shift - growth, without exception."""
    columns = systems(20_000, **family)
    lin = Linearised(*map(jnp.asarray, columns))
    growth = np.asarray(_growths(lin))
    size = np.sqrt(columns[0] + columns[1]) + np.abs(columns[2]) + np.abs(columns[3])
    for name, shift in shifts(columns, growth).items():
        found = np.asarray(_margins(lin, jnp.asarray(shift)))
        assert np.isfinite(found).all()
        sure = np.abs(growth - shift) > 1e-11 * size
        assert sure.mean() > 0.95
        np.testing.assert_array_equal((found > 0)[sure], (growth < shift)[sure], name)


@pytest.mark.parametrize("family", ["light", "coalescing", "driven and coalescing", "strong"])
def test_sign_at_the_boundary(family):
    """Couplings within 1e-14..1e-8 of the boundary, and shifts as near: 40 digits agree."""
    a, b, c_1, c_2, g = systems(60, **FAMILIES[family], seed=2)
    c_1, c_2 = np.abs(c_1), np.abs(c_2)
    rng = np.random.default_rng(3)
    off = logarithmic(rng, -14, -8, 60) * rng.choice([-1, 1], 60)
    a_3, a_1 = c_1 + c_2, c_1 * b + c_2 * a
    g = c_1 * c_2 / a_3**2 * ((a - b) ** 2 + a_3 * a_1) * (1 + off)
    found = np.asarray(_margins(Linearised(*map(jnp.asarray, (a, b, c_1, c_2, g))), 0.0 * a))
    checked = 0
    for value, *x in zip(found, a, b, c_1, c_2, g, strict=True):
        growth = exact_growth(*x)
        # What a rounding of g, a or b can undo is left out.
        a, b, c_1, c_2, g = x
        moved = exact_margin(a, b, c_1, c_2, g * (1 + 50 * EPS))
        if abs(exact_margin(*x)) > abs(moved - exact_margin(*x)):
            assert (value > 0) == (growth < 0)
            checked += 1
    assert checked > 40


def test_zero_damping():
    """0 as long as it does not flutter, and negative when it does; 0 at the boundary itself."""
    a, b, _, _, g = systems(2000, seed=4)
    zero = jnp.zeros(len(a))
    found = np.asarray(_margins(Linearised(*map(jnp.asarray, (a, b, zero, zero, g))), zero))
    flutter = (a - b) ** 2 < 4 * g
    assert flutter.sum() > 200
    assert (found[flutter] < 0).all()
    assert (found[~flutter] == 0).all()
    assert float(flat(5.0, 3.0, 0.0, 0.0, 1.0, 0.0)) == 0
    assert (
        np.asarray(_margins(Linearised(*map(jnp.asarray, (a, b, zero, zero, 0 * g))), zero + 1)) > 0
    ).all()


def test_one_undamped_direction_is_never_stable():
    """c_2 = 0 and any coupling at all: the infinitesimal damping of the other destabilises."""
    assert float(flat(5.0, 3.0, 0.01, 0.0, 1e-12, 0.0)) < 0
    assert float(flat(5.0, 3.0, 0.01, 0.0, 0.0, 0.0)) == 0


# --- the size -----------------------------------------------------------------------------


@pytest.mark.parametrize("family", ["light", "driven", "coalescing", "strong"])
def test_value_is_that_of_the_hurwitz_determinant(family):
    """Every digit but what a rounding of the coefficients takes, shifted and not."""
    columns = systems(60, **FAMILIES[family], seed=5)
    lin = Linearised(*map(jnp.asarray, columns))
    for shift in shifts(columns, np.asarray(_growths(lin))).values():
        found = np.asarray(_margins(lin, jnp.asarray(shift)))
        for value, *x in zip(found, *columns, shift, strict=True):
            wanted = exact_margin(*x)
            if isinstance(wanted, mp.mpc):  # beyond critical damping: see `least`
                continue
            moved = [[*x[:i], x[i] * (1 + 4 * EPS), *x[i + 1 :]] for i in range(6)]
            rounding = sum(abs(mp.re(exact_margin(*y)) - wanted) for y in moved)
            assert abs(value - wanted) <= 4 * rounding + 1e-14 * abs(wanted)


def test_close_to_the_least_damping_ratio():
    """Lightly damped and well apart: 0.58 to 1 times the smaller decay beside the rms frequency."""
    a, b, c_1, c_2, g = systems(4000, low=-5, high=-2, seed=6)
    apart = (np.abs(a - b) > 0.2 * (a + b)) & (4 * g < 0.5 * (a - b) ** 2)
    columns = [jnp.asarray(x[apart]) for x in (a, b, c_1, c_2, g)]
    growth = np.asarray(_growths(Linearised(*columns)))
    stable = growth < 0
    rms = np.sqrt((columns[0] + columns[1]) / 2)
    ratio = np.asarray(_margins(Linearised(*columns), 0 * rms))[stable] / (-growth / rms)[stable]
    assert apart.sum() > 1000
    assert ratio.min() > 0.5
    assert ratio.max() < 1.0
    assert np.median(ratio) > 0.8


def test_uncoupled_modes_that_cross_keep_a_third():
    """a = b, c_1 = c_2, g = 0: nothing couples, and the least it can fall to is 0.3 times."""
    assert float(flat(0.5, 0.5, 0.02, 0.02, 0.0, 0.0)) / (0.01 * np.sqrt(2)) > 0.3


def test_least():
    """Fischer and Burmeister's function, to the last digit where it is nearly 0."""
    x, y = np.array([3.0, -3.0, 1e-12, 1.0, 0.0, 0.0]), np.array([4.0, 4.0, 1.0, -1e-12, 0.0, 2.0])
    wanted = [
        float(mp.mpf(p) + mp.mpf(q) - mp.sqrt(mp.mpf(p) ** 2 + mp.mpf(q) ** 2))
        for p, q in zip(x, y, strict=True)
    ]
    np.testing.assert_allclose(least(jnp.asarray(x + y), jnp.asarray(x * y)), wanted, rtol=2e-12)


# --- derivatives --------------------------------------------------------------------------

POINTS = {
    "exceptional point": (5.0, 3.0, 0.01, 0.01, 1.0, 0.0),
    "exceptional point, shifted": (5.0, 3.0, 0.01, 0.01, 1.0, -0.002),
    "crossing": (4.0, 4.0, 0.01, 0.01, 0.0, 0.0),
    "crossing real parts": (5.0, 3.0, 0.01, 0.01, 1e-4, 0.0),
    "crossing, coupled": (4.0, 4.0, 0.01, 0.03, 1e-5, 0.0),
    "flutter": (5.0, 3.0, 0.01, 0.02, 1.5, 0.1),
    "driven": (5.0, 3.0, -0.01, 0.02, 0.5, 0.0),
    "strong damping": (5.0, 3.0, 2.0, 4.0, 0.5, -0.1),
}


@pytest.mark.parametrize("point", POINTS.values(), ids=POINTS.keys())
def test_gradients(point):
    """Both modes against differences in 40 digits, at exact coalescence as anywhere."""
    h = mp.mpf(10) ** -15
    wanted = []
    for i in range(6):
        up, down = (
            [x + k * h * (j == i) for j, x in enumerate(map(mp.mpf, point))] for k in (1, -1)
        )
        wanted.append(float((exact_margin(*up) - exact_margin(*down)) / (2 * h)))
    for gradient in _gradients:
        np.testing.assert_allclose(gradient(*point), wanted, rtol=1e-9, atol=1e-13)


@pytest.mark.parametrize("name", ["exceptional point", "crossing", "crossing, coupled"])
def test_second_derivatives(name):
    """Finite and right: it is analytic there."""
    point = POINTS[name]
    whole = _hessian(jnp.asarray(point))
    assert jnp.isfinite(whole).all()
    h = mp.mpf(10) ** -12
    up, at, down = (
        exact_margin(*point[:4], mp.mpf(point[4]) + k * h, point[5]) for k in (1, 0, -1)
    )
    np.testing.assert_allclose(whole[4, 4], float((up - 2 * at + down) / h**2), rtol=1e-8)


@pytest.mark.parametrize(
    "point",
    [
        (5.0, 3.0, 0.0, 0.0, 1.0, 0.0),  # the exceptional point without damping
        (5.0, 3.0, 0.0, 0.0, 0.5, 0.0),
        (5.0, 3.0, 0.0, 0.0, 2.0, 0.0),
        (4.0, 4.0, 0.0, 0.0, 0.0, 0.0),
        (4.0, 4.0, 4.0, 4.0, 0.0, -2.0),  # one quadruple root, at the shift
        (0.5, 0.5, 2.0, -2.0, 0.1, 0.0),
    ],
)
def test_derivatives_are_finite_where_there_are_none(point):
    for gradient in _gradients:
        assert jnp.isfinite(jnp.stack(gradient(*point))).all()
    assert jnp.isfinite(_hessian(jnp.asarray(point))).all()


def test_smooth_through_coalescence_where_the_growth_rate_is_not():
    """One Taylor polynomial on both sides of the exceptional point, and none of the growth rate."""
    x = np.linspace(-1, 1, 21)
    g = 1 + 1e-4 * x  # the damping is 0.01: coalescence is resolved on a scale of 1e-4
    columns = [np.full(21, value) for value in (5.0, 3.0, 0.01, 0.01)]
    lin = Linearised(*map(jnp.asarray, (*columns, g)))
    for values, worst in ((_margins(lin, 0.0 * g), None), (_growths(lin), 0.05)):
        values = np.asarray(values)
        fit = np.polynomial.Polynomial.fit(x, values, 8)
        missed = np.abs(fit(x) - values).max() / np.ptp(values)
        assert missed < 1e-3 if worst is None else missed > worst


# --- scenes -------------------------------------------------------------------------------


def test_is_what_stability_gives():
    scene = fj.brake_scene()
    for changed in (scene, scene.replace(D=2.6), scene.replace(G=1e-8), scene.replace(xi_1=40.0)):
        for slope in (True, False):
            found = fj.stability(changed, slope)
            alone = fj.margin(changed, friction_slope=slope)
            np.testing.assert_allclose(alone, found.margin, rtol=1e-12)
            assert (float(found.margin) > 0) == (float(found.growth_rate) < 0)


def test_reference_brake():
    """+22.08 1/s beside sqrt((a + b)/2): and the margin of a target just above it is positive."""
    scene = fj.brake_scene()
    growth = float(fj.growth_rate(scene))
    assert float(fj.margin(scene)) < 0
    assert float(fj.margin(scene, growth * (1 + 1e-9))) > 0
    assert float(fj.margin(scene, growth * (1 - 1e-9))) < 0
    constant = float(fj.growth_rate(scene, False))
    assert float(fj.margin(scene, constant * (1 - 1e-9), friction_slope=False)) < 0
    assert float(fj.margin(scene, constant * (1 + 1e-9), friction_slope=False)) > 0


def test_bare_and_plastic_joints_have_the_margin_of_the_oscillator():
    scene = fj.brake_scene()
    bare = fj.margin(scene.replace(contact=fj.FixedContact(0.0, 0.0)))
    plastic = fj.margin(scene.replace(G=1.342e-8))
    assert float(bare) > 0
    np.testing.assert_allclose(plastic, bare, rtol=1e-14)


@pytest.mark.parametrize("mode", [jax.jacfwd, jax.jacrev])
def test_gradients_through_the_contact_law(mode):
    """d margin = the sum over D and ln G, against central differences of the function itself."""
    scene = fj.brake_scene()

    @jax.jit
    def of(x):
        return fj.margin(scene.replace(D=x[0], G=jnp.exp(x[1])), -3.0)

    at, h = np.array([2.4, np.log(1.342e-10)]), 1e-4
    found = mode(of)(jnp.asarray(at))
    for i in range(2):
        step = h * np.eye(2)[i]
        # Sixth order.
        d = [(of(at + k * step) - of(at - k * step)) / (2 * k * h) for k in (1, 2, 3)]
        np.testing.assert_allclose(found[i], 1.5 * d[0] - 0.6 * d[1] + 0.1 * d[2], rtol=1e-7)


def test_vmapped_is_looped():
    scene = reference_scene()
    mus = jnp.linspace(0.3, 0.9, 7)
    many = jax.vmap(lambda mu: fj.margin(scene.replace(mu_s=mu), -1.0))(mus)
    np.testing.assert_allclose(many, [fj.margin(scene.replace(mu_s=mu), -1.0) for mu in mus], 1e-12)


def test_a_scene_of_arrays_is_refused_with_a_hint():
    with pytest.raises(ValueError, match=r"D must be a scalar, got shape \(2,\); use jax.vmap"):
        fj.margin(fj.brake_scene().replace(D=np.array([2.4, 2.5])))


def test_single_precision():
    """float32 in, float32 out; the sign is right but within the rounding of the coefficients."""
    columns = [np.float32(x) for x in systems(5000, low=-4, high=-1, seed=7)]
    found = _margins(Linearised(*map(jnp.asarray, columns)), jnp.zeros(5000, jnp.float32))
    assert found.dtype == jnp.float32
    growth = np.asarray(_growths(Linearised(*(jnp.asarray(x, float) for x in columns))))
    wrong = (np.asarray(found) > 0) != (growth < 0)
    assert wrong.mean() < 2e-3
    assert (np.abs(growth[wrong]) < 1e-4).all()
    scene = jax.tree.map(lambda x: x.astype(jnp.float32), fj.brake_scene())
    np.testing.assert_allclose(fj.margin(scene), fj.margin(fj.brake_scene()), rtol=1e-2)
    assert fj.margin(scene, -3.0).dtype == jnp.float32


def test_no_loop_and_no_contact_law_of_a_fixed_contact():
    text = str(jax.make_jaxpr(fj.margin)(reference_scene()))
    for word in ("while", "scan", "callback", "cbrt", "exp ", "log "):
        assert word not in text


# --- the picture --------------------------------------------------------------------------


def test_picture_in_the_docs_is_the_one_drawn_now(tmp_path):
    load_script(DOCS / "make_margin.py").draw(tmp_path / "margin.png")
    assert_same_picture(tmp_path / "margin.png", "margin.png")


def test_smoothed_abscissa_of_the_picture():
    """The sum over the modes of 1/(2 (s - Re lambda)) is 1/eps for a normal matrix."""
    normal = np.array([[-0.1, 1, 0, 0], [-1, -0.1, 0, 0], [0, 0, -0.3, 2], [0, 0, -2, -0.3]])
    s = load_script(DOCS / "make_margin.py").smoothed_abscissa(normal, 0.01)
    assert 1 / (s + 0.1) + 1 / (s + 0.3) == pytest.approx(100, rel=1e-9)


# --- signs where numbers leave their range --------------------------------------------------


def exactly_stable(a, b, c_1, c_2, g) -> bool:
    """By Routh and Hurwitz, in rational numbers: without any rounding."""
    a, b, c_1, c_2, g = map(Fraction, (a, b, c_1, c_2, g))
    a_3, a_2, a_1, a_0 = c_1 + c_2, a + b + c_1 * c_2, c_1 * b + c_2 * a, a * b + g
    H_3 = a_3 * a_2 * a_1 - a_1**2 - a_3**2 * a_0
    return min(a_3, a_2, a_1, a_0, H_3) > 0


@pytest.mark.parametrize("decades", [6, 20, 100])
def test_no_wrong_sign_over_hundreds_of_decades(decades):
    """Right or NaN: of the margin always, of the growth rate beyond rounding of its eigenvalues."""
    r, n = np.random.default_rng(decades), 1000
    a = 10 ** r.uniform(-decades, decades, n)
    b = a * np.where(r.random(n) < 0.3, 1, 10 ** r.uniform(-decades, decades, n))
    omega = np.sqrt(a + b)
    c_1, c_2 = (
        omega * 10 ** r.uniform(-12, min(decades, 9), n) * np.where(r.random(n) < 0.2, -1, 1)
        for _ in range(2)
    )
    g = np.minimum(a * b * 10 ** r.uniform(-decades, 4, n), 1e300)
    lin = Linearised(*map(jnp.asarray, (a, b, c_1, c_2, g)))
    growth, margin = np.asarray(_growths(lin)), np.asarray(_margins(lin))
    stable = np.array([exactly_stable(*row) for row in zip(a, b, c_1, c_2, g, strict=True)])
    known = np.isfinite(margin)
    assert 0.3 * n < known.sum() and (np.isfinite(growth) == known).all()
    assert ((margin > 0) == stable)[known].all()
    size = omega + np.abs(c_1) + np.abs(c_2)
    certain = known & (np.abs(growth) > 1e-6 * size)
    assert ((growth < 0) == stable)[certain].all()
    assert (~known == (np.maximum(abs(c_1), abs(c_2)) / omega > EPS**-0.5))[g < 1e3 * a * b].all()
