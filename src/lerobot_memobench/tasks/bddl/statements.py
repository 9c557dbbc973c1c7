"""Read what a BDDL file says of its things: the goal, and where everything starts."""

from __future__ import annotations

from collections.abc import Mapping

from lerobot_memobench.tasks.bddl.problem import Problem
from lerobot_memobench.tasks.bddl.sexpr import Node, Reader
from lerobot_memobench.tasks.formula import (
    LATCHES,
    MAX_DEPTH,
    PREDICATES,
    SINCE_START,
    Atom,
    Formula,
    is_operator,
    takes_number,
)
from lerobot_memobench.tasks.formula_making import make_atom, make_operator

_NOT_IN_INIT = {*LATCHES, *SINCE_START}


def read_goal(reader: Reader, problem: Problem, section: Node, nodes: list[Node]) -> Formula:
    """Return the one formula of the goal, its names resolved against what ``problem`` declares."""
    if len(nodes) != 1:
        raise reader.error(section, f"{len(nodes)} formulas in :goal", "exactly one")
    return _formula(reader, problem, nodes[0])


def _formula(reader: Reader, problem: Problem, node: Node, depth: int = 0) -> Formula:
    expected = "a formula such as (On a b) or (And ...)"
    if depth > MAX_DEPTH:
        raise reader.error(node, f"a formula nested deeper than {MAX_DEPTH} levels", "a flatter one")
    head, rest = reader.head(node, expected)
    where = reader.where(node)
    if is_operator(head):
        number = _number(rest.pop(0).word) if takes_number(head) and rest and rest[0].items is None else None
        return make_operator(head, [_formula(reader, problem, item, depth + 1) for item in rest], where, number)
    assert node.items is not None
    args = [reader.word(item, f"an entity name as argument of {node.items[0].word}") for item in rest]
    return problem.resolve(make_atom(node.items[0].word, args, where), where)


def _number(word: str) -> int | str:
    """Return a word as the whole number that it is, or as it stands."""
    return int(word) if word.isascii() and word.isdigit() and len(word) < 10 else word


def read_init(reader: Reader, problem: Problem, section: Node, nodes: list[Node]) -> tuple[Atom, ...]:
    """Return the starting state: atoms only, every object placed once, nothing resting on itself."""
    found: list[Atom] = []
    support: dict[str, str] = {}
    for node in nodes:
        atom = _init_atom(reader, problem, node)
        found.append(atom)
        if atom.predicate in ("on", "in"):
            thing, place = atom.args
            if thing in support:
                raise reader.error(node, f"a second place for {thing!r}", "one place per object in :init")
            support[thing] = problem.regions[place].target if place in problem.regions else place
            _check_ranges(reader, problem, node, thing, place)
    for name in problem.objects:
        if name not in support:
            expected = f"(On {name} ...) or (In {name} ...)"
            raise reader.error(section, f"no place for the object {name!r} in :init", expected)
    _check_bottom(reader, section, support)
    return tuple(found)


def _init_atom(reader: Reader, problem: Problem, node: Node) -> Atom:
    head, _ = reader.head(node, "an atom such as (On a b)")
    if is_operator(head) or head in _NOT_IN_INIT:
        allowed = ", ".join(spelling for key, (spelling, _) in PREDICATES.items() if key not in _NOT_IN_INIT)
        raise reader.error(node, f"{head!r} in :init", f"one of {allowed}")
    atom = _formula(reader, problem, node)
    assert isinstance(atom, Atom)
    return atom


def _check_ranges(reader: Reader, problem: Problem, node: Node, thing: str, place: str) -> None:
    """Raise where ``thing`` starts on a region of the table that does not say where on it."""
    region = problem.regions.get(place)
    if region and not region.ranges and "table" in problem.fixtures.get(region.target, ""):
        found = f"{thing!r} on region {region.name!r} without :ranges"
        raise reader.error(node, found, "a region with :ranges on the table")


def _check_bottom(reader: Reader, section: Node, support: Mapping[str, str]) -> None:
    """Raise where following what each thing rests on leads in a circle."""
    for name in support:
        chain, below = [name], support.get(name)
        while below is not None:
            if below in chain:
                found = f"{name!r} resting on itself through {below!r} in :init"
                raise reader.error(section, found, "a fixture at the bottom")
            chain.append(below)
            below = support.get(below)
