"""The page with sliders and the widget say what Python says."""

import json
import re
import shutil
import subprocess
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.special import erf

import fractaljax as fj
from browser import chromium, complaints
from fractaljax._mechanism.quantities import replaced, substituted, with_optional
from fractaljax.plot.explore import _scene_file, page, point, points_at, slider_axes, surface_waves
from fractaljax.plot.javascript import javascript
from tools import refused_command, run_command as run

SCENE = fj.brake_scene()
DUSTY = fj.Scene(fj.FixedContact(4e8, 2e8, P=50.0), fj.Coulomb(0.4), SCENE.oscillator, preload=True)
WINDOWS = dict(D=(2.2, 2.6), G=(1e-11, 1e-9), P=(1e2, 1e4), mu=(0.05, 0.6))
LAW: fj.FractalContact = SCENE.contact
BARE = LAW.surface, LAW.material
ROUGH = fj.PerssonContact(*BARE, 1907.3, area=1e-4, L=1e-2, L_s=1e-4)
BY_PERSSON = SCENE.replace(contact=ROUGH)
DASH = "\N{EN DASH}"  # where there is no number


def in_node(program, calls):
    """What each call of the program gives, evaluated by Node."""
    node = shutil.which("node")
    if node is None:
        pytest.skip("needs Node: apt-get install nodejs")
    show = "x => typeof x === 'number' && !Number.isFinite(x) ? String(x) : x"
    text = f"{program}\nconsole.log(JSON.stringify([{','.join(calls)}].map(x => x.map({show}))))"
    ran = subprocess.run([node, "-"], input=text, capture_output=True, text=True, check=True)
    said = ran.stdout
    return [
        [{"NaN": np.nan, "Infinity": np.inf}.get(x, x) for x in row] for row in json.loads(said)
    ]


@pytest.mark.parametrize(
    ("scene", "windows"),
    [
        (SCENE, WINDOWS),
        pytest.param(DUSTY, dict(K_n=(1e7, 1e9), mu=(0.1, 0.9), V=(0.01, 1.0)), id="preloaded"),
        pytest.param(BY_PERSSON, WINDOWS | {"area": (1e-5, 1e-3)}, id="Persson"),
        pytest.param(
            SCENE.replace(friction=fj.ExponentialStribeck(0.4, 0.2, 0.3), stiffness_ratio=0.5),
            WINDOWS | {"v_0": (0.1, 1.0)},
            id="exponential",
            marks=pytest.mark.slow,
        ),
    ],
)
def test_the_translated_program_gives_what_python_gives(scene, windows):
    """At random places, in all regimes: to rounding, and NaN where Python says NaN."""
    names, ends = tuple(windows), np.array(list(windows.values()))
    at = ends[:, 0] * (ends[:, 1] / ends[:, 0]) ** np.random.default_rng(1).random((200, len(ends)))
    whole = with_optional(scene, names)
    expected = points_at(whole, names, at)

    def numbers(*q):
        return point(substituted(whole, dict(zip(names, q, strict=True))))

    computed = in_node(javascript(numbers, len(names), "f"), [f"f({q})" for q in at.tolist()])
    assert len(computed[0]) == len(expected)
    for name, column in zip(sorted(expected), zip(*computed, strict=True), strict=True):
        got, want = np.array(column, float), np.asarray(expected[name], float)
        size = np.nanmax(np.abs(want), initial=0.0) if "first" in name else np.abs(want)
        error = np.abs(got - want) / np.where(size > 0, size, 1)
        assert (np.isnan(got) == np.isnan(want)).all() and np.nanmax(error, initial=0) < 1e-9, name
    if scene is SCENE:
        assert 0.1 < np.mean(expected["plastic"]) < 0.9 and np.any(expected["slip"])
        assert np.any(np.asarray(expected["growth_rate"]) > 0)


def test_operations_the_error_function_and_equal_lines():
    """Comparisons, choices, single precision, whole numbers, conjugate parts, infinity."""

    def function(x, y):
        z = jax.lax.complex(x, y)
        single = (x.astype(jnp.float32) + jnp.float32(0.1)).astype(float)
        chosen = jnp.where((x > y) & ~(x < 0) | (y == 3), x, -y)
        return [z.imag, z.real, single, chosen, jnp.cbrt(-x), x**-3, jnp.sign(y) / 0.0, jnp.abs(y)]

    places = [(0.3, 0.2), (-0.7, 3.0), (1.0, 2.0), (1e-3, 1.0)]
    computed = in_node(javascript(function, 2, "f"), [f"f([{x},{y}])" for x, y in places])
    for (x, y), row in zip(places, computed, strict=True):
        expected = [float(value) for value in function(jnp.array(x), jnp.array(y))]
        np.testing.assert_allclose(np.array(row), np.array(expected), rtol=1e-15)
    program = javascript(jax.scipy.special.erf, 1, "f")
    places = [0.0, 1e-300, -1e-9, 0.3, -1.0, 1.9, 2.1, -3.5, 5.9, 5.999, 6.0, -40.0, np.inf, np.nan]
    calls = [f"f([{str(x).replace('inf', 'Infinity').replace('nan', 'NaN')}])" for x in places]
    computed = [row[0] for row in in_node(program, calls)]
    np.testing.assert_allclose(np.array(computed, float), erf(places), rtol=4e-15)

    def twice(x):
        jnp.sin(x)
        return jnp.exp(x) + jnp.exp(x)

    text = javascript(twice, 1, "f")
    assert text.count("Math.exp") == 1 and "sin" not in text


def test_what_has_no_counterpart_is_refused_in_parts_and_in_scenes(tmp_path):
    for function, word in [
        (lambda x: jnp.sort(x * jnp.arange(3.0))[1], "no JavaScript for the operation sort, which"),
        (lambda x: jax.lax.fori_loop(0, 3, lambda _, y: y * x, x), "operation scan, which"),
        (lambda x: jnp.abs(jax.lax.complex(x, x)), "operation abs of complex numbers"),
        (lambda x: jnp.sum(jnp.exp(x * jnp.arange(2e4))), "a program of more than 20000 lines"),
    ]:
        with pytest.raises(ValueError, match=word):
            javascript(function, 1, "f")
    law = fj.AsperityContact(LAW.surface, LAW.material, 1e3, L_s=1e-6)
    friction = fj.TabulatedFriction([0.0, 0.1, 0.5], [0.4, 0.35, 0.3])
    for changed, names in [
        (SCENE.replace(contact=law), "AsperityContact and Stribeck"),
        (SCENE.replace(friction=friction), "FractalContact and TabulatedFriction"),
    ]:
        said = f"^a page of {names} .*no JavaScript for the operation.*: fj.explore shows it"
        with pytest.raises(ValueError, match=said):
            fj.plot.explore(changed, tmp_path / "a.html")
    with pytest.raises(TypeError, match="scene must be a Scene"):
        fj.plot.explore(LAW, tmp_path / "a.html")  # pyright: ignore[reportArgumentType]


def test_waves_sum_to_the_topography():
    """The pictures of the frequencies, weighed as the page weighs them."""
    surface, n, L = SCENE.contact.surface, 24, 1e-3
    waves = surface_waves(float(surface.gamma), n)
    k = np.arange(len(waves))
    weights = L * (surface.G / L) ** (surface.D - 2) * np.sqrt(np.log(surface.gamma) / 10)
    z = np.tensordot(weights * surface.gamma ** ((surface.D - 3) * k), waves, 1)
    expected = fj.topography(surface, L, n, key=jax.random.key(0))
    np.testing.assert_allclose(z, expected, atol=1e-12 * np.abs(expected).max())


@pytest.mark.parametrize(
    ("scene", "windows"),
    [
        (SCENE, WINDOWS),
        pytest.param(SCENE, {"D": (2.2, 2.6), "K_t/K_n": (0.2, 0.6)}, id="derived"),
        pytest.param(DUSTY, {"mu": (0.1, 0.9), "omega_1/omega_2": (1, 2)}, id="preloaded"),
    ],
)
def test_scene_of_the_page_is_that_of_python(scene, windows):
    """The file that the page saves is read back as the scene with these numbers."""
    if "K_t/K_n" in windows:
        scene = scene.replace(stiffness_ratio=0.5)
    text = page(scene, windows, cycles=False, progress=False)
    names, ends = tuple(windows), np.array(list(windows.values()))
    programs, functions = text.split("const data = ")
    given = re.search(r"function sceneFile\(\) \{.*?\n\}", functions, re.DOTALL)
    assert given is not None
    program = programs.split('"use strict";')[1] + "let q; const values = () => q;"
    program += "const data = " + functions.split(";\n")[0] + ";" + given[0]
    for share in (0.0, 0.3, 0.7):
        q = (ends[:, 0] * (1 - share) + ends[:, 1] * share).tolist()
        file: Any = in_node(program, [f"(q = {q}, [sceneFile()])"])[0][0]
        saved, expected = (
            fj.Scene.from_toml(file),
            replaced(scene, dict(zip(names, q, strict=True))),
        )
        assert jax.tree.structure(saved) == jax.tree.structure(expected)
        for one, other in zip(jax.tree.leaves(saved), jax.tree.leaves(expected), strict=True):
            np.testing.assert_allclose(one, other, rtol=1e-15)
        assert file.splitlines()[2:] != scene.to_toml().splitlines()[2:]


def test_file_of_a_law_that_is_scaled_as_a_whole():
    """The program's numbers, in the places of the text."""
    scene = SCENE.replace(friction=fj.TabulatedFriction([0.0, 0.1, 0.5], [0.4, 0.35, 0.3]))
    parts, written = _scene_file(scene, ["D", "mu"])
    numbers = written(2.41, 0.3)
    parts[1::2] = [repr(float(numbers[i])) for i in parts[1::2]]
    saved = fj.Scene.from_toml("".join(parts))
    expected = replaced(scene, {"D": 2.41, "mu": 0.3})
    assert saved.to_toml() == expected.to_toml() != scene.to_toml()


def test_page_is_small_and_whole(tmp_path, capsys):
    """One file of less than a megabyte that names no other; the command writes it."""
    status, out, err = run(capsys, "explore", "--no-cycles", "--out", str(tmp_path))
    assert (status, err, out) == (0, "", f"written to {tmp_path}: explore.html\n")
    text = (tmp_path / "explore.html").read_text(encoding="utf-8")
    assert len(text) < 1e6 and "@" not in re.sub(r"@media", "", text)
    assert not re.search(r"https?:|\bsrc=|\bimport\b|url\(", text)


@pytest.mark.parametrize(
    ("over", "said"),
    [
        (["D"], "--over must be NAME=LOW:HIGH, got 'D'"),
        (["D=2.3"], "--over must be NAME=LOW:HIGH, got 'D=2.3'"),
        (["D=2.3:x", "G=1e-11:1e-9"], "--over D must be numbers, got 'x'"),
        (["D=2.3:2.5"], "explore needs two quantities or more, got D"),
    ],
)
def test_command_refuses_in_one_line(over, said, capsys, tmp_path):
    assert refused_command(capsys, "explore", "--out", tmp_path / "new", "--over", *over) == said
    assert not list(tmp_path.iterdir())


def test_stops_hold_the_nodes_and_the_scene():
    """Every `refine`-th stop is a node; the value of the scene is one, to the last bit."""
    axes, _ = slider_axes(SCENE, dict(D=(2.31, 2.42), G=(1e-10, 1e-9)), dict(G=4))
    for axis, nominal in zip(axes, (2.4, 1.342e-10), strict=True):
        stops = axis.stops
        assert (np.diff(stops) > 0).all() and len(stops) > 100
        assert (stops[:: axis.refine] == axis.nodes).all()
        assert stops[axis.start * axis.refine] == nominal
    assert len(axes[1].nodes) == 5 and axes[1].nodes[[0, -1]].tolist() == [1e-10, 1e-9]


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (dict(D=(2.3, 2.5)), "explore needs two quantities or more, got D"),
        (dict(D=(2.3, 2.5), Q=(1, 2)), "scene has no quantity 'Q'"),
        (dict(D=(2.3, 2.5), G=1e-10), r"G must be a list|the values of G must be a list"),
        (dict(D=(2.5, 2.3), G=(1e-11, 1e-9)), r"D must be \(low, high\), got \(2.5, 2.3\)"),
        (dict(D=(2.5, 2.6), G=(1e-11, 1e-9)), "the window of D must hold its value, 2.4"),
        (dict(D=(2.3, 3.1), G=(1e-11, 1e-9)), "D must be above 2 and below 3, got 3.1"),
        (dict(mu=(0.1, 0.5), mu_s=(0.3, 0.5)), "quantities must be independent"),
        (dict(cycles=dict(V=3)), "cycles must name quantities of the sliders, got V"),
        (dict(cycles=dict(D=1)), "cycles must be a whole number of at least 2, got 1"),
        (dict(path="page.txt"), "path must end in .html, got 'page.txt'"),
    ],
)
def test_bad_input_is_refused(arguments, said, tmp_path):
    arguments = dict(path=tmp_path / "page.html", scene=SCENE) | arguments
    with pytest.raises(ValueError, match=said):
        fj.plot.explore(**arguments)
    assert not list(tmp_path.iterdir())


def cell(browser, name):
    return browser.execute_script("return document.getElementById(arguments[0]).textContent", name)


def move(browser, name, index):
    """Move a slider as a user does; the value that it then has."""
    return browser.execute_script(
        """const axis = axes.find(a => a.name === arguments[0]);
        axis.input.value = arguments[1];
        axis.input.dispatchEvent(new Event("input"));
        return axis.stops[arguments[1]];""",
        name,
        index,
    )


def enter(browser, name, text):
    """Type into the field beside a slider; the field's validity and what it says."""
    return browser.execute_script(
        """const axis = axes.find(a => a.name === arguments[0]);
        axis.entry.value = arguments[1];
        axis.entry.dispatchEvent(new Event("input"));
        return [axis.entry.ariaInvalid, axis.alert.textContent, +axis.input.value];""",
        name,
        text,
    )


def number_in(text):
    return float(text.split()[0])


@pytest.mark.slow
def test_a_slider_moved_on_the_page_of_persson_s_law(tmp_path):
    """In a browser: growth rate and stiffness, where the map has fewer points."""
    path = tmp_path / "page.html"
    fj.plot.explore(BY_PERSSON, path, cycles=False, progress=False)
    with chromium() as browser:
        browser.get(path.as_uri())
        for D, P in ((20, 100), (90, 30)):
            positions = {"D": D, "P": P}
            at = {name: move(browser, name, k) for name, k in positions.items()}
            scene = replaced(BY_PERSSON, at)
            for name, expected in [
                ("growth_rate", fj.growth_rate(scene)),
                ("K_n", fj.stiffness(scene)[0]),
            ]:
                assert number_in(cell(browser, name)) == float(f"{float(expected):.5g}")
        assert browser.execute_script("return shadeMap().kinds.size") == 1
        # A number typed is taken to its last digit; what is outside is marked and not taken.
        wrong, said, place = enter(browser, "D", "2.4123456")
        assert (wrong, said) == ("false", "") and 0 < place < 120
        exact = replaced(scene, {"D": 2.4123456})
        expected = f"{float(fj.growth_rate(exact)):.5g}"
        assert number_in(cell(browser, "growth_rate")) == float(expected)
        for text in ("2.9", "two", " "):
            wrong, said, _ = enter(browser, "D", text)
            assert (wrong, said) == ("true", "a number from 2.3500 to 2.4500")
        file = browser.execute_script("return sceneFile()")
        assert fj.Scene.from_toml(file).to_toml() == exact.to_toml()
        light = browser.execute_script("return getComputedStyle(document.body.parentNode).color")
        feature = {"name": "prefers-color-scheme", "value": "dark"}
        browser.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": [feature]})
        dark = browser.execute_script("return getComputedStyle(document.body.parentNode).color")
        assert (light, dark) == ("rgb(28, 36, 48)", "rgb(227, 231, 237)")
        assert not complaints(browser)


@pytest.mark.slow
def test_a_slider_moved_changes_the_numbers_to_what_python_says(tmp_path):
    """In a browser: numbers, regime, limit cycle at a node and between nodes, surface, map."""
    path = tmp_path / "page.html"
    nodes = dict(D=3, G=2, P=2, mu=2)
    fj.plot.explore(SCENE, path, cycles=nodes, progress=False)
    with chromium() as browser:
        browser.get(path.as_uri())
        assert number_in(cell(browser, "growth_rate")) == 22.080
        assert cell(browser, "verdict") == "squeals"
        cycle = fj.limit_cycle(SCENE)
        assert cell(browser, "amplitude") == f"{cycle.amplitude[0]:.4e} m".replace("e-0", "e-")
        assert "Computed at this point" in cell(browser, "cycle-note")
        verdicts = set()
        places = [(70, 60, 60, 60), (3, 9, 100, 31), (90, 60, 60, 60), (44, 80, 5, 110)]
        for D, G, P, mu in places:
            positions = {"D": D, "G": G, "P": P, "mu": mu}
            scene = replaced(SCENE, {name: move(browser, name, k) for name, k in positions.items()})
            modes, (K_n, K_t) = fj.stability(scene), fj.stiffness(scene)
            verdict, cycle = cell(browser, "verdict"), cell(browser, "cycle-result")
            verdicts.add(verdict)
            assert verdict == "squeals" or cycle == verdict
            for name, expected in [
                ("growth_rate", modes.growth_rate),
                ("frequency", modes.frequency),
                ("K_n", K_n),
                ("ratio", K_t / K_n if K_n else np.nan),
                ("Sq", fj.roughness(scene.contact.surface, 1e-3, 1e-6).Sq),
            ]:
                shown = cell(browser, name)
                expected = float(expected)
                assert np.isnan(expected) == (shown.split()[0] == DASH)
                if not np.isnan(expected):
                    assert number_in(shown) == float(f"{expected:.5g}"), (name, positions)
        assert {"squeals", "quiet"} <= verdicts
        z = browser.execute_script("return Array.from(document.getElementById('surface').heights)")
        expected = fj.topography(scene.contact.surface, 1e-3, 96, key=jax.random.key(0))
        np.testing.assert_allclose(z, np.ravel(expected), atol=1e-6 * np.abs(expected).max())
        # Between nodes the page says so; the scene squeals there.
        browser.find_element("id", "reset").click()
        move(browser, "D", 61)
        assert cell(browser, "verdict") == "squeals"
        assert "Computed at the nearest point of a grid, D = 2.4000" in cell(browser, "cycle-note")
        # A press on the map moves its two sliders.
        browser.find_element("id", "reset").click()
        assert number_in(cell(browser, "growth_rate")) == 22.080
        browser.execute_script("document.getElementById('map').scrollIntoView({block: 'center'})")
        from selenium.webdriver import ActionChains

        ActionChains(browser).move_to_element(browser.find_element("id", "map")).click().perform()
        at = browser.execute_script("return values()")
        assert at[:2] != [2.4, 1.342e-10] and at[2] == 1907.3
        expected = float(fj.growth_rate(SCENE.replace(D=at[0], G=at[1])))
        assert number_in(cell(browser, "growth_rate")) == float(f"{expected:.5g}")
        assert complaints(browser) == []


@pytest.mark.slow
def test_what_moves_moves_and_nothing_is_cut_off(tmp_path):
    (tmp_path / "page.html").write_text(page(DUSTY, {}, cycles=False), encoding="utf-8")
    (tmp_path / "brake.html").write_text(page(SCENE, {}, cycles=False), encoding="utf-8")
    from selenium.webdriver.support.wait import WebDriverWait

    root = "document.documentElement"
    picture = "return document.getElementById('mode').toDataURL()"

    def moved_from(before):
        return lambda browser: browser.execute_script(picture) != before

    with chromium() as browser:
        for name in ("page", "brake"):
            browser.get((tmp_path / f"{name}.html").as_uri())
            before = browser.execute_script(picture)
            WebDriverWait(browser, 20).until(moved_from(before))
            browser.find_element("id", "play").click()
            for width in (1200, 800, 400):
                browser.set_window_size(width, 1000)
                assert browser.execute_script(f"return {root}.scrollWidth <= {root}.clientWidth")
            hidden = "return document.getElementById('surface-section').hidden"
            assert browser.execute_script(hidden) == (name == "page")
            assert complaints(browser) == []


@pytest.mark.slow
def test_widget_says_what_python_says():
    """A slider moved changes the numbers and the pictures; the button finds the limit cycle."""
    pytest.importorskip("ipywidgets")
    shown = fj.explore(SCENE, D=(2.35, 2.45), mu=(0.2, 0.4))
    (left, *pictures), motion = shown.children[0].children, shown.children[1]
    D, typed, _, _, numbers, button, _ = left.children
    assert (D.value, len(pictures)) == (2.4, 3)
    assert "+22.08 1/s" in numbers.value and "elastic-plastic" in numbers.value
    before = [picture.value for picture in pictures]
    D.index = 100
    expected = fj.growth_rate(SCENE.replace(D=D.value))
    assert D.value > 2.4 and f"{expected:+.5g} 1/s" in numbers.value
    assert all(bytes(new.value).startswith(b"\x89PNG") for new in pictures)
    assert all(new.value != old for new, old in zip(pictures, before, strict=True))
    assert motion.layout.display == "none" and button.description == "Limit cycle"
    assert typed.value == D.value
    typed.value = 2.41234
    assert f"{fj.growth_rate(SCENE.replace(D=2.41234)):+.5g} 1/s" in numbers.value
    typed.value = 3.0
    assert typed.value == 2.45  # the end of the slider
