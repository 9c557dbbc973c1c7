"""The error class of this package."""


class RasterError(ValueError):
    """A model, state, camera or size that cannot be drawn; the message names it and what is expected."""
