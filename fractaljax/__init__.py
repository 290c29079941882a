"""From a machined surface to a stable mechanism, with gradients all the way back."""

from ._base import process  # before JAX starts, so that every fork of this process has its mark
from ._base.lazy import make_lazy

make_lazy(__name__)
del make_lazy, process
