"""The commands of `fractaljax`, one a file: each adds its own parser, which holds what it runs."""
