"""A peer for structures: one compiled loop from event to event, by numba, with a 5(4) pair.

It runs the transient of M x'' + C x' + K x = F with preloaded joints until its maxima of t.x of the
first joint repeat. Inside, time is in 1/omega, velocity in V of the first joint. A joint slips (its
sign), sticks (0) or is open (2); its law is mu_d + (mu_s - mu_d) exp(-|w|/v_0).
"""

import functools
from typing import Any

import diffrax
import numpy as np

OPEN = 2
MOST_STEPS = 2_000_000


@functools.cache
def loop():
    """The compiled loop."""
    import numba  # pyright: ignore[reportMissingImports]

    tableau = diffrax.Dopri5.tableau
    a = np.zeros((7, 7))
    for i, row in enumerate(tableau.a_lower):
        a[i + 1, : len(row)] = row
    b_error = np.asarray(tableau.b_error)
    jit = numba.njit(cache=False, fastmath=False)

    @jit
    def mu(w, law):
        return law[1] + (law[0] - law[1]) * np.exp(-abs(w) / law[2])

    @jit
    def free(y, s, system, out):
        """Accelerations without the forces of sticking joints; normal forces of all."""
        K, C, F, T, N, B, A, P, K_n, V, laws = system
        n, m = len(F), len(P)
        x, u = y[:n], y[n:]
        out[:] = F - K @ x - C @ u
        forces = np.empty(m)
        for j in range(m):
            forces[j] = 0.0 if s[j] == OPEN else P[j] + K_n[j] * (N[j] @ x)
            out += (P[j] - forces[j]) * A[j]
            if abs(s[j]) == 1:
                out += s[j] * mu(V[j] - T[j] @ u, laws[j]) * forces[j] * B[j]
        return forces

    @jit
    def held(s, acceleration, system):
        """The forces of sticking joints, 0 of others."""
        T, B = system[3], system[5]
        which = np.flatnonzero(s == 0)
        forces = np.zeros(len(s))
        if len(which):
            W, r = np.empty((len(which), len(which))), np.empty(len(which))
            for i in range(len(which)):
                r[i] = -T[which[i]] @ acceleration
                for k in range(len(which)):
                    W[i, k] = T[which[i]] @ B[which[k]]
            found = np.linalg.solve(W, r)
            for i in range(len(which)):
                forces[which[i]] = found[i]
        return forces

    @jit
    def field(y, s, system, out):
        B, n = system[5], len(system[2])
        out[:n] = y[n:]
        free(y, s, system, out[n:])
        if np.any(s == 0):
            forces = held(s, out[n:], system)
            for j in range(len(s)):
                if s[j] == 0:
                    out[n:] += forces[j] * B[j]

    @jit
    def guards(y, s, system, out):
        """Above zero while s lasts: two of each joint, and the section last."""
        T, N, P, K_n, V, laws = system[3], system[4], system[7], system[8], system[9], system[10]
        n, m = len(system[2]), len(P)
        acceleration = np.empty(n)
        sticks = np.any(s == 0)
        if sticks:
            free(y, s, system, acceleration)
            forces = held(s, acceleration, system)
        for j in range(m):
            load = P[j] + K_n[j] * (N[j] @ y[:n])
            out[2 * j + 1] = -load if s[j] == OPEN else load
            if s[j] == 0:
                out[2 * j] = mu(0.0, laws[j]) * load - abs(forces[j])
            elif s[j] == OPEN:
                out[2 * j] = 1.0
            else:
                out[2 * j] = s[j] * (V[j] - T[j] @ y[n:])
        out[2 * m] = T[0] @ y[n:]

    @jit
    def rk(y, h, k, s, system, end):
        for i in range(1, 7):
            end[:] = y
            for j in range(i):
                if a[i, j] != 0.0:
                    end += h * a[i, j] * k[j]
            field(end, s, system, k[i])

    @jit
    def between(theta, h, y, end, k, out):
        """The continuous extension of fourth order."""
        c = theta * (1 + theta * (-1337 / 480 + theta * (1039 / 360 - theta * 1163 / 1152)))
        out[:] = y + h * c * k[0]
        q = theta * theta
        out += h * 100 * q * (1054 / 9275 + theta * (-4682 / 27825 + theta * 379 / 5565)) / 3 * k[2]
        out += -h * 5 * q * (27 / 40 + theta * (-9 / 5 + theta * 83 / 96)) / 2 * k[3]
        out += h * 18225 * q * (-3 / 250 + theta * (22 / 375 - theta * 37 / 600)) / 848 * k[4]
        out += -h * 22 * q * (-3 / 10 + theta * (29 / 30 - theta * 17 / 24)) / 7 * k[5]

    @jit
    def switched(y, s, guard, system):
        """The contact state after a guard has vanished."""
        T, B, V = system[3], system[5], system[9]
        n, j = len(system[2]), guard // 2
        new = s.copy()
        if guard % 2:
            new[j] = (1 if V[j] - T[j] @ y[n:] >= 0 else -1) if s[j] == OPEN else OPEN
            return new
        acceleration, rate = np.empty(n), np.empty(2 * n)
        if s[j] == 0:
            free(y, s, system, acceleration)
            new[j] = 1 if held(s, acceleration, system)[j] > 0 else -1
            return new
        new[j] = -s[j]
        field(y, new, system, rate)
        if s[j] * (T[j] @ rate[n:]) <= 0:
            new[j] = 0
        # To rounding the velocity is the belt's.
        w = V[j] - T[j] @ y[n:]
        y[n:] += w / (T[j] @ B[j]) * B[j]
        return new

    @jit
    def run(y, s, system, rtol, near, most_returns):
        """Period, peak to peak of t.x, shares of stick and open, steps and returns."""
        n, m = len(system[2]), len(system[7])
        T, size = system[3], 2 * len(system[2])
        k, end, at = np.empty((7, size)), np.empty(size), np.empty(size)
        g, g_1, g_m = np.empty(2 * m + 1), np.empty(2 * m + 1), np.empty(2 * m + 1)
        last, before = np.zeros(size), np.zeros(size)
        t, h, returns, steps, began = 0.0, 0.01, 0, 0, 0.0
        low, high = np.inf, -np.inf
        shares, found = np.zeros((2, m)), np.zeros((2, m))
        field(y, s, system, k[0])
        guards(y, s, system, g)
        at_section = False
        while returns < most_returns and steps < MOST_STEPS:
            rk(y, h, k, s, system, end)
            error = np.zeros(size)
            for i in range(7):
                error += h * b_error[i] * k[i]
            off = np.max(np.abs(error)) / (rtol * (1 + np.max(np.abs(y))))
            if off > 1:
                h *= max(0.2, 0.9 * off**-0.2)
                continue
            steps += 1
            guards(end, s, system, g_1)
            between(0.5, h, y, end, k, at)
            guards(at, s, system, g_m)
            theta, which = 2.0, -1
            for i in range(2 * m + 1):
                if i == 2 * m and (at_section or g[i] <= 0):
                    continue
                low_end, high_end = 0.0, 0.0
                if g_m[i] < 0:
                    high_end = 0.5
                elif g_1[i] < 0:
                    low_end, high_end = 0.5, 1.0
                if high_end == 0.0:
                    continue
                for _ in range(60):
                    middle = (low_end + high_end) / 2
                    between(middle, h, y, end, k, at)
                    guards(at, s, system, g_m)
                    if g_m[i] < 0:
                        high_end = middle
                    else:
                        low_end = middle
                    if high_end - low_end < 1e-14:
                        break
                between(0.5, h, y, end, k, at)
                guards(at, s, system, g_m)
                if high_end < theta:
                    theta, which = high_end, i
            dt = h
            if which >= 0:
                dt = theta * h
                between(theta, h, y, end, k, at)
                end[:] = at
            for j in range(m):
                shares[0, j] += dt * (s[j] == 0)
                shares[1, j] += dt * (s[j] == OPEN)
            t += dt
            y[:] = end
            at_section = False
            if which == 2 * m:
                at_section = True
                returns += 1
                scale = 1 + np.max(np.abs(y))
                found[:] = shares
                period, extent = t - began, high - low
                if (
                    np.max(np.abs(y - last)) < near * scale
                    and np.max(np.abs(y - before)) < near * scale
                ):
                    break
                before[:] = last
                last[:] = y
                began, low, high = t, np.inf, -np.inf
                shares[:] = 0
            elif which >= 0:
                s = switched(y, s, which, system)
            position = T[0] @ y[:n]
            low, high = min(low, position), max(high, position)
            field(y, s, system, k[0])
            guards(y, s, system, g)
            for i in range(2 * m):
                g[i] = max(g[i], 0.0)
            h *= min(5.0, 0.9 * max(off, 1e-10) ** -0.2)
        return period, extent, found / period, steps, returns

    return run


def arguments(structure: Any) -> tuple[tuple, float, float]:
    """The numbers of the scaled system, omega [1/s] and V [m/s]."""
    n = structure.n
    M, C, K = (np.asarray(x, float) for x in (structure.M, structure.C, structure.K))
    T, N, P, K_n, V, laws = [], [], [], [], [], []
    for joint in structure.joints:
        T.append(structure.direction(joint.tangential))
        N.append(structure.direction(joint.normal))
        law, (stiff, _) = joint.friction, joint.stiffness()
        K_n.append(float(stiff))
        P.append(float(joint.normal_load))
        V.append(float(joint.V))
        laws.append([float(law.mu_s), float(law.mu_d), float(law.v_0)])
    T, N, P, K_n, V, laws = map(np.array, (T, N, P, K_n, V, laws))
    F = np.zeros(n) if structure.F is None else np.asarray(structure.F)
    bonded = np.linalg.solve(M, K + (N * K_n[:, None]).T @ N)
    omega = float(np.sum(bonded * bonded.T) ** 0.25)
    unit = omega * V[0]
    system = (
        np.linalg.solve(M, K) / omega**2,
        np.linalg.solve(M, C) / omega,
        np.linalg.solve(M, F) / unit,
        T,
        N,
        np.linalg.solve(M, T.T).T.copy(),
        np.linalg.solve(M, N.T).T.copy(),
        P / unit,
        K_n / omega**2,
        V / V[0],
        laws / [1, 1, V[0]],
    )
    return system, omega, V[0]
