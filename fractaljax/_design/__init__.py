"""The nearest surface stable against small disturbances, over an envelope and with tolerances."""
