"""The exact law run until it repeats, from event to event: the best that an integrator can do.

Units are those of `transients`. The modes of both directions and the law's numbers are parameters
of heyoka's integrator, so that it is built once for all scenes.
"""

import functools
from collections.abc import Callable
from typing import Any

import numpy as np

from .transients import Extremes, Law

TOLERANCE = 1e-9  # of a step: gives cycles to 1e-12, tighter ones take longer for the same
REARMED = 1e-3  # time after the start of a slip, from which its end is looked for


@functools.cache
def _integrator(tolerance: float) -> Any:
    """heyoka's, with the events; six parameters of the modes, then `Law.numbers`."""
    import heyoka as hy  # pyright: ignore[reportMissingImports]

    f, k_1, k_2, c_1, c_2, n_1, n_2, mu, a, b = (hy.par[6 + i] for i in range(10))
    x_1, x_2, u_1, u_2 = hy.make_vars("x1", "x2", "u1", "u2")
    system, events = [(x_1, u_1), (x_2, u_2)], []
    for i, (u, load, own) in enumerate(
        [
            (u_1, n_1 * x_2, f - c_1 * u_1 - k_1 * x_1),
            (u_2, n_2 * x_1, -f - c_2 * u_2 - k_2 * x_2),
        ]
    ):
        sign, slips, armed = hy.par[i], hy.par[2 + i], hy.par[4 + i]
        w = 1 - u
        system.append((u, slips * (own + (sign * mu - a * w + b * (w * w * w)) * load)))
        events.append(hy.t_event(armed * w + (1 - armed)))  # a slip ends
        events.append(hy.t_event((1 - slips) * (mu * load + own) + slips))  # a stick ends
        events.append(hy.t_event((1 - slips) * (mu * load - own) + slips))
    events.append(hy.t_event(u_1))  # an extreme of x1
    return hy.taylor_adaptive(
        system, [0.0] * 4, t_events=events, pars=[1.0] * 16, tol=tolerance, fast_math=True
    )


def heyoka_events(
    law: Law, tolerance: float, periods: int, settled: float = 0.0
) -> Callable[[], Extremes]:
    """Taylor series between terminal events, over so many periods or until three maxima agree."""
    import heyoka as hy  # pyright: ignore[reportMissingImports]

    integrator, limit = _integrator(tolerance), hy.taylor_outcome.time_limit
    f, (k_1, k_2), (c_1, c_2), mu = law.f, law.k, law.c, law.mu
    force, k, c, n = (f, -f), (k_1, k_2), (c_1, c_2), law.n

    def run() -> Extremes:
        ta = integrator
        y, mode = ta.state, ta.pars
        ta.time, y[:], mode[:6], mode[6:] = 0.0, law.start, 1.0, law.numbers
        ta.reset_cooldowns()
        times, values, rearm = [], [], None
        while len(times) < 2 * periods + 1:
            outcome = ta.propagate_until(1e9 if rearm is None else rearm)[0]
            if outcome == limit:  # the new slip has left zero
                mode[4:6], rearm = mode[2:4], None
                continue
            i, kind = divmod(-int(outcome) - 1, 3)
            if i == 2:
                times.append(ta.time)
                values.append(y[0])
                last = values[-5::2]  # of a kind
                if len(times) > 5 and max(last) - min(last) < settled:
                    break
                continue
            y[2 + i] = 1.0
            if kind == 0:
                s = mode[i]
                own = force[i] - c[i] - k[i] * y[i]
                crosses = s * own - mu * n[i] * y[1 - i] > 0
                mode[i], mode[2 + i] = (-s, 1.0) if crosses else (0.0, 0.0)
                mode[4 + i] = mode[2 + i]
            else:
                mode[i], mode[2 + i] = (1.0 if kind == 1 else -1.0), 1.0
                rearm = ta.time + REARMED
        return np.array(times), np.array(values)

    return run
