"""Parse S-expressions, the syntax of BDDL, and keep line numbers for error messages."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass, field

from lerobot_memobench.errors import MemobenchError

_NUMBER = re.compile(r"[+-]?([0-9]+\.?[0-9]*|\.[0-9]+)([eE][+-]?[0-9]+)?")


@dataclass
class Node:
    """A word (``items`` is None) or a list; ``start`` and ``end`` delimit its source text."""

    line: int
    start: int
    end: int = -1
    word: str = ""
    items: list[Node] | None = None

    def __str__(self) -> str:
        if self.items is None:
            return repr(self.word if len(self.word) <= 40 else self.word[:37] + "...")
        return f"a list ({self.items[0].word[:40]} ...)" if self.items else "an empty list ()"


@dataclass
class Reader:
    """Parse the text of one file; `error` builds all error messages."""

    path: str
    text: str = field(repr=False)

    def where(self, node: Node) -> str:
        """Return the prefix of every message: "file, line n"."""
        return f"{self.path}, line {node.line}"

    def error(self, node: Node, found: str, expected: str) -> MemobenchError:
        """Return (do not raise) the error for an unexpected item at ``node``."""
        return MemobenchError(f"{self.where(node)}: found {found}, expected {expected}")

    def read(self) -> Node:
        """Return the single top-level list. The parser is iterative, so deep nesting cannot overflow the stack."""
        root = Node(line=1, start=0, items=[])
        stack, line, last = [root], 1, 0
        for match in re.finditer(r"[()]|[^\s()]+", self.text):
            line += self.text.count("\n", last, match.start())
            last = match.start()
            token, items = match.group(), stack[-1].items
            assert items is not None
            if token == ")":
                if len(stack) == 1:
                    raise self.error(Node(line, 0), "an unmatched ')'", "'(' before it or the end of the file")
                stack.pop().end = match.end()
                continue
            node = Node(line, match.start(), match.end(), token)
            items.append(node)
            if token == "(":
                node.word, node.items = "", []
                stack.append(node)
        if len(stack) > 1:
            raise self.error(stack[-1], "a '(' that is never closed", "a ')' for it before the end of the file")
        assert root.items is not None
        if len(root.items) != 1 or root.items[0].items is None:
            node = root.items[1] if len(root.items) > 1 else (root.items or [root])[0]
            found = "no text" if not root.items else str(node)
            raise self.error(node, found, "exactly one list (define (problem NAME) ...)")
        return root.items[0]

    def word(self, node: Node, expected: str) -> str:
        """Return the word at ``node``; raise if it is a list."""
        if node.items is not None:
            raise self.error(node, str(node), expected)
        return node.word

    def sequence(self, node: Node, expected: str) -> list[Node]:
        """Return the items of the list at ``node``; raise if it is a word."""
        if node.items is None:
            raise self.error(node, str(node), expected)
        return node.items

    def head(self, node: Node, expected: str) -> tuple[str, list[Node]]:
        """Split a list into its first word (lower case) and the rest."""
        items = self.sequence(node, expected)
        if not items:
            raise self.error(node, "an empty list ()", expected)
        return self.word(items[0], expected).lower(), items[1:]

    def numbers(self, node: Node, count: int, expected: str) -> tuple[float, ...]:
        """Return the ``count`` finite numbers of the list at ``node``."""
        items = self.sequence(node, expected)
        if len(items) != count:
            raise self.error(node, f"{len(items)} value(s)", expected)
        values = []
        for item in items:
            text = self.word(item, expected)
            value = float(text) if _NUMBER.fullmatch(text) else math.nan
            if not math.isfinite(value):
                raise self.error(item, repr(text), f"a finite number ({expected})")
            values.append(value)
        return tuple(values)
