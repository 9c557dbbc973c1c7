"""And, Or, Not: nothing is remembered. Every part is asked in every step, since a nested operator must see it."""

from __future__ import annotations

from typing import override

from lerobot_memobench.tasks.nodes.node import Node, Read


class AndNode(Node):
    """True when all parts are."""

    @override
    def value(self, read: Read) -> bool:
        values = [part.value(read) for part in self.parts]
        return all(values)

    @property
    @override
    def settled(self) -> bool | None:
        found = [part.settled for part in self.parts]
        return False if False in found else None if None in found else True


class OrNode(Node):
    """True when some part is."""

    @override
    def value(self, read: Read) -> bool:
        values = [part.value(read) for part in self.parts]
        return any(values)

    @property
    @override
    def settled(self) -> bool | None:
        found = [part.settled for part in self.parts]
        return True if True in found else None if None in found else False


class NotNode(Node):
    """True when the part is not."""

    @override
    def value(self, read: Read) -> bool:
        return not self.parts[0].value(read)

    @property
    @override
    def settled(self) -> bool | None:
        found = self.parts[0].settled
        return None if found is None else not found
