"""Profiles and maps whose D and G are known, in plain NumPy."""

import math

import numpy as np

D, G, DX = 2.5, 1e-9, 1e-6


def mean_cosine_power(p):
    """Mean of |cos a|^(p-1) over a."""
    return math.gamma(p / 2) / (math.sqrt(math.pi) * math.gamma((p + 1) / 2))


def gaussian_profile(rng, D=D, n=1024, G=G, dx=DX, finer=1, longer=8):
    """A part (n,) of a Gaussian profile with a period `longer` times as long.

    With `finer` it is sampled at every so many points of one with finer waves.
    """
    p, points, step = 7 - 2 * D, n * longer * finer, dx / finer
    f = np.fft.rfftfreq(points, step)
    S = np.zeros(f.size)
    S[1:] = mean_cosine_power(p) * G ** (2 * D - 4) / 2 * f[1:] ** -p
    waves = rng.standard_normal(f.size) + 1j * rng.standard_normal(f.size)
    z = np.fft.irfft(np.sqrt(S * f[1]) * waves, points) * points / 2
    first = rng.integers(0, points - n * finer)
    return z[first : first + n * finer : finer]


def gaussian_map(rng, D=D, shape=(192, 192), G=G, dx=DX, dy=DX):
    """A quarter of a periodic Gaussian map, (n, m)."""
    n, m = (2 * k for k in shape)
    f = np.hypot(np.fft.fftfreq(n, dx)[:, None], np.fft.rfftfreq(m, dy))
    f[0, 0] = np.inf
    S = G ** (2 * D - 4) / 2 * f ** (2 * D - 7) / (2 * math.pi * f)
    waves = np.fft.rfft2(rng.standard_normal((n, m)))
    z = np.fft.irfft2(waves * np.sqrt(S / (dx * dy)), (n, m))
    return z[: n // 2, : m // 2]


def _waves(L, L_s, gamma, M, D, G):
    """Frequencies, directions and amplitudes of Eq. 13, each (waves,)."""
    count = 1 + int(math.log(L / L_s) / math.log(gamma) + 1e-9)
    f, a = np.meshgrid(gamma ** np.arange(count) / L, np.pi * np.arange(1, M + 1) / M)
    f, a = f.ravel(), a.ravel()
    scale = L * (G / L) ** (D - 2) * math.sqrt(math.log(gamma) / M)
    return f, a, scale * (f * L) ** (D - 3)


def cut(rng, D=D, n=1024, G=G, dx=DX, gamma=1.5, M=10):
    """A cut (n,) through the surface of Eq. 13 in any direction."""
    f, a, amplitude = _waves(n * dx, 2 * dx, gamma, M, D, G)
    angle = rng.uniform(0, np.pi)
    phases = 2 * np.pi * dx * np.outer(np.arange(n), f * np.cos(a - angle))
    phases = phases + rng.uniform(0, 2 * np.pi, f.size)
    return -(np.cos(phases) @ amplitude)


def surface(rng, D=D, shape=(192, 192), G=G, dx=DX, dy=DX, gamma=1.5, M=10):
    """The surface of Eq. 13 on a grid (n, m), waves down to two points."""
    f, a, amplitude = _waves(shape[0] * dx, 2 * max(dx, dy), gamma, M, D, G)
    x, y = dx * np.arange(shape[0]), dy * np.arange(shape[1])
    along_x = np.exp(2j * np.pi * np.outer(x, f * np.cos(a)) + 2j * np.pi * rng.random(f.size))
    along_y = np.exp(2j * np.pi * np.outer(f * np.sin(a), y))
    return -((along_x * amplitude) @ along_y).real


def traced(z, dx, radius):
    """What a parabolic tip of a radius records: the heights of its centre over a profile."""
    reach = min(int(math.sqrt(2 * radius * np.ptp(z)) / dx) + 2, z.size - 1)
    seen = np.full(z.size, -np.inf)
    for k in range(-reach, reach + 1):
        first, last = max(0, -k), min(z.size, z.size - k)
        under = z[first + k : last + k] - (k * dx) ** 2 / (2 * radius)
        np.maximum(seen[first:last], under, out=seen[first:last])
    return seen


def rough(shape, seed=0, rms=3e-7, slope=1.8):
    """Heights [m] of random phases, periodic."""
    noise = np.fft.rfft2(np.random.default_rng(seed).normal(size=shape))
    x, y = np.fft.fftfreq(shape[0]) * shape[0], np.fft.rfftfreq(shape[1]) * shape[1]
    q = np.hypot(x[:, None], y)
    z = np.fft.irfft2(noise * np.where(q > 0, np.maximum(q, 1) ** -slope, 0), s=shape)
    return z * rms / z.std()
