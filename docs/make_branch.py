"""Draw branch.png: the cycles of a mass on a belt over its speed, `python docs/make_branch.py`."""

from pathlib import Path

import jax

import fractaljax as fj

PICTURE = Path(__file__).with_name("branch.png")


def belt() -> fj.Structure:
    """x'' + 0.1 x' + x = mu(w) sgn(w), w = v - x', mu = 0.5 + 0.5 exp(-2 w)."""
    law = fj.ExponentialStribeck(mu_s=1.0, mu_d=0.5, v_0=0.5)
    joint = fj.Joint(fj.FixedContact(1.0, 0.0, P=1.0), law, tangential=[1.0], V=1.0)
    return fj.Structure(M=[[1.0]], C=[[0.1]], K=[[1.0]], joints=[joint])


def draw(path=PICTURE, found: fj.Branch | None = None) -> None:
    """The branch from stick-slip through its grazing to the Hopf point."""
    found = fj.continue_cycle(belt(), "V", (0.5, 2.5)) if found is None else found
    ax = fj.plot.branch(found, label="speed of the belt V [m/s]")
    ax.figure.set_size_inches(7.2, 4.2)
    ax.figure.savefig(path, dpi=110)


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    draw()
