"""Parse BDDL problems in LIBERO's dialect: the scene, instruction and goal of a task.

A file holds ``(define (problem NAME) (:domain ..) (:language ..) (:regions ..) (:fixtures ..) (:objects ..)
(:obj_of_interest ..) (:init ..) (:goal ..))``. Keywords and predicates are case-insensitive. Names keep their case;
references to them ignore it. Unknown items raise an error with file and line, except a region on an undeclared target,
which raises only when it is used.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

from lerobot_memobench.errors import MemobenchError, nearest
from lerobot_memobench.tasks.formula import (
    LATCHES,
    MAX_DEPTH,
    PREDICATES,
    SINCE_START,
    And,
    Atom,
    Formula,
    atoms,
    is_operator,
    make_atom,
    make_operator,
    rename,
    takes_number,
)
from lerobot_memobench.tasks.sexpr import Node, Reader

_SECTIONS = (":domain", ":language", ":regions", ":fixtures", ":objects", ":obj_of_interest", ":init", ":goal")
_REQUIRED = (":language", ":fixtures", ":init", ":goal")
_REGION = "a region such as (NAME (:target FIXTURE) (:ranges ((x1 y1 x2 y2))) (:yaw_rotation ((low high))))"
_REGION_CLAUSES = (":target", ":ranges", ":yaw_rotation")
_NOT_IN_INIT = {*LATCHES, *SINCE_START}

_THING = ("object", "fixture")
_JOINTED = ("fixture", "region")
_KINDS: dict[str, tuple[tuple[str, ...], ...]] = {
    "on": (_THING, (*_THING, "region")),
    "in": (_THING, ("region",)),
    "inplace": (("object",),),
    "lifted": (("object",),),
}
"""Predicate -> allowed kinds of each argument; other predicates take a joint (`_JOINTED`)."""


@dataclass(frozen=True)
class Region:
    """A named place on ``target``.

    Attributes:
        name: name inside the file; atoms use ``full_name``.
        target: fixture (or object) that carries the region.
        ranges: rectangles (x1, y1, x2, y2) relative to the target's centre, m; empty for a site of the target.
        yaw: interval (low, high) of the initial yaw, rad.
    """

    name: str
    target: str
    ranges: tuple[tuple[float, float, float, float], ...] = ()
    yaw: tuple[float, float] = (0.0, 0.0)

    @property
    def full_name(self) -> str:
        """Name used in atoms: ``<target>_<name>``."""
        return f"{self.target}_{self.name}"


@dataclass(frozen=True)
class Problem:
    """A parsed BDDL file; names in ``init`` and ``goal`` are declared. Mappings keep the file's order.

    Attributes:
        unplaced: region on an undeclared target -> error message for atoms that use it.
    """

    name: str
    domain: str
    language: str
    objects: dict[str, str]
    fixtures: dict[str, str]
    regions: dict[str, Region]
    objects_of_interest: tuple[str, ...]
    init: tuple[Atom, ...]
    goal: Formula
    unplaced: dict[Region, str] = field(default_factory=dict)

    @property
    def scene(self) -> dict[str, Any]:
        """Return the attributes of `task.Task` that the file alone states."""
        names = ("objects", "fixtures", "regions", "init", "objects_of_interest", "goal")
        return {name: getattr(self, name) for name in names}

    def entity_kind(self, name: str) -> str | None:
        """Return "object", "fixture", "region" or None."""
        if name in self.objects:
            return "object"
        if name in self.fixtures:
            return "fixture"
        return "region" if name in self.regions else None

    def resolve(self, formula: Formula, where: str) -> Formula:
        """Return ``formula`` with names in their declared spelling.

        Raises:
            MemobenchError: a name is not declared, or its kind does not fit the predicate.
        """
        declared = {name.lower(): name for name in (*self.objects, *self.fixtures, *self.regions)}
        spelling: dict[str, str] = {}
        for atom in atoms(formula):
            for position, arg in enumerate(atom.args):
                if arg.lower() not in declared:
                    self._check_unplaced(arg)
                    raise MemobenchError(
                        f"{where}: found the name {arg!r}, which none of :objects, :fixtures and :regions "
                        f"(as <target>_<region>) declares, {nearest(arg, declared.values())}"
                    )
                spelling[arg] = declared[arg.lower()]
                self._check_kind(atom, position, spelling[arg], where)
        return rename(formula, spelling)

    def _check_unplaced(self, name: str) -> None:
        """Raise if a name refers to a region on an undeclared target, with or without a typing error in the target."""
        for region, problem in self.unplaced.items():
            if name.lower().endswith(f"_{region.name}".lower()):
                raise MemobenchError(problem)

    def _check_kind(self, atom: Atom, position: int, name: str, where: str) -> None:
        kind = self.entity_kind(name)
        allowed = _KINDS.get(atom.predicate, (_JOINTED,))[position]
        if kind not in allowed:
            raise MemobenchError(f"{where}: found the {kind} {name!r} in {atom}, expected {' or '.join(allowed)} there")


# --- reading ---


def parse_bddl(text: str, path: object = "<text>") -> Problem:
    """Parse a BDDL problem; ``path`` appears in error messages only.

    Raises:
        MemobenchError: with file, line, the unexpected item and the expected one.
    """
    # Replace comments by spaces to preserve offsets and line numbers.
    blanked = re.sub(r";[^\n]*", lambda match: " " * len(match.group()), text)
    reader = Reader(str(path), blanked)
    root = reader.read()
    name, nodes = _problem(reader, root)
    sections = _sections(reader, root, nodes)
    problem = _declared(reader, name, sections)
    # Goal and initial state refer to the declarations, so they are parsed last.
    goals = _items(sections, ":goal")
    if len(goals) != 1:
        raise reader.error(sections[":goal"], f"{len(goals)} formulas in :goal", "exactly one")
    return replace(problem, goal=_formula(reader, problem, goals[0]), init=_init(reader, problem, sections[":init"]))


def _problem(reader: Reader, root: Node) -> tuple[str, list[Node]]:
    """Return the problem's name and its section nodes."""
    expected = "(define (problem NAME) ...)"
    head, rest = reader.head(root, expected)
    if head != "define" or not rest:
        raise reader.error(root, f"({head} ...)", expected)
    head, words = reader.head(rest[0], "(problem NAME)")
    if head != "problem" or len(words) != 1:
        raise reader.error(rest[0], str(rest[0]), "(problem NAME)")
    return reader.word(words[0], "(problem NAME)"), rest[1:]


def _sections(reader: Reader, root: Node, nodes: list[Node]) -> dict[str, Node]:
    sections: dict[str, Node] = {}
    for node in nodes:
        key, _ = reader.head(node, "a section such as (:objects ...)")
        if key not in _SECTIONS:
            raise reader.error(node, f"the unknown section {key!r}", f"one of {', '.join(_SECTIONS)}")
        if key in sections:
            raise reader.error(node, f"a second {key}", f"one, as on line {sections[key].line}")
        sections[key] = node
    missing = [key for key in _REQUIRED if key not in sections]
    if missing:
        raise reader.error(root, f"no {' or '.join(missing)} section", f"all of {', '.join(_REQUIRED)}")
    return sections


def _items(sections: dict[str, Node], key: str) -> list[Node]:
    return (sections[key].items or [])[1:] if key in sections else []


def _declared(reader: Reader, name: str, sections: dict[str, Node]) -> Problem:
    """Return the problem with its declarations; initial state and goal are empty."""
    names = _Names(reader)
    fixtures = _declarations(reader, _items(sections, ":fixtures"), names)
    objects = _declarations(reader, _items(sections, ":objects"), names)
    regions, unplaced = _regions(reader, _items(sections, ":regions"), names)
    return Problem(
        name=name,
        domain=_domain(reader, sections.get(":domain")),
        language=_language(reader, sections[":language"]),
        objects=objects,
        fixtures=fixtures,
        regions=regions,
        objects_of_interest=_of_interest(reader, _items(sections, ":obj_of_interest"), names),
        init=(),
        goal=And(()),
        unplaced=unplaced,
    )


def _domain(reader: Reader, node: Node | None) -> str:
    if node is None:
        return ""
    items = reader.sequence(node, "(:domain NAME)")[1:]
    if len(items) != 1:
        raise reader.error(node, f"{len(items)} words in :domain", "one name")
    return reader.word(items[0], "a domain name")


def _language(reader: Reader, node: Node) -> str:
    """Return the free text with white space collapsed; it may contain commas, dots and balanced parentheses."""
    assert node.items is not None
    language = " ".join(reader.text[node.items[0].end : node.end - 1].split())
    if not language:
        raise reader.error(node, "an empty :language", "the instruction of the task in words")
    return language


def _declarations(reader: Reader, nodes: list[Node], names: _Names) -> dict[str, str]:
    """Parse ``a b - class c - class`` into {instance: class}."""
    expected = "names, '-' and a class, such as 'bowl_1 bowl_2 - akita_black_bowl'"
    declared: dict[str, str] = {}
    waiting: list[Node] = []
    following = iter(nodes)
    for node in following:
        if reader.word(node, expected) != "-":
            waiting.append(node)
            continue
        class_node = next(following, None)
        class_name = class_node.word if class_node else ""
        if not waiting or class_name in ("", "-"):
            lacking = "a class after it" if waiting else "a name before it"
            raise reader.error(node, f"a '-' without {lacking}", expected)
        for name in waiting:
            names.declare(name, name.word, f"the {class_name}")
            declared[name.word] = class_name
        waiting = []
    if waiting:
        raise reader.error(waiting[0], f"{waiting[0].word!r} without a class", expected)
    return declared


def _of_interest(reader: Reader, nodes: list[Node], names: _Names) -> tuple[str, ...]:
    known = names.spelling()
    found = []
    for node in nodes:
        name = reader.word(node, "a declared name")
        if name.lower() not in known:
            hint = nearest(name, known.values())
            raise reader.error(node, f"{name!r} in :obj_of_interest", f"a declared name, {hint}")
        found.append(known[name.lower()])
    return tuple(found)


class _Names:
    """Case-insensitive registry of declared names; rejects names that differ only in case."""

    def __init__(self, reader: Reader) -> None:
        self._reader = reader
        self._declared: dict[str, tuple[str, str]] = {}

    def declare(self, node: Node, name: str, kind: str) -> None:
        """Add the name declared at ``node``; ``kind`` describes it in the error for a second declaration."""
        if name.lower() in self._declared:
            first = " ".join(self._declared[name.lower()])
            expected = f"another name, because {first} exists"
            raise self._reader.error(node, f"the name {name!r} declared again", expected)
        self._declared[name.lower()] = (kind, name)

    def spelling(self) -> dict[str, str]:
        """Return lower-case name -> declared name."""
        return {key: name for key, (_, name) in self._declared.items()}


# --- regions ---


def _regions(reader: Reader, nodes: list[Node], names: _Names) -> tuple[dict[str, Region], dict[Region, str]]:
    """Declare the regions; return full name -> region, and unplaced region -> error message.

    LIBERO's files contain unused regions on undeclared targets.
    """
    regions: dict[str, Region] = {}
    unplaced: dict[Region, str] = {}
    targets = names.spelling()
    for node in nodes:
        region, problem = _region(reader, node, targets)
        if problem is not None:
            unplaced[region] = problem
            continue
        names.declare(node, region.full_name, "the region")
        regions[region.full_name] = region
    return regions, unplaced


def _region(reader: Reader, node: Node, targets: Mapping[str, str]) -> tuple[Region, str | None]:
    """Return a region, and the error message for an undeclared target."""
    items = reader.sequence(node, _REGION)
    if not items:
        raise reader.error(node, "an empty list ()", _REGION)
    name = reader.word(items[0], _REGION)
    target = problem = None
    ranges: list[tuple[float, float, float, float]] = []
    yaw = (0.0, 0.0)
    seen: set[str] = set()
    for clause in items[1:]:
        key, value = _clause(reader, clause, name, seen)
        if key == ":target":
            target, problem = _target(reader, clause, value, name, targets)
        elif key == ":ranges":
            ranges = _ranges(reader, clause, value, name)
        else:
            yaw = _yaw(reader, clause, value, name)
    if target is None:
        raise reader.error(node, f"region {name!r} without (:target ...)", _REGION)
    return Region(name, target, tuple(ranges), yaw), problem


def _clause(reader: Reader, clause: Node, name: str, seen: set[str]) -> tuple[str, Node]:
    """Return a clause's keyword and value; add the keyword to ``seen``, which rejects duplicates."""
    key, values = reader.head(clause, "(:target ...), (:ranges ...) or (:yaw_rotation ...)")
    if key in seen:
        raise reader.error(clause, f"a second {key} in region {name!r}", "one")
    if key not in _REGION_CLAUSES:
        found = f"the unknown clause {key!r} in region {name!r}"
        raise reader.error(clause, found, ":target, :ranges or :yaw_rotation")
    seen.add(key)
    if len(values) != 1:
        raise reader.error(clause, f"{len(values)} values in {key} of region {name!r}", "one")
    return key, values[0]


def _target(reader: Reader, clause: Node, value: Node, name: str, targets: Mapping[str, str]) -> tuple[str, str | None]:
    """Return a target in its declared spelling; for an undeclared one the given spelling and the error message."""
    given = reader.word(value, "the name of a fixture or object")
    if given.lower() in targets:
        return targets[given.lower()], None
    expected = f"a name from :fixtures or :objects, {nearest(given, targets.values())}"
    found = f"the target {given!r} of region {name!r}, which is not declared"
    return given, str(reader.error(clause, found, expected))


def _ranges(reader: Reader, clause: Node, value: Node, name: str) -> list[tuple[float, float, float, float]]:
    ranges = []
    for box in reader.sequence(value, "a list of (x1 y1 x2 y2)"):
        x1, y1, x2, y2 = reader.numbers(box, 4, "x1 y1 x2 y2 in metres")
        if x1 > x2 or y1 > y2:
            raise reader.error(box, f"the range ({x1} {y1} {x2} {y2})", "x1 <= x2 and y1 <= y2")
        ranges.append((x1, y1, x2, y2))
    if not ranges:
        raise reader.error(clause, f"empty :ranges in region {name!r}", "at least one (x1 y1 x2 y2)")
    return ranges


def _yaw(reader: Reader, clause: Node, value: Node, name: str) -> tuple[float, float]:
    pairs = reader.sequence(value, "a list of one (low high)")
    if len(pairs) != 1:
        raise reader.error(clause, f"{len(pairs)} yaw intervals in region {name!r}", "one (low high)")
    low, high = reader.numbers(pairs[0], 2, "low high in radians")
    if low > high:
        raise reader.error(pairs[0], f"the yaw interval ({low} {high})", "low <= high")
    return low, high


# --- goal and initial state ---


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
    """Return a word as an integer, or unchanged if it is not one."""
    return int(word) if word.isascii() and word.isdigit() and len(word) < 10 else word


def _init(reader: Reader, problem: Problem, section: Node) -> tuple[Atom, ...]:
    """Return the initial state: atoms only, each object placed once, no cycle of supports."""
    found: list[Atom] = []
    support: dict[str, str] = {}
    for node in (section.items or [])[1:]:
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
    """Raise if ``thing`` starts on a table region without ranges."""
    region = problem.regions.get(place)
    if region and not region.ranges and "table" in problem.fixtures.get(region.target, ""):
        found = f"{thing!r} on region {region.name!r} without :ranges"
        raise reader.error(node, found, "a region with :ranges on the table")


def _check_bottom(reader: Reader, section: Node, support: Mapping[str, str]) -> None:
    """Raise if the supports of a thing form a cycle."""
    for name in support:
        chain, below = [name], support.get(name)
        while below is not None:
            if below in chain:
                found = f"{name!r} resting on itself through {below!r} in :init"
                raise reader.error(section, found, "a fixture at the bottom")
            chain.append(below)
            below = support.get(below)
