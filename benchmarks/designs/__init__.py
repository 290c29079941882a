"""Whole designs beside derivative-free and gradient-based searches."""
