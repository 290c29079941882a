"""The generated pages say what their scripts say now."""

import re

import jax.numpy as jnp
import numpy as np
import pytest

import fractaljax as fj
from tools import DOCS, assert_same_picture, load_script

MEASURED = re.compile(r"\d\.?\d*e[+-]\d\d")
FACTOR = 3  # rounding differs from machine to machine


@pytest.fixture(scope="module")
def pages():
    """The committed page and the one generated now."""
    script = load_script(DOCS / "make_float32.py")
    return script.PAGE.read_text(encoding="utf-8"), script.page()


def test_float32_page_has_the_text_that_its_script_generates(pages):
    committed, now = (MEASURED.sub("#", page) for page in pages)
    assert committed == now


def test_float32_page_has_the_numbers_that_are_measured_now(pages):
    committed, now = ([float(x) for x in MEASURED.findall(page)] for page in pages)
    assert len(committed) == len(now) > 50
    assert now == pytest.approx(committed, rel=FACTOR - 1, abs=0)
    assert committed == pytest.approx(now, rel=FACTOR - 1, abs=0)


def test_identification_is_drawn_as_it_is_shown_and_finds_the_surface(tmp_path):
    found = load_script(DOCS / "make_identification.py").draw(tmp_path / "identification.png")
    assert_same_picture(tmp_path / "identification.png", "identification.png")
    truth = fj.brake_scene().contact.surface
    off = np.array([found.D - truth.D, np.log(found.G) - jnp.log(truth.G)])
    assert off @ np.linalg.solve(found.covariance, off) < 6  # 95 percent of two numbers
