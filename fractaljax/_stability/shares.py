"""What each part of a mechanism does to its modes: its share of the energy, and of the growth rate.

With x^H (s^2 M + s C + K) x = 0, s = sigma + i omega, and m = x^H M x, c_i = x^H C_i x and
k_i = x^H K_i x of parts i, m being real, the imaginary part is

    sigma (2 omega m + Im c) = -sum_i (omega Re c_i + Im k_i),

so that part i contributes -(omega Re c_i + Im k_i)/(2 omega m + Im c) to the growth rate: damping
by Re c_i, friction and other circulatory forces by Im k_i, and so does structural damping, of which
K is K + i K_loss. Gyroscopic terms contribute nothing. The work of these forces in a period is the
same numbers times 2 pi (2 omega m + Im c).
"""

from collections.abc import Mapping
from typing import Any

import equinox as eqx
import numpy as np
from jaxtyping import Complex, Float

from .._base.parts import Record, flag, require_kind
from .._base.table import aligned
from .._mechanism.coefficient import evaluated
from .._mechanism.quantities import require_no_memory, require_one
from .._mechanism.scene import Scene
from .._mechanism.structure import Structure
from .snapshots import joint_numbers
from .stability import Stability, stability


class EnergyShares(Record):
    """Shares of `parts` in k modes, as `energy_shares` returns them; its repr is a table.

    The table shows the unstable modes and the eight least damped of the others: which part adds
    most to the growth rate of each, and which takes most off it.
    """

    parts: tuple[str, ...] = eqx.field(static=True)
    eigenvalues: Complex[np.ndarray, " k"]  # [1/s], as `Stability` orders them
    strain: Float[np.ndarray, "k parts"]  # Re k_i / Re k, which sum to 1
    kinetic: Float[np.ndarray, "k parts"]  # m_i / m, which sum to 1
    growth: Float[np.ndarray, "k parts"]  # [1/s], which sum to the growth rate

    def __repr__(self) -> str:
        lines = [["frequency [Hz]", "growth rate [1/s]", "fed by", "damped by", "strain energy in"]]
        s: Any = self.eigenvalues
        unstable = np.flatnonzero(s.real > 0)
        others = [i for i in np.argsort(-s.real / np.abs(s)) if i not in unstable]
        for i in [*unstable, *others[:8]]:
            row, most = self.growth[i], int(self.strain[i].argmax())
            rounding = 1e-9 * abs(s[i])  # a smaller contribution counts as none
            fed, damped = (
                f"{self.parts[k]} {row[k]:+.3g}" if sign * row[k] > rounding else "-"
                for k, sign in ((int(row.argmax()), 1), (int(row.argmin()), -1))
            )
            share = f"{self.parts[most]} {self.strain[i, most]:.0%}"
            lines.append([f"{s[i].imag / 2 / np.pi:.6g}", f"{s[i].real:.4g}", fed, damped, share])
        return aligned(lines)


def energy_shares(
    x: Scene | Structure,
    modes: Stability | None = None,
    *,
    friction_slope: bool = True,
    names: Mapping[str, str] | None = None,
) -> EnergyShares:
    """Energy and contribution to the growth rate of each part, in each mode that oscillates.

    Parts are the terms of M, C, K and K_loss, "K" or "K 1", "K 2", ... where it is a sum, and the
    joints by their names. A joint acts through its springs, its friction and the slope of its
    friction law.

    The sum of the contributions is the growth rate, as exactly as shapes are known. Where
    gyroscopic modes coalesce, 2 omega m + Im c passes through 0 and they grow without bound. For a
    structure that `reduce` made obliquely (`Reduction.W` is not `V`), shares are of forms in its
    coordinates, not of energies.

    **Arguments:**

    - `x`: a scene or structure of scalars.
    - `modes`: `stability(x, friction_slope)`, if already computed.
    - `friction_slope`: False leaves the slope of friction out.
    - `names`: {part: other name}, such as {"K 2": "pad"}; parts of one name are added up. By
      default parts keep their names.

    **Returns:** `EnergyShares`.

    **Raises:** `TypeError` for what is neither a scene nor a structure; `ValueError` for a name of
    no part, for modes of another size, and as `stability`.
    """
    require_one("x", x)
    flag("friction_slope", friction_slope)
    require_no_memory(x)
    modes = stability(x, friction_slope) if modes is None else modes
    require_kind("modes", modes, Stability)
    structure = x.as_structure()
    s: Any = np.asarray(modes.eigenvalues)
    shapes, counted = np.asarray(modes.shapes), np.asarray(modes.counted)
    if shapes.shape != (2 * structure.n, structure.n):
        raise ValueError(f"modes must be of {structure.n} degrees of freedom, got {shapes.shape}")
    kept = counted & (s.imag > 0)
    s, shapes = s[kept], shapes[kept]
    forms = _forms(structure, shapes, friction_slope)
    names = dict(names or {})
    if unknown := sorted(names.keys() - forms.keys()):
        raise ValueError(f"names must be of {', '.join(forms)}, got {unknown[0]!r}")
    parts = tuple(dict.fromkeys(names.get(part, part) for part in forms))
    summed: Any = np.zeros((3, len(s), len(parts)), complex)
    for part, part_forms in forms.items():
        column = parts.index(names.get(part, part))
        for total, form in zip(summed, part_forms, strict=True):
            total[:, column] += form
    m, c, k = summed
    omega = s.imag[:, None]
    work = omega * c.real + k.imag
    inertia = 2 * omega * m.real.sum(axis=1, keepdims=True) + c.imag.sum(axis=1, keepdims=True)
    return EnergyShares(
        parts=parts,
        eigenvalues=s,
        strain=k.real / k.real.sum(axis=1, keepdims=True),
        kinetic=m.real / m.real.sum(axis=1, keepdims=True),
        growth=-work / inertia,
    )


def _forms(structure: Structure, x: np.ndarray, friction_slope: bool) -> dict[str, Any]:
    """(m, c, k) of each part for shapes x (k, n), each a number or (k,)."""
    forms = {}
    for name, held in structure.sums.items():
        place, unit = {"M": (0, 1), "C": (1, 1), "K": (2, 1), "K_loss": (2, 1j)}[name]
        terms = list(zip(held.coefficients, held.arrays, strict=True))
        for i, (coefficient, X) in enumerate(terms, start=1):
            value = evaluated(coefficient, structure.parameters)
            form = np.einsum("ki,ki->k", x.conj(), x @ np.asarray(X).T)
            form = unit * form * (1.0 if value is None else float(value))
            part = name if len(terms) == 1 else f"{name} {i}"
            forms[part] = [form if place == other else 0.0 for other in range(3)]
    attached = np.asarray(joint_numbers(structure, friction_slope))
    for name, joint, by in zip(structure.joint_names, structure.joints, attached, strict=True):
        K_n, K_t, mu, c_t, c_n = by
        t = x @ structure.direction(joint.tangential)
        n = 0 * t if joint.normal is None else x @ structure.direction(joint.normal)
        # As `assemble` adds them.
        c = c_t * np.abs(t) ** 2 + c_n * np.abs(n) ** 2
        k = K_t * np.abs(t) ** 2 + K_n * np.abs(n) ** 2
        k = k - mu * K_n * t.conj() * n + mu * K_t * n.conj() * t
        forms[f"joint {name}" if name in forms else name] = [0.0, c, k]
    return forms
