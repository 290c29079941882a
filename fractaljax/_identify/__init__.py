"""Measured surfaces: heights from instruments, and the fractal parameters they show."""
