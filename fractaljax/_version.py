__version__ = "0.1.0"
NEWEST_TESTED_JAX = (0, 12)
