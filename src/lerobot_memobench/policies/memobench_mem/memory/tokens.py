"""Memory tokens as they are read: by each row its own, or made once of what many rows remember."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

from torch import Tensor


class MemoryTokens(NamedTuple):
    """Tokens that B rows read, L each.

    Attributes:
        each: (B, L, d), or (U, P, d) of U frames.
        mask: (B, L) bool, which are real.
        places: (B, F), which of the U frames each row reads, with F P = L; None where ``each`` lies in rows.
    """

    each: Tensor
    mask: Tensor
    places: Tensor | None = None

    def through(self, made: Callable[[Tensor], Tensor]) -> MemoryTokens:
        """Return what is made of every token by itself."""
        return self._replace(each=made(self.each))

    def rows(self) -> Tensor:
        """Return what each row reads, (B, L, d)."""
        if self.places is None:
            return self.each
        return self.each.index_select(0, self.places.flatten()).unflatten(0, self.places.shape).flatten(1, 2)
