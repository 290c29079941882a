"""Every quantity at the edges of its range."""
