"""Surfaces: spectra, heights on a grid, roughness."""
