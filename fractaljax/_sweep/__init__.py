"""Quantities over grids, in batches."""
