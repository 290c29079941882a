"""Kinds of normal force of a joint; a kind is added here alone."""

import abc
from typing import Any, ClassVar

import equinox as eqx

from .._base.parts import Numbers
from .._contact.load_curve import LoadTable, tabulated


class JointForce(eqx.Module):
    """The normal force N of a joint over its approach.

    The approach e is from rest under the load P, in units of P over the stiffness there, so that
    N/P = 1 + e to first order. Leaves may have further axes for lanes.
    """

    opens: ClassVar[bool] = True  # the joint can open, at e = -opening
    linear: ClassVar[bool] = False  # N/P = 1 + e, also without a load P

    @property
    @abc.abstractmethod
    def opening(self) -> Numbers | float:
        """The approach that the joint has lost where N = 0."""

    @abc.abstractmethod
    def __call__(self, e: Numbers) -> Numbers:
        """N/P at e."""


class OpeningSpring(JointForce):
    """A spring that only pushes: the joint opens where it would pull."""

    linear: ClassVar[bool] = True

    @property
    def opening(self) -> Numbers | float:
        """Where a spring has no load."""
        return 1.0

    def __call__(self, e: Numbers) -> Numbers:
        """N/P at e."""
        return 1 + e


class TwoSidedSpring(OpeningSpring):
    """A spring that pushes and pulls, as in the source's form, or a constant load."""

    opens: ClassVar[bool] = False


class LoadCurveForce(JointForce):
    """The load curve of a contact law."""

    table: LoadTable

    @property
    def opening(self) -> Numbers | float:
        """Where the curve begins."""
        return self.table.opening

    def __call__(self, e: Numbers) -> Numbers:
        """N/P at e."""
        return self.table(e)


def joint_force(joint: Any) -> JointForce:
    """The normal force of a scene, or of a joint with a normal direction."""
    if not joint.preload:
        return TwoSidedSpring()
    if not joint.follows_load_curve:
        return OpeningSpring()
    law = joint.friction
    return LoadCurveForce(tabulated(joint.contact.load_curve(law.mu_s, law.mu_m)))
