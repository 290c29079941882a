"""What every other folder builds on: checked numbers, safe functions, batches, TOML files."""
