"""Then, Round and When: what comes before what."""

from __future__ import annotations

from collections.abc import Sequence
from typing import override

from lerobot_memobench.tasks.nodes.node import Node, Read


class ThenNode(Node):
    """Counts how long the current child has held; the next child is first looked at in the step after."""

    def __init__(self, parts: Sequence[Node], hold_steps: int) -> None:
        super().__init__(parts)
        self.hold_steps = hold_steps
        self.done = self.held = 0

    @override
    def reset(self) -> None:
        super().reset()
        self.done = self.held = 0

    @override
    def value(self, read: Read) -> bool:
        if self.done < len(self.parts):
            self.held = self.held + 1 if self.parts[self.done].value(read) else 0
            if self.held >= self.hold_steps:
                self.done, self.held = self.done + 1, 0
        return self.done == len(self.parts)

    @property
    @override
    def settled(self) -> bool | None:
        if self.done == len(self.parts):
            return True
        return False if any(part.settled is False for part in self.parts[self.done :]) else None

    @property
    @override
    def memory(self) -> tuple[int, ...]:
        return self.done, self.held


class RoundNode(Node):
    """The next part is first looked at in the step after; with a new round all parts begin anew."""

    done = 0

    @override
    def reset(self) -> None:
        super().reset()
        self.done = 0

    @override
    def value(self, read: Read) -> bool:
        self.done += self.parts[self.done].value(read)
        complete = self.done == len(self.parts)
        if complete:
            self.reset()
        return complete

    @property
    @override
    def settled(self) -> bool | None:
        return False if any(part.settled is False for part in self.parts[self.done :]) else None

    @property
    @override
    def memory(self) -> tuple[int, ...]:
        return (self.done,)


class WhenNode(Node):
    """The first moment of the first part decides, by the second part's value in that step."""

    decided: bool | None = None

    @override
    def reset(self) -> None:
        super().reset()
        self.decided = None

    @override
    def value(self, read: Read) -> bool:
        moment, then = [part.value(read) for part in self.parts]
        if self.decided is None and moment:
            self.decided = then
        return self.decided is True

    @property
    @override
    def settled(self) -> bool | None:
        if self.decided is not None:
            return self.decided
        return False if any(part.settled is False for part in self.parts) else None

    @property
    @override
    def memory(self) -> tuple[int, ...]:
        return (-1 if self.decided is None else int(self.decided),)
