"""Neighbourhoods that a design must leave, or cross beyond one of two planes."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float


class Cuts(eqx.Module):
    """Excluded neighbourhoods of designs, each bounded by two planes.

    Within `reach` of a centre a design must be beyond one of its planes.
    """

    centres: Float[Array, "k v"]
    normals: Float[Array, "k 2 v"]
    gaps: Float[Array, "k 2"]  # distances of the planes from the centre, infinite without one
    reach: Float[Array, " k"]

    @classmethod
    def none(cls, count: int, u: Array) -> "Cuts":
        """Room for `count` cuts of designs like u (v,), none of which excludes anything."""
        zeros = jnp.zeros((count, len(u)), u.dtype)
        gaps = jnp.full((count, 2), jnp.inf, u.dtype)
        return cls(zeros - 10, jnp.stack([zeros, zeros], axis=1), gaps, jnp.zeros(count, u.dtype))

    def added(self, k: int, centre, normals, gaps, reach: float) -> "Cuts":
        """A copy with cut k set."""
        return Cuts(
            self.centres.at[k].set(centre),
            self.normals.at[k].set(normals),
            self.gaps.at[k].set(gaps),
            self.reach.at[k].set(reach),
        )

    def residuals(self, u: Float[Array, " v"]) -> Float[Array, " k"]:
        """At most 0 where no cut excludes the design."""
        offsets = u[None] - self.centres
        planes = jnp.min(self.gaps - jnp.einsum("kpv,kv->kp", self.normals, offsets), axis=1)
        distance = jnp.sqrt(jnp.sum(offsets**2, axis=1) + 1e-24)
        return 10 * jnp.minimum(planes, self.reach - distance)
