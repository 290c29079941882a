"""The roughness parameters that drawings hold, of heights or expected of a spectrum."""

from jaxtyping import Array, Float

from .._base.parts import Record


class ProfileParameters(Record):
    """Roughness parameters of a profile by ISO 21920-2 (before, ISO 4287 and ISO 13565-2)."""

    Ra: Float[Array, "..."]  # arithmetic mean height [m]
    Rq: Float[Array, "..."]  # root mean square height [m]
    Rz: Float[Array, "..."]  # maximum height, mean over the sections [m]
    Rp: Float[Array, "..."]  # peak height, mean over the sections [m]
    Rv: Float[Array, "..."]  # pit depth, mean over the sections [m]
    Rt: Float[Array, "..."]  # total height, over the whole evaluation length [m]
    Rsk: Float[Array, "..."]  # skewness [-]
    Rku: Float[Array, "..."]  # kurtosis [-]
    Rdq: Float[Array, "..."]  # root mean square gradient, rise over run [-]
    RSm: Float[Array, "..."]  # mean width of the profile elements [m]
    Rk: Float[Array, "..."]  # core height [m]
    Rpk: Float[Array, "..."]  # reduced peak height [m]
    Rvk: Float[Array, "..."]  # reduced pit depth [m]
    Mr1: Float[Array, "..."]  # material ratio of the peaks [%]
    Mr2: Float[Array, "..."]  # material ratio above the pits [%]


class ArealParameters(Record):
    """Roughness parameters of a map by ISO 25178-2."""

    Sa: Float[Array, "..."]  # arithmetic mean height [m]
    Sq: Float[Array, "..."]  # root mean square height [m]
    Sz: Float[Array, "..."]  # maximum height, Sp + Sv [m]
    Sp: Float[Array, "..."]  # maximum peak height [m]
    Sv: Float[Array, "..."]  # maximum pit depth [m]
    Ssk: Float[Array, "..."]  # skewness [-]
    Sku: Float[Array, "..."]  # kurtosis [-]
    Sdq: Float[Array, "..."]  # root mean square gradient, rise over run [-]
    Sdr: Float[Array, "..."]  # developed interfacial area ratio [%]
    Sal: Float[Array, "..."]  # autocorrelation length [m]
    Str: Float[Array, "..."]  # texture aspect ratio, 1 for an isotropic surface [-]
    Sk: Float[Array, "..."]  # core height [m]
    Spk: Float[Array, "..."]  # reduced peak height [m]
    Svk: Float[Array, "..."]  # reduced pit depth [m]
    Smr1: Float[Array, "..."]  # material ratio of the peaks [%]
    Smr2: Float[Array, "..."]  # material ratio above the pits [%]
