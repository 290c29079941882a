"""Den Hartog's friction damper: a mass on a harmonic force, with dry friction."""

import numpy as np

import fractaljax as fj

from .case import Case, CaseResult, Curve, Panel, closed


def _published(r, share):
    """Den Hartog's amplitude of motion without stops, over the deflection F/k; NaN beyond it.

    `r` is the frequency of the force over the natural one, `share` friction over its amplitude.
    """
    stop = np.sin(np.pi / r) / (r * (1 + np.cos(np.pi / r)))
    with np.errstate(invalid="ignore"):
        amplitude = np.sqrt((1 / (1 - r**2)) ** 2 - (share * stop) ** 2)
    # Where the mass turns, the spring and the force must overcome friction.
    return np.where(np.abs(amplitude * (1 - r**2) - amplitude) > share, amplitude, np.nan)


def _decay(r, share):
    """The product of the multipliers: at either reversal the acceleration changes by this ratio."""
    amplitude = _published(r, share)
    turning = amplitude * (1 - r**2) - amplitude  # the force less the spring's, over F
    return ((turning + share) / (turning - share)) ** 2


def _den_hartog() -> CaseResult:
    # The belt is all but at rest: its speed V moves the amplitude by 0.04 V^2.
    joint = fj.Joint(fj.FixedContact(1.0, 0.0, 1.0), fj.Coulomb(0.2), [1.0], V=1e-5, preload=True)
    damper = fj.Structure([[1.0]], [[0.0]], [[1.0]], joint)

    def cycle(r, share):
        force = fj.Excitation([1.0], r / (2 * np.pi))
        return fj.limit_cycle(damper.replace(mu=share), [2.0, 0.0], excitation=force)

    checks, curves = [], []
    for r, share in ((0.8, 0.2), (0.8, 0.5), (1.25, 0.2)):
        one, at = cycle(r, share), f"at r = {r:g}, friction {share:g} F"
        amplitude, product = one.amplitude[0] / 2, np.prod(np.asarray(one.multipliers)).real
        checks += [
            closed(f"amplitude {at} [F/k]", _published(r, share), amplitude, 1e-9),
            closed(f"product of the multipliers {at} [-]", _decay(r, share), product, 1e-9),
        ]
    for share in (0.2, 0.5, 0.7):
        below, above = np.linspace(0.55, 0.85, 13), np.linspace(1.2, 1.5, 9)
        both, label = np.concatenate([below, above]), f"friction {share:g} F"
        curves.append(Curve(both, _published(both, share), f"Den Hartog, {label}", False))
        for ratios, name in ((below, f"fractaljax, {label}"), (above, "")):
            amplitudes = [float(cycle(r, share).amplitude[0]) / 2 for r in ratios]
            curves.append(Curve(ratios, amplitudes, name, True))
    axes = "frequency ratio r [-]", "amplitude [F/k]"
    return CaseResult(checks, [Panel(*axes, curves)])


CASES = (
    Case(
        "den_hartog",
        "Friction damper under a harmonic force",
        "J. P. Den Hartog, Trans. ASME 53, APM-107 (1931)",
        None,
        _den_hartog,
    ),
)
