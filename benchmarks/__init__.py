"""Run time beside error: `python -m benchmarks`."""
