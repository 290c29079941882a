"""Strict numerics for every test: 64 bits, no silent broadcasting, warnings are errors."""

import warnings

import jax

jax.config.update("jax_enable_x64", True)
jax.config.update("jax_numpy_rank_promotion", "raise")
jax.config.update("jax_numpy_dtype_promotion", "standard")


def pytest_configure(config):
    config.addinivalue_line("filterwarnings", "error")
    warnings.simplefilter("error")
