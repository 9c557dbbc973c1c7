"""Trees of atoms, renamed and walked through."""

from __future__ import annotations

from lerobot_memobench.tasks.formula import (
    And,
    Atom,
    Not,
    Or,
    Then,
    atoms,
    rename,
)

A, B, C = Atom("on", ("a", "p")), Atom("on", ("b", "p")), Atom("open", ("d",))


def test_rename_is_simultaneous() -> None:
    assert rename(And((A, Not(B))), {"a": "b", "b": "a"}) == And((B, Not(A)))
    assert [atom.args[0] for atom in atoms(Then((A, Or((B, Not(A))))))] == ["a", "b", "a"]
