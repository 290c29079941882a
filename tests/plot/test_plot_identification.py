"""What the pictures of a measured spectrum show."""

import numpy as np
import pytest
from matplotlib.figure import Figure

import fractaljax as fj
from synthetic import DX, gaussian_map, gaussian_profile


@pytest.fixture(scope="module")
def found():
    z = gaussian_profile(np.random.default_rng(0), 2.5, 2048)
    return fj.identify(z, DX, resolution=4e-6)


def test_identification_picture(found):
    """Units, bins, fit over the band alone, second opinion and limit; nothing cut off."""
    ax = fj.plot.identification(found)
    assert ax.get_xlabel() == "frequency f [1/m]"
    assert ax.get_ylabel() == "power spectral density of the profile [m³]"
    assert ax.get_xscale() == ax.get_yscale() == "log"
    texts = [text.get_text() for text in ax.get_legend().get_texts()]
    assert texts[:2] == ["measured", "means over bins"]
    assert texts[2].startswith(f"D = {found.D:.3f} ± ") and texts[3].startswith("structure")
    assert texts[4] == "instrument's limit 6.25e+04 1/m"
    fit = next(line for line in ax.lines if str(line.get_label()).startswith("D = "))
    np.testing.assert_allclose(fit.get_xdata()[[0, -1]], found.band)
    np.testing.assert_allclose(fit.get_ydata(), found.law(fit.get_xdata()))
    ax.figure.draw_without_rendering()
    for artist in (ax, ax.get_legend()):
        box = artist.get_tightbbox()
        assert ax.figure.bbox.x0 <= box.x0 and box.x1 <= ax.figure.bbox.x1
        assert ax.figure.bbox.y0 <= box.y0 and box.y1 <= ax.figure.bbox.y1


def test_power_spectrum_picture(found):
    """The ordinates themselves, on axes that are given."""
    ax = Figure().add_subplot()
    assert fj.plot.power_spectrum(found, ax) is ax
    np.testing.assert_array_equal(ax.lines[0].get_ydata(), found.spectrum.power)
    of_map = fj.identify(gaussian_map(np.random.default_rng(0), shape=(64, 64)), DX)
    assert "of the map" in fj.plot.power_spectrum(of_map).get_ylabel()
