"""The names that a BDDL file declares."""

from __future__ import annotations

from lerobot_memobench.tasks.bddl.sexpr import Node, Reader


class Names:
    """Declared names, found again in any case; no two may differ in case alone."""

    def __init__(self, reader: Reader) -> None:
        self._reader = reader
        self._declared: dict[str, tuple[str, str]] = {}

    def declare(self, node: Node, name: str, what: str) -> None:
        """Add a name that stands at ``node``; ``what`` it is, for the message when it comes again."""
        if name.lower() in self._declared:
            first = " ".join(self._declared[name.lower()])
            expected = f"another name, since {first} is there"
            raise self._reader.error(node, f"the name {name!r} declared again", expected)
        self._declared[name.lower()] = (what, name)

    def spelling(self) -> dict[str, str]:
        """Return lower case -> name as declared, of all names so far."""
        return {key: name for key, (_, name) in self._declared.items()}
