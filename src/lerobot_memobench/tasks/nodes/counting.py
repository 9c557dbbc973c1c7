"""Never, Hold and Exactly: how long, how often."""

from __future__ import annotations

from collections.abc import Sequence
from typing import override

from lerobot_memobench.tasks.nodes.node import Node, Read


class NeverNode(Node):
    """True until the part is once true."""

    broken = False

    @override
    def reset(self) -> None:
        super().reset()
        self.broken = False

    @override
    def value(self, read: Read) -> bool:
        now = self.parts[0].value(read)
        self.broken = self.broken or now
        return not self.broken

    @property
    @override
    def settled(self) -> bool | None:
        return False if self.broken else True if self.parts[0].settled is False else None

    @property
    @override
    def memory(self) -> tuple[int, ...]:
        return (int(self.broken),)


class HoldNode(Node):
    """True when the part has been true for the last ``number`` steps."""

    def __init__(self, parts: Sequence[Node], number: int) -> None:
        super().__init__(parts)
        self.number = number
        self.held = 0

    @override
    def reset(self) -> None:
        super().reset()
        self.held = 0

    @override
    def value(self, read: Read) -> bool:
        self.held = min(self.held + 1, self.number) if self.parts[0].value(read) else 0
        return self.held == self.number

    @property
    @override
    def settled(self) -> bool | None:
        found = self.parts[0].settled
        return None if found and self.held < self.number else found

    @property
    @override
    def memory(self) -> tuple[int, ...]:
        return (self.held,)


class ExactlyNode(Node):
    """True while the part has come true ``number`` times; counts to one more, all beyond is the same."""

    def __init__(self, parts: Sequence[Node], number: int) -> None:
        super().__init__(parts)
        self.number = number
        self.count, self.before = 0, False

    @override
    def reset(self) -> None:
        super().reset()
        self.count, self.before = 0, False

    @override
    def value(self, read: Read) -> bool:
        now = self.parts[0].value(read)
        self.count = min(self.count + (now and not self.before), self.number + 1)
        self.before = now
        return self.count == self.number

    @property
    @override
    def settled(self) -> bool | None:
        if self.count > self.number:
            return False
        found = self.parts[0].settled
        return self.count == self.number if found is not None and found == self.before else None

    @property
    @override
    def memory(self) -> tuple[int, ...]:
        return self.count, int(self.before)
