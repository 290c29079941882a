"""The nearest surface that does not squeal, over an envelope and with tolerances."""
