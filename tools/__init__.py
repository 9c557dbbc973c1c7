"""Programs of the project's maintainers, run from a checkout with ``python -m tools.<name>``."""
