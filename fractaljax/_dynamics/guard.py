"""Guards of a hybrid system, by number: what ends a step or a segment."""

from typing import Any, NamedTuple

# The section of the Poincare map is where t.u of the first face falls through 0, a maximum of t.x;
# in an excited system it is the maximum of the excitation, once in each of its periods. NONE: a
# step or segment that no guard ends; UNUSED: padding.
SECTION, NONE, UNUSED = 0, -1, -2


class GuardNumbers(NamedTuple):
    """Numbers of the guards: the section, two for each face, one for each joint that can open."""

    faces: int
    opening: tuple[int, ...]  # the joints that can open

    @property
    def count(self) -> int:
        """The number of guards, the section among them."""
        return 1 + 2 * self.faces + len(self.opening)

    def lower(self, face: Any) -> Any:
        """The first guard of a face, or of an array of them."""
        return 1 + 2 * face

    def upper(self, face: Any) -> Any:
        """The second guard of a face, or of an array of them."""
        return 2 + 2 * face

    def face(self, guard: Any) -> Any:
        """The face of a guard; no face's number for every other guard."""
        return (guard - 1) // 2

    def opening_guard(self, joint: int) -> int:
        """The guard at which a joint opens or closes."""
        return 1 + 2 * self.faces + self.opening.index(joint)

    def opens_joint(self, guard: Any) -> Any:
        """True for a guard at which a joint opens or closes."""
        return guard > 2 * self.faces
