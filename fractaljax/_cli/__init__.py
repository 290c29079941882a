"""The commands of `fractaljax`. Each adds its own parser, which holds the function that it runs."""
