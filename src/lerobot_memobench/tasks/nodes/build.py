"""From a formula to the tree of its nodes."""

from __future__ import annotations

from lerobot_memobench.tasks.formula import (
    And,
    Atom,
    Counted,
    Exactly,
    Formula,
    Hold,
    Never,
    Not,
    Or,
    Round,
    Then,
    When,
    children,
)
from lerobot_memobench.tasks.nodes.counting import ExactlyNode, HoldNode, NeverNode
from lerobot_memobench.tasks.nodes.gates import AndNode, NotNode, OrNode
from lerobot_memobench.tasks.nodes.node import AtomNode, Node
from lerobot_memobench.tasks.nodes.order import RoundNode, ThenNode, WhenNode

_PLAIN: dict[type[Formula], type[Node]] = {
    And: AndNode,
    Or: OrNode,
    Not: NotNode,
    Never: NeverNode,
    When: WhenNode,
    Round: RoundNode,
}
_COUNTED: dict[type[Formula], type[HoldNode] | type[ExactlyNode]] = {Hold: HoldNode, Exactly: ExactlyNode}


def build(formula: Formula, hold_steps: int) -> Node:
    """Return the tree of a formula; ``hold_steps`` is what each child of `Then` has to hold."""
    if isinstance(formula, Atom):
        return AtomNode(formula)
    parts = [build(child, hold_steps) for child in children(formula)]
    if isinstance(formula, Then):
        return ThenNode(parts, hold_steps)
    if isinstance(formula, Counted):
        return _COUNTED[type(formula)](parts, formula.number)
    return _PLAIN[type(formula)](parts)
