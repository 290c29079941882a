"""What people type before they read: it works, or one line says what to type instead."""

import copy
import inspect
import pickle
import re
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from matplotlib.axes import Axes

import fractaljax as fj

scene = fj.brake_scene()
structure = fj.Structure.from_scene(scene)
NAMES = {
    **{"fj": fj, "jax": jax, "jnp": jnp, "np": np, "plot": fj.plot, "scene": scene},
    **{"structure": structure, "law": scene.contact, "z": np.zeros((8, 8))},
}
LOAD = "read it by fractaljax.load('brake.toml')"
NUMBERS = "put numbers into one, fractaljax.brake_scene().replace(D=2.4, G=1e-10)"
SWEEP = "result must be a Sweep, got a Scene: make one by sweep(stability, scene, D=[2.3, 2.4]"
BOUNDS = 'bounds must be a mapping such as {"D": (2.3, 2.8)}'
PROFILE = "got 1.4: this is a profile's D, which is one less: type D = 2.4"

REFUSED = {
    # The engineer, who has Abaqus and little Python.
    'fj.growth_rate("brake.toml")': LOAD,
    'fj.stability("brake.toml")': LOAD,
    'fj.limit_cycle("brake.toml")': LOAD,
    'fj.design("brake.toml")': LOAD,
    'fj.simulate("brake.toml")': LOAD,
    'fj.hopf_boundary("brake.toml", "D")': LOAD,
    'fj.critical_friction("brake.toml")': LOAD,
    'fj.stiffness("brake.toml")': "read it by fractaljax.Scene.load('brake.toml')",
    "fj.growth_rate(2.4, 1e-10)": NUMBERS,
    "fj.stiffness(2.4, 1e-10)": NUMBERS,
    "fj.limit_cycle({'D': 2.4})": "put numbers into one, fractaljax.brake_scene().replace(**{",
    "fj.growth_rate()": "growth_rate needs scene: type growth_rate(scene, ...)",
    "fj.growth_rate(fj.brake_scene)": "got the function brake_scene: call it, brake_scene()",
    "fj.growth_rate(scene, D=2.4)": "no argument 'D': change it before, by .replace(D=...)",
    "fj.Scene(D=2.4)": "a scene is built of parts, Scene(contact, friction, oscillator, ...)",
    "fj.Scene('brake.toml')": "contact must be a Contact, got 'brake.toml'",
    "fj.Scene(fj.Coulomb(0.4), law, scene.oscillator)": "the order is Scene(contact, friction, ",
    "fj.brake_scene(D=2.5)": "brake_scene has no argument 'D': type brake_scene().replace(D=...)",
    "fj.load({'a': 1})": "path must be the name of a file, got {'a': 1}",
    "fj.Oscillator(1.0, 6283, 5026)": "Oscillator needs xi_1, xi_2, F, V: type Oscillator(m, ",
    "fj.Material(E=2.1e11)": "Material needs nu, sigma_y, H: type Material(E, nu, sigma_y, H)",
    "fj.FractalContact(2.4, 1e-10, 1900)": "surface must be a Surface, got 2.4: make one by",
    "fj.Coulomb(mu_s=0.4)": "Coulomb needs mu: type Coulomb(mu, ...)",
    "fj.Structure('M.mtx', None, 'K.mtx')": "M must be an array of real numbers, got str",
    "fj.Structure(np.eye(2), np.eye(2), np.eye(3))": "K must have shape (2, 2) as M demands",
    "fj.reduce(scene)": "fractaljax.Structure.from_scene(scene) makes one",
    "fj.sweeep": "no attribute 'sweeep': did you mean sweep or Sweep?",
    "fj.growthrate": "did you mean growth_rate?",
    "plot.growthmap": "did you mean growth_map?",
    # The user of JAX, with a loop of optax.
    "jax.grad(fj.growth_rate)(2.4)": f"got a traced number: {NUMBERS}",
    "jax.jit(fj.growth_rate)(law)": "scene must be a Scene or a Structure, got a FractalContact",
    "jax.grad(lambda D: fj.growth_rate(scene.replace(D=D)))(1.4)": PROFILE,
    "fj.growth_rate(scene.replace(D=jnp.array([2.3, 2.4])))": "use jax.vmap for many scenes",
    "fj.growth_rate([scene, scene])": "jax.vmap takes many",
    "fj.growth_rate(scene, 0.3)": "friction_slope must be True or False, got 0.3",
    "fj.design(scene, D=(2.3, 2.8))": "design has no argument 'D': type bounds={\"D\": (2.3, 2.8)}",
    "fj.design(scene, ['D', 'G'])": BOUNDS,
    "fj.design(scene, (2.3, 2.8))": BOUNDS,
    "fj.design({'D': (2.3, 2.8)}, scene)": "the order is design(x, ...)",
    "fj.design(scene, {'d': (2.3, 2.8)})": "did you mean D?",
    "fj.design(scene, {'D': (1.3, 1.8)})": "type D = 2.3",
    "fj.design(scene, bound={'D': (2.3, 2.8)})": "did you mean bounds?",
    "fj.DesignProblem(scene, D=(2.3, 2.8))": 'type bounds={"D": (2.3, 2.8)}',
    "fj.DesignProblem(scene, {'D': (2.3, 2.8)}).loss({'D': 2.4})": "u must be an array of numbers",
    "fj.sweep('growth_rate', scene, D=[2.3, 2.4])": "type fractaljax.growth_rate without quotes",
    "fj.sweep(scene, fj.growth_rate, D=[2.3])": "the order is sweep(measure, x, **axes)",
    "fj.sweep(fj.growth_rate, D=[2.3])": "sweep needs x: type sweep(measure, x, **axes)",
    "fj.sweep(fj.growth_rate, 'brake.toml', D=[2.3])": LOAD,
    "fj.sweep(fj.growth_rate, scene, D=2.4)": "must be a list, got shape (): type [2.3, 2.4]",
    "fj.sweep(fj.growth_rate, scene, d=[2.3])": "did you mean D?",
    "fj.sweep(np.float64(22.0), scene, D=[2.3])": "the function itself, such as",
    "fj.limit_cycle(scene, rtoll=1e-8)": "did you mean rtol?",
    "fj.hopf_boundary(scene, D=(2.3, 2.8))": 'type ("D", 2.3, 2.8) for x or y',
    "fj.hopf_boundary(scene, 'D', 'G')": 'x must be (name, low, high), such as ("D", 2.3, 2.8)',
    "fj.Envelope(mu=(0.2, 0.5))": 'type Envelope({"mu": (0.2, 0.5)})',
    "scene.replace(d=2.4)": "did you mean D?",
    "scene.replace({'D': 2.4})": "replace takes quantities by name: type replace(D=2.4)",
    "plot.cycles(scene)": "results must be a mapping such as {'name': limit_cycle(scene)}",
    "scene.replace(load=1000)": "did you mean P?",
    "scene.replace(mu=-1)": "mu must be above 0, got -1.0",
    "scene.replace(friction=0.4)": "friction must be a Friction, got 0.4: make one by Coulomb(0.4)",
    "scene.K_n": "K_n, K_t = fractaljax.stiffness(scene)",
    "scene.growth_rate": "type fractaljax.growth_rate(...), a function of it",
    "scene.mu_x": "did you mean mu_s or mu_m or mu?",
    "structure.Dx": "a Structure has no Dx: did you mean D?",
    "setattr(scene, 'D', 2.5)": "a Scene is frozen: type x = x.replace(D=...)",
    # The tribologist, with SurfaceTopography.
    "fj.Surface(1.4, 1e-10)": PROFILE,
    "scene.replace(D=1.4)": PROFILE,
    "fj.Surface(1e-10, 2.4)": "the order is Surface(D, G)",
    "fj.Surface(2.4)": "Surface needs G: type Surface(D, G, ...)",
    "fj.topography(scene, 1e-3, 64, seed=0)": "got a Scene: take its contact.surface",
    "fj.topography(law.surface, 1e-3, 64)": "topography needs a key or a seed, and not both",
    "fj.topography(law.surface, 1e-3, 64, key=0)": "got 0: type seed=0 in its place",
    "fj.roughness(2.4, 1e-10)": "surface must be a Spectrum, got 2.4: make one by Surface(D, G)",
    "fj.contact_state(law)": "surface must be a Surface, got a FractalContact: take its surface",
    "fj.identify([1, 2, 3], 1e-6)": "z is too short: a profile needs 128 points, got shape (3,)",
    "fj.boundary_element(z, 1e-6)": "needs material, P: type boundary_element(heights, dx, ",
    "plot.growth_map(scene)": SWEEP,
    "plot.modes(scene)": SWEEP,
    "plot.growth_map()": "growth_map needs result: type growth_map(result, ...)",
    "plot.cycle(scene)": "result must be a LimitCycle, got a Scene: make one by limit_cycle(scene)",
    "plot.identification(scene)": "make one by identify(z, dx)",
    "plot.design(scene)": "make one by design(scene, ",
}


@pytest.mark.parametrize("typed", REFUSED)
def test_one_line_says_what_to_type(typed):
    """Without a tracer, an argument of `jax.jit` or an attribute of ours."""
    with pytest.raises((Exception, Warning)) as caught:
        eval(typed, NAMES)
    message = str(caught.value)
    assert REFUSED[typed] in message and "\n" not in message
    assert not re.search("Tracer|static_arg|object has no attribute|__init__|<function", message)


def test_every_named_quantity_is_read_and_replaced_by_one_name():
    changed = scene.replace(mu=0.3, D=2.5, **{"K_t/K_n": 0.5, "omega_1/omega_2": 1.1})
    assert (changed.D, changed.stiffness_ratio) == (2.5, 0.5)
    np.testing.assert_allclose(changed.mu, 0.3, rtol=1e-15)
    np.testing.assert_allclose(changed.omega_1, 1.1 * scene.omega_2, rtol=1e-15)
    friction, V = changed.friction, changed.oscillator.V
    np.testing.assert_allclose(friction.mu(V), 0.3, rtol=1e-15)
    assert changed["K_t/K_n"] == 0.5 and changed.surface is changed.contact.surface
    # Derived ones come after the part that they are set in, and pass derivatives.
    whole = scene.replace(mu=0.3, friction=fj.Stribeck(mu_s=0.5, mu_m=0.2, v_m=0.4))
    np.testing.assert_allclose(whole.mu, 0.3, rtol=1e-15)
    slope = jax.jit(jax.grad(lambda mu: scene.replace(mu=mu).mu_s))(0.3)
    np.testing.assert_allclose(slope, scene.mu_s / scene.mu, rtol=1e-14)
    assert jnp.isnan(jax.jit(lambda mu: scene.replace(mu=mu).mu_s)(-0.3))


def test_a_structure_reads_what_its_joints_agree_in():
    joints = {"left": structure.joints[0], "right": structure.joints[0]}
    two = fj.Structure(structure.M, structure.C, structure.K, joints, structure.F, ("x1", "x2"))
    assert two.D == two["left.D"] == 2.4 and not hasattr(two, "contact")
    differing = two.replace(**{"left.D": 2.5})
    with pytest.raises(AttributeError, match=r"D differs between the joints: name left\.D and"):
        _ = differing.D
    assert differing["left.D"] == 2.5 and differing.G == scene.G
    # Copies and pytrees do not notice.
    leaves, tree = jax.tree.flatten(two)
    again = jax.tree.unflatten(tree, leaves)
    assert copy.deepcopy(again).D == 2.4 and not hasattr(again, "shape")
    with pytest.raises(AttributeError):
        _ = jax.tree.unflatten(tree, [object()] * len(leaves)).nothing_of_ours


def test_defaults_of_a_first_try():
    """Bodies without joints, a motion without a start, a surface of a seed."""
    bodies = fj.Structure(np.diag([1.0, 2.0]), None, [[3.0, -1.0], [-1.0, 2.0]])
    motion = fj.simulate(bodies)
    # omega^4 is the sum of the fourth powers of the eigenfrequencies, trace((M^-1 K)^2).
    A = np.array([[3.0, -1.0], [-0.5, 1.0]])
    period = 2 * np.pi / np.trace(A @ A) ** 0.25
    np.testing.assert_allclose(motion.times[-1], 50 * period, rtol=1e-12)
    # Without damping energy stays.
    x, v = np.split(np.asarray(motion.states), 2, axis=1)
    energy = ((v**2) @ [1.0, 2.0] + np.einsum("ti,ij,tj->t", x, [[3, -1], [-1, 2]], x)) / 2
    np.testing.assert_allclose(energy, energy[0], rtol=1e-7)
    assert energy[0] > 0 and motion.result == fj.SimulationResult.reached
    z = fj.topography(scene.surface, 1e-3, 8, seed=3)
    np.testing.assert_array_equal(z, fj.topography(scene.surface, 1e-3, 8, key=jax.random.key(3)))


def test_numbers_of_any_kind():
    for D in (np.float64(2.4), np.array(2.4), jnp.float32(2.4), 2.4):
        np.testing.assert_allclose(fj.Surface(D, 1e-10).D, 2.4, rtol=1e-7)
    assert fj.Coulomb(1).mu_s == 1.0


@pytest.fixture(scope="module")
def sweeps():
    fixed = scene.replace(contact=fj.FixedContact(4e8, 2e8))
    axes: Any = dict(K_n=[2e8, 4e8], V=[0.1, 0.15, 0.2], progress=False)
    return {
        "modes": fj.sweep(fj.stability, fixed, **axes),
        "growth": fj.sweep(fj.growth_rate, fixed, V=[0.1, 0.15], progress=False),
        "stiffness": fj.sweep(fj.stiffness, fixed, **axes),
        "own": fj.sweep(lambda x: x.K_n * 2, fixed, **axes),
    }


def test_a_sweep_plots_and_labels_itself(sweeps):
    for name, result in sweeps.items():
        shown = result.plot()
        assert all(isinstance(ax, Axes) for ax in np.ravel(shown)), name
    assert len(sweeps["stiffness"].plot()) == 2
    assert sweeps["own"].plot().get_ylabel() == "value"
    assert sweeps["growth"].plot().get_ylabel() == "growth_rate [1/s]"
    assert sweeps["own"].plot()._repr_png_().startswith(b"\x89PNG")  # without .figure
    with pytest.raises(ValueError, match="plot one of a, b"):
        fj.Sweep({"a": np.ones(2), "b": np.ones(2)}, (np.ones(2),), ("V",), scene).plot()
    array = sweeps["growth"].to_xarray()
    assert (array.name, array.dims, array.attrs["units"]) == ("growth_rate", ("V",), "1/s")
    assert array.V.attrs == {"units": "m/s", "long_name": "belt velocity"}
    modes = sweeps["modes"].to_xarray()
    assert modes.shapes.dims == ("K_n", "V", "mode", "dof")
    units = {name: modes[name].attrs["units"] for name in ("frequency", "eigenvalues")}
    assert units == {"frequency": "Hz", "eigenvalues": "1/s"}
    stiff = sweeps["stiffness"].to_xarray()
    assert list(stiff) == ["0", "1"] and stiff["0"].attrs["units"] == "N/m"
    # An array beside an axis of the same name.
    same = fj.Sweep(np.ones(2), (np.ones(2),), ("V",), scene, ("V", "m/s", "")).to_xarray()
    assert same.name == "V_"
    # Arrays of another kind under names of ours keep dimensions of their own.
    odd = {"shapes": np.ones((1, 2, 3)), "counted": np.ones((1, 4))}
    assert fj.Sweep(odd, (np.ones(1),), ("V",), scene).to_xarray().shapes.dims[1] == "shapes_0"


def rows(html: str) -> dict[str, list[str]]:
    """The cells of a table of HTML by the first of each row."""
    found = [re.findall(r"<t[dh][^>]*>(.*?)</t[dh]>", row) for row in html.split("<tr>")[1:]]
    return {first: others for first, *others in found}


def test_tables_of_a_notebook(sweeps):
    table = rows(scene._repr_html_())
    assert table["quantity"] == ["value", "unit", "meaning"]
    assert table["V"] == ["0.15", "m/s", "belt velocity"]
    assert table["contact"][0] == "FractalContact" and table["mu"][0] == "0.334525"
    table = rows(structure._repr_html_())
    assert table["n"][0] == "2" and table["joint_1.P"] == ["1907.3", "N", "normal load"]
    table = rows(fj.stability(scene)._repr_html_())
    assert table["growth_rate"][:2] == ["22.0801", "1/s"] and table["frequency"][1] == "Hz"
    table = rows(sweeps["modes"]._repr_html_())
    assert table["V"][:2] == ["0.1, 0.15, 0.2", "m/s"] and table["eigenvalues"][1] == "1/s"
    # Units are those beside the fields, also where these lie above; text is escaped.
    table = rows(
        fj.profile_parameters(1e-7 * np.sin(np.arange(400.0)), 1e-6, cutoff=6e-5)._repr_html_()
    )
    assert table["Rz"][1:] == ["m", "maximum height, mean over the sections"]
    named = fj.ParametricStructure([[1.0]], None, [[1.0]], (), {"k": 2.0}, notes=["<b> & more"])
    assert "&lt;b&gt; &amp; more" in named._repr_html_() and "<b> &" not in named._repr_html_()
    shown = []
    jax.eval_shape(lambda D: shown.append(scene.replace(D=D)._repr_html_()), 2.4)
    assert rows(shown[0])["D"][0] == "traced"


@pytest.mark.parametrize("name", ["growth_rate", "sweep", "Scene", "plot.growth_map"])
def test_explained_functions_are_the_functions(name):
    """The same signature, docstring and class; sent to other processes by their public names."""
    shown = eval(f"fj.{name}", NAMES)
    assert pickle.loads(pickle.dumps(shown)) is shown
    assert shown.__doc__ and "friction_slope" in str(inspect.signature(fj.growth_rate))
