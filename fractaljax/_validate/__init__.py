"""Published results beside ours. Each module holds the cases of one subject."""
