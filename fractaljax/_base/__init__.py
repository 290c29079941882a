"""Checked numbers, safe functions, batches and files: what every other package builds on."""
