"""Scenes and structures: materials, contact, friction, oscillator, and their quantities."""
