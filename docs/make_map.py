"""Draw map.png: where a mass on a belt may squeal, `python docs/make_map.py`."""

from pathlib import Path

import jax

import fractaljax as fj

PICTURE = Path(__file__).with_name("map.png")


def belt() -> fj.Structure:
    """x'' + 0.1 x' + x = mu(w) sgn(w), w = v - x', mu = 0.5 + (mu_s - 0.5) exp(-2 w)."""
    law = fj.ExponentialStribeck(mu_s=1.0, mu_d=0.5, v_0=0.5)
    joint = fj.Joint(fj.FixedContact(1.0, 0.0, P=1.0), law, tangential=[1.0], V=1.0)
    return fj.Structure(M=[[1.0]], C=[[0.1]], K=[[1.0]], joints=[joint])


def draw(path=PICTURE, **options) -> fj.BifurcationMap:
    """Hopf boundary and grazing over the speed of the belt and static friction."""
    window = ("V", 0.5, 2.5), ("mu_s", 0.6, 1.4)
    found = fj.bifurcation_map(belt(), *window, **options, progress=False)
    ax = fj.plot.bifurcation_map(found)
    ax.figure.set_size_inches(7.2, 4.8)
    ax.figure.savefig(path, dpi=110)
    return found


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    draw(starts=8, lines=9)
