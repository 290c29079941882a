"""The self-check, the gallery of published cases in docs, the command, pictures and the page."""

import functools
import re
import sys

import jax
import pytest

import fractaljax as fj
from fractaljax._validate import cases as module
from fractaljax._validate.check import Check, closed, stated
from tools import (
    DOCS,
    assert_same_picture,
    assert_whole,
    load_script,
    refused_command,
    run_command as run,
)

sys.path.insert(0, str(DOCS))  # the gallery, and what the scripts of pages share
import gallery
from gallery.case import CaseResult
from gallery.picture import picture

BASES = {"stated", "closed form", "SciPy", "corrected", "quadrature"}
QUICK = "source_onset", "campana", "sinou"
PAGE = (DOCS / "validation.md").read_text(encoding="utf-8")


@functools.cache
def script():
    return load_script(DOCS / "make_validation.py")


@functools.cache
def computed(name: str) -> CaseResult:
    return gallery.CASES[name].run()


def fake(ours=1.0, error=None):
    """A case with one number, 1.00 as it is printed."""

    def compute():
        if error is not None:
            raise error
        return [stated("length [m]", 1.0, ours, 0.01)]

    return compute


@pytest.fixture
def only(monkeypatch):
    """Make one case the only one there is."""
    return lambda case: monkeypatch.setattr(module, "CASES", {"fake": case})


@pytest.mark.parametrize(
    ("published", "ours", "tolerance", "difference", "agrees"),
    [
        (1.0, 1.004, 0.005, 0.004, True),
        (1.0, 1.006, 0.005, 0.006, False),
        (-2.0, -2.01, 0.005, -0.01, False),
        ((0.5, 0.8), 0.6, 0.0, 0.0, True),
        ((0.5, 0.8), 0.9, 0.0, 0.1, False),
        ((0.5, 0.8), 0.4, 0.0, -0.1, False),
        (1.0, float("nan"), 0.005, float("nan"), False),
    ],
)
def test_a_number_agrees_within_its_tolerance(published, ours, tolerance, difference, agrees):
    check = Check("q [-]", published, ours, tolerance, "stated")
    assert check.difference == pytest.approx(difference, abs=1e-12, nan_ok=True)
    assert check.agrees is agrees


def test_the_self_check_and_its_table():
    """Stiffness with its slope, and critical friction of the reference brake."""
    result = fj.validate("reference", progress=False)
    assert result.agrees and list(result.cases) == ["reference"]
    lines = repr(result).splitlines()
    titles = ["case", "quantity", "published", "ours", "difference", "tolerance", "basis", "result"]
    assert lines[0].split() == titles
    assert "d ln K_n/dD [-]  68.0864808768  68.0864808768" in re.sub("  +", "  ", lines[2])
    assert sum("reference" in line for line in lines) == 1  # beside its first row alone
    assert lines[-1] == "3 numbers of 1 case agree."
    names, rows = result.rows()
    assert all(len(row) == len(names) for row in rows) and {row[-1] for row in rows} == {"ok"}


INSIDE = "long\nx.EquinoxRuntimeError: mu must be above 0\nlong"  # of a compiled program


@pytest.mark.parametrize(
    ("case", "status", "words"),
    [
        (fake(), 0, ["fake  length [m]  1  ", " ok", "1 number of 1 case agrees."]),
        (fake(1.01), 1, ["DIFFERS", "+1.0e-02", "5.0e-03", "0 numbers of 1 case agree, 1 does"]),
        (fake(error=RuntimeError("no cycle\nat all")), 1, ["FAILS", "- fake, all [-]: no cycle\n"]),
        (fake(error=RuntimeError(INSIDE)), 1, ["FAILS", "- fake, all [-]: mu must be above 0\n"]),
    ],
)
def test_verdicts_and_command(capsys, only, case, status, words):
    """Exit status 0 where all agrees."""
    only(case)
    result = fj.validate(progress=False)
    assert result.agrees is (status == 0)
    for word in words:
        assert word in repr(result)
    assert run(capsys, "validate", "--quiet") == (status, f"{result!r}\n", "")
    assert "fake" in run(capsys, "validate", "fake")[2]  # the progress


def test_refusals_and_tolerances(capsys, only):
    with pytest.raises(ValueError, match=r"^no case 'nobody'; .* reference, hoffmann, leine$"):
        fj.validate("nobody")
    assert refused_command(capsys, "validate", "nobody").startswith("no case 'nobody'; the cases")
    with jax.enable_x64(False), pytest.raises(ValueError, match="validate needs 64 bits"):
        fj.validate("reference")
    with pytest.raises(TypeError, match="progress must be True or False"):
        fj.validate("reference", progress=1)  # type: ignore[arg-type]
    only(fake(error=KeyError("x")))
    with pytest.raises(KeyError):  # a defect is not hidden
        fj.validate(progress=False)
    # Half of the last digit printed; a closed form relative to its own size.
    assert stated("q [m]", 0.15, 0.154, 0.01).agrees
    assert not stated("q [m]", 0.15, 0.156, 0.01).agrees
    assert closed("q [m]", -4.0, -4.0003, 1e-4).agrees
    assert not closed("q [m]", -4.0, -4.0005, 1e-4).agrees


def test_the_brake_says_what_it_lacks(monkeypatch, tmp_path):
    brake = gallery.CASES["brake"]
    monkeypatch.delenv("FRACTALJAX_BRAKE", raising=False)
    assert brake.missing().startswith("no matrices: set FRACTALJAX_BRAKE")
    monkeypatch.setenv("FRACTALJAX_BRAKE", str(tmp_path))
    (tmp_path / "BMLL.npz").touch()
    assert "no BDLL, BYLL" in brake.missing() and "BMLL," not in brake.missing()


def test_every_case_names_its_source_and_is_on_the_page():
    cases = gallery.CASES
    for name, case in cases.items():
        assert case.name == name
        assert case.doi is None or re.fullmatch(r"10\.\d{4,}/\S+", case.doi)
        assert case.citation in PAGE and f"## {case.title}\n\n`{name}`: " in PAGE
        assert case.doi is None or f"(https://doi.org/{case.doi})" in PAGE
        image = script().picture_of(name)
        assert f"]({image.name})" in PAGE
        assert image.read_bytes().startswith(b"\x89PNG") and image.stat().st_size < 60_000
    uncertain = {name for name, case in cases.items() if case.doi is None}
    assert uncertain == {"papangelo", "galvanetto", "den_hartog"}
    # The page is its sections in the order of the gallery, with a link to each.
    sections = script().sections_of(PAGE)
    assert list(sections) == list(cases) and script().page(sections) == PAGE


def test_quick_cases_agree_with_the_page():
    assert sum(rows_as_on_the_page(name) for name in QUICK) == 4 + 3 + 4


def cells(text):
    """The rows of the Markdown table in a section of the page."""
    rows = [line for line in text.splitlines() if line.startswith("| ")]
    return [row.strip("| ").split(" | ") for row in rows[1:]]


def rows_as_on_the_page(name: str) -> int:
    """How many rows agree: published numbers to the letter, ours to the tolerance."""
    checks = computed(name).checks
    assert all(check.agrees for check in checks), fj.Validation({name: checks})
    assert all(check.basis in BASES for check in checks)
    assert all(re.search(r" \[\S+\]$", check.quantity) for check in checks)
    assert len({check.quantity for check in checks}) == len(checks)
    committed = script().sections_of(PAGE)[name]
    now = script().section(gallery.CASES[name], checks)
    assert committed.partition("\n| ")[0] == now.partition("\n| ")[0]
    for check, shown, row in zip(checks, cells(committed), cells(now), strict=True):
        assert [shown[i] for i in (0, 1, 3, 4)] == [row[i] for i in (0, 1, 3, 4)]
        assert not check.note or f"- {check.quantity}: {check.note}." in committed
        assert abs(float(shown[2]) - check.ours) <= (check.tolerance or 1e-3 * abs(check.ours))
        percent = [re.fullmatch(r"(\d+)%", cell) for cell in (shown[5], row[5])]
        if all(percent):
            assert abs(int(percent[0][1]) - int(percent[1][1])) <= 5  # type: ignore[index]
        else:
            assert shown[5] == row[5] == "within"
    return len(checks)


@pytest.mark.slow
def test_all_agree_with_numbers_and_pictures_of_the_page(tmp_path):
    """One test: two workers would compute all cases twice."""
    assert fj.validate(progress=False).agrees
    assert len(gallery.CASES) == 21
    runnable = {name: case for name, case in gallery.CASES.items() if not case.missing()}
    assert sum(map(rows_as_on_the_page, runnable)) >= 98
    for name, case in runnable.items():
        figure = picture(case, computed(name).panels)
        assert_whole(figure)
        (tmp_path / "now.png").write_bytes(script().small_png(figure))
        assert_same_picture(tmp_path / "now.png", script().picture_of(name).name)
