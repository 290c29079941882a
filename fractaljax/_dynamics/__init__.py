"""Stick-slip motion in time, and its limit cycles."""
