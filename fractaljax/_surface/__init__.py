"""Fractal surfaces: their parameters, heights on a grid, roughness."""
