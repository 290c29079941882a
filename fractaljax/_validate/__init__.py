"""The self-check of an installation: closed forms and published numbers beside ours."""
