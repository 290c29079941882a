"""From a machined surface to a stable mechanism, with gradients all the way back."""

from ._base.lazy import make_lazy

make_lazy(__name__)
del make_lazy
