"""Random brakes in plane stress: a beam on a pad, 150 degrees of freedom, nine fractal joints."""

from typing import Any

import numpy as np

import fractaljax as fj
from tools import ROOT, load_script

PAIRS = [f"pair_{i}" for i in range(1, 10)]
BOUNDS: dict[str, tuple[float, float]] = {
    f"{pair}.{name}": ends
    for pair in PAIRS
    for name, ends in (("D", (2.1, 2.8)), ("G", (1e-11, 1e-7)))
}


def random_brake(seed: int) -> Any:
    """Sizes, materials, load and its shares, friction and damping are drawn by `seed`."""
    made, rng = load_script(ROOT / "notebooks" / "brakes.py"), np.random.default_rng(seed)

    def draw(low: float, high: float) -> float:
        return float(rng.uniform(low, high))

    beam = made.Material(draw(1e11, 2.1e11), draw(0.25, 0.32), draw(7000, 7900))
    pad = made.Material(draw(2e8, 8e8), draw(0.2, 0.3), draw(2200, 2800))
    brake = made.beam_on_pad(
        length=draw(0.15, 0.25),
        height=draw(0.008, 0.014),
        width=draw(0.03, 0.05),
        pad_height=draw(0.008, 0.016),
        beam=beam,
        pad=pad,
    )
    lining = fj.Material(E=draw(1e9, 4e9), nu=0.25, sigma_y=5e7, H=1.5e8)
    surface = fj.Surface(D=2.4, G=1e-8, gamma=1.5)
    tilt = draw(-0.5, 0.5) * np.linspace(-1, 1, 9)
    shares = brake.shares * (1 + tilt) * rng.uniform(0.8, 1.2, 9)
    load = draw(3000, 6000)
    joints = {}
    for name, pair, share in zip(PAIRS, brake.pairs, shares / shares.sum(), strict=True):
        contact = fj.FractalContact(surface, lining, P=load * float(share))
        joints[name] = fj.Joint(contact, fj.Coulomb(draw(0.35, 0.6)), *pair, V=1.0, preload=True)
    M, K = brake.matrices["M"], brake.matrices["K"]
    C = fj.rayleigh_damping(M, K, draw(10, 30), draw(1e-7, 5e-7))
    return fj.Structure(M, C, K, joints, names=brake.names)
