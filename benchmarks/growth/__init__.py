"""The growth rate beside LAPACK and beside loops, value and gradient."""
