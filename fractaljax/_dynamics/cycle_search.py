"""The options of the search for a limit cycle."""

import dataclasses

from .._base.options import check_numbers


@dataclasses.dataclass(frozen=True)
class CycleSearch:
    """How `limit_cycle` and `attractors` search; the defaults suit most mechanisms.

    The search runs the motion coarsely in rounds of steps and compares its returns to the section
    after each round. It solves for a periodic orbit where the returns nearly repeat. Distances are
    in scaled units, in which lengths are in V/omega, velocities in V and times in 1/omega, with the
    V of the first joint and omega as in `limit_cycle`. Those that are relative are in units of 1
    plus the largest component of the state; between returns also of at most four times the distance
    from the equilibrium. A change that makes the search more careful makes it slower.

    **Fields, of the coarse run:**

    - `step`: its longest step [1/omega]. A shorter one follows the boundary between two basins
      more exactly.
    - `round_steps`: steps in a round. With more of them the comparisons cost less, and an end is
      noticed later.
    - `finer_after`: rounds after which the step is halved, and halved again after three times as
      many: a run that takes long to settle may be near the boundary of two basins.
    - `round_returns`: returns that count as a round with more than 8 degrees of freedom, where one
      return may take many rounds. More of them delay the halving and `single_after`.
    - `kept_steps`: least number of steps that are kept; a period has to take fewer, or the result
      is `too_long`. More of them take more memory.
    - `idle_rounds`: rounds without a return after which the search gives up.

    **Fields, of what is near an orbit:**

    - `longest_period`: most returns in one period, at least 3. What repeats after more of them is
      `not_periodic`.
    - `near`: relative distance between returns below which an orbit is solved for. A larger one
      finds orbits sooner, with more solutions in vain.
    - `single_near`: relative distance that single returns, which approach one another
      geometrically, still have to go when their orbit is solved for. A smaller one waits longer.
    - `single_after`: rounds after which an orbit of one return need not be that near.
    - `nearly_repeats`: relative distance between returns below which a motion that is still
      settling after `max_returns` is `exhausted` instead of `not_periodic`.
    - `repeats`: relative distance between returns below which a motion has settled, so that a
      period without an orbit is `too_long` for the segments.

    **Fields, of the solution:**

    - `reach`: relative distance from the run beyond which Newton's method gives up. A larger one
      may find an orbit that the motion does not approach.
    - `meshes`: most meshes on which an orbit is solved, each finer than the last, until it is
      accurate to `rtol`.
    - `most_segments`: most segments that a period gets, outside of compiled programs, where
      `segments` is not given.
    - `group`: orbits solved together in a batch. More of them suit an accelerator, and wait for
      the slowest.

    **Fields, of the end:**

    - `accepted`: relative distance of the run from an orbit at which the orbit's multipliers decide
      whether it attracts. A larger one ends the search sooner, and may accept an orbit that the
      motion would have passed.
    - `approaches`: rounds in a row in which the motion approaches an orbit that is farther away
      than that, after which it is accepted.
    - `repelling`: growth per period, as the logarithm of the largest multiplier, up to which an
      orbit that repels is returned, as `unstable`. With a larger one weakly repelling orbits that
      the motion passes end the search.
    - `linear_size`: distance from the equilibrium below which a steady decay at nearly the linear
      rate ends in equilibrium.
    - `small_size`: distance from the equilibrium below which any decay without a change of contact
      state does so.
    - `rest_size`: distance from an attracting equilibrium, or rate of change with a joint open,
      below which the motion is at rest.

    **Raises:** `ValueError` for a count that is not a whole number of at least 1, and for any other
    field that is not above 0 and finite.
    """

    step: float = 0.3
    round_steps: int = 128
    finer_after: int = 16
    round_returns: int = 12
    kept_steps: int = 2048
    idle_rounds: int = 512
    longest_period: int = 16
    near: float = 0.15
    single_near: float = 0.06
    single_after: int = 4
    nearly_repeats: float = 0.02
    repeats: float = 1e-6
    reach: float = 0.5
    meshes: int = 6
    most_segments: int = 4096
    group: int = 16
    accepted: float = 0.03
    approaches: int = 3
    repelling: float = 1e-3
    linear_size: float = 0.5
    small_size: float = 1e-2
    rest_size: float = 1e-6

    def __post_init__(self):
        # The decay is judged by the last three returns and one before.
        check_numbers(self, least={"longest_period": 3})
