"""Sweeps over more and more points."""
