"""Published cases beside ours: table, verdicts, refusals, the command, pictures and the page."""

import csv
import functools
import re
import sys
from pathlib import Path

import jax
import numpy as np
import pytest

import fractaljax as fj
from fractaljax._validate import validate as module
from fractaljax._validate.case import Case, CaseResult, Check, Curve, Panel, closed, stated
from tools import (
    DOCS,
    assert_same_picture,
    assert_whole,
    load_script,
    refused_command,
    run_command as run,
)

sys.path.insert(0, str(DOCS))  # the script of the page shares a module with others
BASES = {"stated", "closed form", "SciPy", "corrected"}
PAGE = (DOCS / "validation.md").read_text(encoding="utf-8")


@functools.cache
def script():
    return load_script(DOCS / "make_validation.py")


@functools.cache
def validated(*names):
    """All cases where none is named."""
    return fj.validate(*names, progress=False)


def fake(ours=1.0, missing="", error=None):
    """A case with one number, 1.00 as it is printed, and two curves."""

    def compute():
        if error is not None:
            raise error
        x = np.array([0.0, 1.0])
        curves = [Curve(x, x, "theirs", False), Curve(x, ours * x, "fractaljax", True)]
        return CaseResult(
            [stated("length [m]", 1.0, ours, 0.01)], [Panel("x [m]", "y [m]", curves)]
        )

    return Case("fake", "A fake", "Nobody, J. Null 1, 1 (1900)", "10.0/0", compute, lambda: missing)


@pytest.fixture
def only(monkeypatch, tmp_path):
    """Make one case the only one there is; commands run in an empty folder."""
    monkeypatch.chdir(tmp_path)

    def know(case):
        monkeypatch.setattr(module, "case_names", lambda: {case.name: case})

    return know


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
        (1.0, None, 0.005, None, None),
    ],
)
def test_a_number_agrees_within_its_tolerance(published, ours, tolerance, difference, agrees):
    check = Check("q [-]", published, ours, tolerance, "stated")
    assert check.difference == pytest.approx(difference, abs=1e-12, nan_ok=True)
    assert check.agrees is agrees


def test_two_cases_and_their_table():
    """Critical friction over K_t/K_n, and Mindlin's ratio."""
    both = validated("source_onset", "campana")
    assert both.agrees and list(both.cases) == ["source_onset", "campana"]
    text = repr(both)
    titles = ["case", "published", "ours", "difference", "tolerance", "basis", "result"]
    assert all(word in text.splitlines()[0] for word in titles)
    row = "critical mu, K_n = 4e+08 N/m, kappa = 0.5 [-]  0.2355232506"
    assert row in re.sub("  +", "  ", text)
    assert "printed as unchanged at 0.15" in text  # the misprint
    assert text.count("source_onset") == 2  # beside its first row, and in its note
    assert text.endswith("7 numbers of 2 cases agree.")
    names, rows = both.rows()
    assert len(rows) == 7 and all(len(row) == len(names) for row in rows)
    assert {row[-1] for row in rows} == {"ok"}
    for case in both.cases.values():
        assert_whole(fj.plot.validation(case))


INSIDE = "long\nx.EquinoxRuntimeError: mu must be above 0\nlong"  # of a compiled program


@pytest.mark.parametrize(
    ("case", "agrees", "words"),
    [
        (fake(), True, ["fake  length [m]  1  ", " ok", "1 number of 1 case agrees."]),
        (
            fake(1.01),
            False,
            ["DIFFERS", "+1.0e-02", "5.0e-03", "0 numbers of 1 case agree, 1 does"],
        ),
        (fake(missing="no disc"), True, ["NOT RUN", "- fake: not run: no disc", "1 not run."]),
        (fake(error=RuntimeError("no cycle\nat all")), False, ["FAILS", "- fake: no cycle\n"]),
        (fake(error=RuntimeError(INSIDE)), False, ["FAILS", "- fake: mu must be above 0\n"]),
    ],
)
def test_verdicts(only, case, agrees, words):
    only(case)
    result = fj.validate(progress=False)
    assert result.agrees is agrees
    for word in words:
        assert word in repr(result)


def test_defects_are_not_hidden(only):
    only(fake(error=KeyError("x")))
    with pytest.raises(KeyError):
        fj.validate(progress=False)


def test_refusals_and_tolerances():
    with pytest.raises(ValueError, match=r"^no case 'nobody'; .* source_stiffness, .*brake$"):
        fj.validate("nobody")
    with jax.enable_x64(False), pytest.raises(ValueError, match="validate needs 64 bits"):
        fj.validate("campana")
    with pytest.raises(TypeError, match="progress must be True or False"):
        fj.validate("campana", progress=1)  # type: ignore[arg-type]
    # Half of the last digit printed; a closed form relative to its own size.
    assert stated("q [m]", 0.15, 0.154, 0.01).agrees
    assert not stated("q [m]", 0.15, 0.156, 0.01).agrees
    assert closed("q [m]", -4.0, -4.0003, 1e-4).agrees
    assert not closed("q [m]", -4.0, -4.0005, 1e-4).agrees


def test_the_brake_says_what_it_lacks_and_who_is_unknown(monkeypatch, tmp_path, capsys):
    monkeypatch.delenv("FRACTALJAX_BRAKE", raising=False)
    without = fj.validate("brake", progress=False)
    assert without.agrees and "not run: no matrices: set FRACTALJAX_BRAKE" in repr(without)
    with pytest.raises(ValueError, match="brake has no curves: not run"):
        fj.plot.validation(without.cases["brake"])
    monkeypatch.setenv("FRACTALJAX_BRAKE", str(tmp_path))
    (tmp_path / "BMLL.npz").touch()
    reason = fj.validate("brake", progress=False).cases["brake"].reason
    assert "no BDLL, BYLL" in reason and "BMLL," not in reason
    monkeypatch.chdir(tmp_path)
    said = refused_command(capsys, "validate", "nobody", "--out", "gallery")
    assert said.startswith("no case 'nobody'; the cases are ") and not Path("gallery").exists()


def test_command(capsys, only):
    """Exit status 0 where all agrees, the table, and files where they are asked for."""
    only(fake())
    status, out, _ = run(capsys, "validate", "fake", "--quiet")
    assert (status, out) == (0, f"{fj.validate(progress=False)!r}\n")
    assert not list(Path().iterdir())
    status, out, err = run(capsys, "validate", "--out", "gallery")
    assert status == 0 and "fake" in err  # the progress
    assert out.endswith("written to gallery: fake.png, validation.csv\n")
    assert Path("gallery/fake.png").read_bytes().startswith(b"\x89PNG")
    with open("gallery/validation.csv", newline="") as file:
        titles, row = csv.reader(file)
    assert titles[:4] == ["case", "quantity", "published", "ours"] and row[1] == "length [m]"


@pytest.mark.parametrize("case", [fake(1.01), fake(error=RuntimeError("no cycle"))])
def test_command_ends_with_1_where_one_differs(capsys, only, case):
    only(case)
    status, out, _ = run(capsys, "validate", "--quiet", "--out", "gallery")
    assert status == 1 and ("DIFFERS" in out or "FAILS" in out)
    assert Path("gallery/validation.csv").exists()


def test_every_case_names_its_source_and_is_on_the_page():
    cases = module.case_names()
    modules = [sys.modules[f"fractaljax._validate.{name}"] for name in module._MODULES]
    assert len(cases) == sum(len(each.CASES) for each in modules)
    for name, case in cases.items():
        assert case.doi is None or re.fullmatch(r"10\.\d{4,}/\S+", case.doi)
        assert case.citation in PAGE and f"## {case.title}\n\n`{name}`: " in PAGE
        assert case.doi is None or f"(https://doi.org/{case.doi})" in PAGE
        picture = script().picture_of(name)
        assert f"]({picture.name})" in PAGE
        assert picture.read_bytes().startswith(b"\x89PNG") and picture.stat().st_size < 60_000
    assert {name for name, case in cases.items() if case.doi is None} == {"papangelo"}
    assert rows_as_on_the_page(validated("source_onset", "campana")) == 7


def cells(text):
    """The rows of the Markdown table in a section of the page."""
    rows = [line for line in text.splitlines() if line.startswith("| ")]
    return [row.strip("| ").split(" | ") for row in rows[1:]]


def rows_as_on_the_page(validation) -> int:
    """How many rows are: published numbers to the letter, ours to the tolerance."""
    compared = 0
    for case in validation.cases.values():
        if case.reason:
            continue
        committed = PAGE[PAGE.index(f"## {case.title}\n") :].partition("\n## ")[0]
        now = script().section(case)
        assert committed.partition("\n| ")[0] == now.partition("\n| ")[0]
        for check, shown, row in zip(case.checks, cells(committed), cells(now), strict=True):
            assert [shown[i] for i in (0, 1, 3, 4)] == [row[i] for i in (0, 1, 3, 4)]
            assert not check.note or f"- {check.quantity}: {check.note}." in committed
            if check.ours is None:
                assert shown == row
                continue
            assert abs(float(shown[2]) - check.ours) <= (check.tolerance or 1e-3 * abs(check.ours))
            percent = [re.fullmatch(r"(\d+)%", cell) for cell in (shown[5], row[5])]
            if all(percent):
                assert abs(int(percent[0][1]) - int(percent[1][1])) <= 5  # type: ignore[index]
            else:
                assert shown[5] == row[5] == "within"
            compared += 1
    return compared


@pytest.mark.slow
def test_all_agree_with_numbers_and_pictures_of_the_page(tmp_path):
    """One test: two workers would compute all cases twice."""
    everything = validated()
    assert everything.agrees, repr(everything)
    assert len(everything.cases) == 16
    for name, case in everything.cases.items():
        assert case.checks or (name == "brake" and "FRACTALJAX_BRAKE" in case.reason)
        assert all(check.basis in BASES for check in case.checks)
        assert all(re.search(r" \[\S+\]$", check.quantity) for check in case.checks)
        assert len({check.quantity for check in case.checks}) == len(case.checks)
        if case.panels:
            figure = fj.plot.validation(case)
            assert_whole(figure)
            (tmp_path / "now.png").write_bytes(script().small_png(figure))
            assert_same_picture(tmp_path / "now.png", script().picture_of(name).name)
    assert rows_as_on_the_page(everything) >= 69
