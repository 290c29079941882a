"""Stability of steady sliding: eigenvalues, margin, boundaries and maps."""
