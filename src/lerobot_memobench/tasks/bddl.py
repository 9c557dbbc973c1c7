"""Parse BDDL problems in LIBERO's dialect: the scene, instruction and goal of a task.

A file holds ``(define (problem NAME) (:domain ..) (:language ..) (:regions ..) (:fixtures ..) (:objects ..)
(:obj_of_interest ..) (:init ..) (:goal ..))``. Keywords and predicates are case-insensitive. Names keep their case;
references to them ignore it. Unknown items raise an error with file and line, except a region on an undeclared target,
which raises only when it is used: LIBERO's files contain such regions.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

from lerobot_memobench.errors import MemobenchError, cut, nearest
from lerobot_memobench.tasks.formula import (
    LATCHES,
    MAX_DEPTH,
    OPERATORS,
    PREDICATES,
    SINCE_START,
    And,
    Atom,
    Counted,
    Formula,
    atoms,
    make_atom,
    make_operator,
    rename,
)

_SECTIONS = (":domain", ":language", ":regions", ":fixtures", ":objects", ":obj_of_interest", ":init", ":goal")
_REQUIRED = (":language", ":fixtures", ":init", ":goal")
_REGION = "a region such as (NAME (:target FIXTURE) (:ranges ((x1 y1 x2 y2))) (:yaw_rotation ((low high))))"
_REGION_CLAUSES = (":target", ":ranges", ":yaw_rotation")
_NOT_IN_INIT = {*LATCHES, *SINCE_START}
#: Excludes words that `float` accepts: nan, inf, 1_000.
_NUMBER = re.compile(r"[+-]?([0-9]+\.?[0-9]*|\.[0-9]+)([eE][+-]?[0-9]+)?")

_THING = ("object", "fixture")
_KINDS: dict[str, tuple[tuple[str, ...], ...]] = {
    "on": (_THING, (*_THING, "region")),
    "in": (_THING, ("region",)),
    "inplace": (("object",),),
    "lifted": (("object",),),
}
"""Predicate -> allowed kinds of each argument; other predicates take a joint, a fixture or region."""


@dataclass(frozen=True)
class Region:
    """A named place on ``target``, a fixture or object."""

    name: str  # inside the file; atoms use ``full_name``
    target: str
    ranges: tuple[tuple[float, float, float, float], ...] = ()  # (x1, y1, x2, y2) from its centre, m; () for a site
    yaw: tuple[float, float] = (0.0, 0.0)  # interval (low, high) of the initial yaw, rad

    @property
    def full_name(self) -> str:
        """Name used in atoms: ``<target>_<name>``."""
        return f"{self.target}_{self.name}"


@dataclass(frozen=True)
class Problem:
    """A parsed BDDL file; names in ``init`` and ``goal`` are declared. Mappings keep the file's order."""

    name: str
    domain: str
    language: str
    objects: dict[str, str]
    fixtures: dict[str, str]
    regions: dict[str, Region]
    objects_of_interest: tuple[str, ...]
    init: tuple[Atom, ...]
    goal: Formula
    unplaced: dict[Region, str] = field(default_factory=dict)  # on an undeclared target -> error of atoms that use it

    @property
    def scene(self) -> dict[str, Any]:
        """Return the attributes of `task.Task` that the file alone states."""
        names = ("objects", "fixtures", "regions", "init", "objects_of_interest", "goal")
        return {name: getattr(self, name) for name in names}

    @property
    def names(self) -> list[str]:
        """Declared names; those of regions are ``<target>_<region>``."""
        return [*self.objects, *self.fixtures, *self.regions]

    def resolve(self, formula: Formula, where: str) -> Formula:
        """Return ``formula`` with names in their declared spelling, each of a kind that fits its predicate."""
        declared = {name.lower(): name for name in self.names}
        spelling: dict[str, str] = {}
        for atom in atoms(formula):
            for position, arg in enumerate(atom.args):
                if arg.lower() not in declared:
                    for region, problem in self.unplaced.items():  # the target may have a typing error
                        if arg.lower().endswith(f"_{region.name}".lower()):
                            raise MemobenchError(problem)
                    raise MemobenchError(
                        f"{where}: found the name {arg!r}, which none of :objects, :fixtures and :regions "
                        f"(as <target>_<region>) declares, {nearest(arg, declared.values())}"
                    )
                name = spelling[arg] = declared[arg.lower()]
                kind = "object" if name in self.objects else "fixture" if name in self.fixtures else "region"
                allowed = _KINDS.get(atom.predicate, (("fixture", "region"),))[position]
                if kind not in allowed:
                    raise MemobenchError(
                        f"{where}: found the {kind} {name!r} in {atom}, expected {' or '.join(allowed)} there"
                    )
        return rename(formula, spelling)


# --- S-expressions ---


@dataclass
class _Expression:
    """A word (``items`` is None) or a list; ``start`` and ``end`` delimit its source text."""

    path: str
    line: int
    start: int
    end: int = -1
    word: str = ""
    items: list[_Expression] | None = None

    def __str__(self) -> str:
        if self.items is None:
            return repr(cut(self.word, 40))
        return f"a list ({self.items[0].word[:40]} ...)" if self.items else "an empty list ()"

    @property
    def where(self) -> str:
        return f"{self.path}, line {self.line}"

    def error(self, found: str, expected: str) -> MemobenchError:
        return MemobenchError(f"{self.where}: found {found}, expected {expected}")

    def text(self, expected: str) -> str:
        """Return the word; raise for a list."""
        if self.items is not None:
            raise self.error(str(self), expected)
        return self.word

    def sequence(self, expected: str) -> list[_Expression]:
        """Return the items of the list; raise for a word."""
        if self.items is None:
            raise self.error(str(self), expected)
        return self.items

    def head(self, expected: str) -> tuple[str, list[_Expression]]:
        """Split a list into its first word (lower case) and the rest."""
        items = self.sequence(expected)
        if not items:
            raise self.error("an empty list ()", expected)
        return items[0].text(expected).lower(), items[1:]

    def numbers(self, count: int, expected: str) -> list[float]:
        """Return the ``count`` finite numbers of the list."""
        items = self.sequence(expected)
        if len(items) != count:
            raise self.error(f"{len(items)} value(s)", expected)
        for item in items:
            text = item.text(expected)
            if not _NUMBER.fullmatch(text) or not math.isfinite(float(text)):
                raise item.error(repr(text), f"a finite number ({expected})")
        return [float(item.word) for item in items]


def _parse(text: str, path: str) -> _Expression:
    """Return the single top-level list."""
    top_level: list[_Expression] = []
    root = _Expression(path, line=1, start=0, items=top_level)
    stack, line, last = [root], 1, 0  # no recursion, which deep nesting would overflow
    for match in re.finditer(r"[()]|[^\s()]+", text):
        line += text.count("\n", last, match.start())
        last = match.start()
        node = _Expression(path, line, match.start(), match.end(), match.group())
        if node.word == ")":
            if len(stack) == 1:  # the root is no list of the file
                raise node.error("an unmatched ')'", "'(' before it or the end of the file")
            stack.pop().end = match.end()
            continue
        stack[-1].sequence("a list").append(node)
        if node.word == "(":
            node.word, node.items = "", []
            stack.append(node)
    if len(stack) > 1:
        raise stack[-1].error("a '(' that is never closed", "a ')' for it before the end of the file")
    if len(top_level) != 1 or top_level[0].items is None:
        node = top_level[1] if len(top_level) > 1 else (top_level or [root])[0]
        raise node.error(str(node) if top_level else "no text", "exactly one list (define (problem NAME) ...)")
    return top_level[0]


# --- problems ---


def parse_bddl(text: str, path: object = "<text>") -> Problem:
    """Parse a BDDL problem; ``path`` is named in error messages."""
    # Replace comments by spaces to preserve offsets and line numbers.
    text = re.sub(r";[^\n]*", lambda match: " " * len(match.group()), text)
    root = _parse(text, str(path))
    name, sections = _sections(root)
    items = {key: sections[key].sequence(key)[1:] if key in sections else [] for key in _SECTIONS}
    names: dict[str, tuple[str, str]] = {}
    problem = Problem(
        name=name,
        domain="",
        language=_language(text, sections[":language"]),
        fixtures=_declarations(items[":fixtures"], names),
        objects=_declarations(items[":objects"], names),
        regions={},
        objects_of_interest=(),
        init=(),
        goal=And(()),
    )
    targets = {key: name for key, (_, name) in names.items()}
    for node in items[":regions"]:
        region, fault = _region(node, targets)
        if fault is not None:
            problem.unplaced[region] = fault
            continue
        _declare(names, node, region.full_name, "the region")
        problem.regions[region.full_name] = region
    # These refer to the declarations, so they are parsed last.
    if ":domain" in sections and len(items[":domain"]) != 1:
        raise sections[":domain"].error(f"{len(items[':domain'])} words in :domain", "one name")
    if len(items[":goal"]) != 1:
        raise sections[":goal"].error(f"{len(items[':goal'])} formulas in :goal", "exactly one")
    return replace(
        problem,
        domain=items[":domain"][0].text("a domain name") if items[":domain"] else "",
        objects_of_interest=tuple(_declared(names, node) for node in items[":obj_of_interest"]),
        goal=_formula(problem, items[":goal"][0]),
        init=_init(problem, sections[":init"]),
    )


def _sections(root: _Expression) -> tuple[str, dict[str, _Expression]]:
    expected = "(define (problem NAME) ...)"
    head, rest = root.head(expected)
    if head != "define" or not rest:
        raise root.error(f"({head} ...)", expected)
    head, words = rest[0].head("(problem NAME)")
    if head != "problem" or len(words) != 1:
        raise rest[0].error(str(rest[0]), "(problem NAME)")
    sections: dict[str, _Expression] = {}
    for node in rest[1:]:
        key, _ = node.head("a section such as (:objects ...)")
        if key not in _SECTIONS:
            raise node.error(f"the unknown section {key!r}", f"one of {', '.join(_SECTIONS)}")
        if key in sections:
            raise node.error(f"a second {key}", f"one, as on line {sections[key].line}")
        sections[key] = node
    if missing := [key for key in _REQUIRED if key not in sections]:
        raise root.error(f"no {' or '.join(missing)} section", f"all of {', '.join(_REQUIRED)}")
    return words[0].text("(problem NAME)"), sections


def _language(text: str, section: _Expression) -> str:
    """Return the free text with white space collapsed; it may contain commas, dots and balanced parentheses."""
    language = " ".join(text[section.sequence(":language")[0].end : section.end - 1].split())
    if not language:
        raise section.error("an empty :language", "the instruction of the task in words")
    return language


def _declare(names: dict[str, tuple[str, str]], node: _Expression, name: str, kind: str) -> None:
    """Add a name to {lower case: (kind, name)}; ``kind`` describes it in the error for a second declaration."""
    if name.lower() in names:
        first = " ".join(names[name.lower()])
        raise node.error(f"the name {name!r} declared again", f"another name, because {first} exists")
    names[name.lower()] = kind, name


def _declared(names: dict[str, tuple[str, str]], node: _Expression) -> str:
    name = node.text("a declared name")
    if name.lower() not in names:
        known = [known for _, known in names.values()]
        raise node.error(f"{name!r} in :obj_of_interest", f"a declared name, {nearest(name, known)}")
    return names[name.lower()][1]


def _declarations(nodes: list[_Expression], names: dict[str, tuple[str, str]]) -> dict[str, str]:
    """Parse ``a b - class c - class`` into {instance: class}."""
    expected = "names, '-' and a class, such as 'bowl_1 bowl_2 - akita_black_bowl'"
    declared: dict[str, str] = {}
    waiting: list[_Expression] = []
    following = iter(nodes)
    for node in following:
        if node.text(expected) != "-":
            waiting.append(node)
            continue
        class_node = next(following, None)
        class_name = class_node.word if class_node else ""
        if not waiting or class_name in ("", "-"):
            lacking = "a class after it" if waiting else "a name before it"
            raise node.error(f"a '-' without {lacking}", expected)
        for name in waiting:
            _declare(names, name, name.word, f"the {class_name}")
            declared[name.word] = class_name
        waiting = []
    if waiting:
        raise waiting[0].error(f"{waiting[0].word!r} without a class", expected)
    return declared


def _region(node: _Expression, targets: Mapping[str, str]) -> tuple[Region, str | None]:
    items = node.sequence(_REGION)
    if not items:
        raise node.error("an empty list ()", _REGION)
    name = items[0].text(_REGION)
    clauses: dict[str, tuple[_Expression, _Expression]] = {}
    for clause in items[1:]:
        key, values = clause.head("(:target ...), (:ranges ...) or (:yaw_rotation ...)")
        if key in clauses:
            raise clause.error(f"a second {key} in region {name!r}", "one")
        if key not in _REGION_CLAUSES:
            raise clause.error(f"the unknown clause {key!r} in region {name!r}", ":target, :ranges or :yaw_rotation")
        if len(values) != 1:
            raise clause.error(f"{len(values)} values in {key} of region {name!r}", "one")
        clauses[key] = clause, values[0]
    if ":target" not in clauses:
        raise node.error(f"region {name!r} without (:target ...)", _REGION)
    ranges = _ranges(*clauses[":ranges"], name) if ":ranges" in clauses else ()
    yaw = _yaw(*clauses[":yaw_rotation"], name) if ":yaw_rotation" in clauses else (0.0, 0.0)
    clause, value = clauses[":target"]
    target, problem = value.text("the name of a fixture or object"), None
    if target.lower() not in targets:
        found = f"the target {target!r} of region {name!r}, which is not declared"
        expected = f"a name from :fixtures or :objects, {nearest(target, targets.values())}"
        problem = str(clause.error(found, expected))
    return Region(name, targets.get(target.lower(), target), ranges, yaw), problem


def _ranges(clause: _Expression, value: _Expression, name: str) -> tuple[tuple[float, float, float, float], ...]:
    ranges = []
    for box in value.sequence("a list of (x1 y1 x2 y2)"):
        x1, y1, x2, y2 = box.numbers(4, "x1 y1 x2 y2 in metres")
        if x1 > x2 or y1 > y2:
            raise box.error(f"the range ({x1} {y1} {x2} {y2})", "x1 <= x2 and y1 <= y2")
        ranges.append((x1, y1, x2, y2))
    if not ranges:
        raise clause.error(f"empty :ranges in region {name!r}", "at least one (x1 y1 x2 y2)")
    return tuple(ranges)


def _yaw(clause: _Expression, value: _Expression, name: str) -> tuple[float, float]:
    pairs = value.sequence("a list of one (low high)")
    if len(pairs) != 1:
        raise clause.error(f"{len(pairs)} yaw intervals in region {name!r}", "one (low high)")
    low, high = pairs[0].numbers(2, "low high in radians")
    if low > high:
        raise pairs[0].error(f"the yaw interval ({low} {high})", "low <= high")
    return low, high


# --- goal and initial state ---


def _formula(problem: Problem, node: _Expression, depth: int = 0) -> Formula:
    if depth > MAX_DEPTH:
        raise node.error(f"a formula nested deeper than {MAX_DEPTH} levels", "a flatter one")
    head, rest = node.head("a formula such as (On a b) or (And ...)")
    if (operator := OPERATORS.get(head)) is not None:
        number: int | str | None = None
        if issubclass(operator, Counted) and rest and rest[0].items is None:
            word = rest.pop(0).word
            number = int(word) if word.isascii() and word.isdigit() and len(word) < 10 else word
        return make_operator(operator, [_formula(problem, item, depth + 1) for item in rest], node.where, number)
    predicate = node.sequence("")[0].word
    args = [item.text(f"an entity name as argument of {predicate}") for item in rest]
    return problem.resolve(make_atom(predicate, args, node.where), node.where)


def _init(problem: Problem, section: _Expression) -> tuple[Atom, ...]:
    """Return the initial state: atoms only, each object placed once, no cycle of supports."""
    initial: list[Atom] = []
    support: dict[str, str] = {}
    for node in section.sequence(":init")[1:]:
        head, _ = node.head("an atom such as (On a b)")
        if head in OPERATORS or head in _NOT_IN_INIT:
            allowed = ", ".join(spelling for key, (spelling, _) in PREDICATES.items() if key not in _NOT_IN_INIT)
            raise node.error(f"{head!r} in :init", f"one of {allowed}")
        atom = _formula(problem, node)
        assert isinstance(atom, Atom)
        initial.append(atom)
        if atom.predicate not in ("on", "in"):
            continue
        thing, target = atom.args
        if thing in support:
            raise node.error(f"a second place for {thing!r}", "one place per object in :init")
        region = problem.regions.get(target)
        support[thing] = region.target if region else target
        if region and not region.ranges and "table" in problem.fixtures.get(region.target, ""):
            raise node.error(
                f"{thing!r} on region {region.name!r} without :ranges", "a region with :ranges on the table"
            )
    for name in problem.objects:
        if name not in support:
            raise section.error(f"no place for the object {name!r} in :init", f"(On {name} ...) or (In {name} ...)")
    for name in support:
        chain, below = [name], support.get(name)
        while below is not None:
            if below in chain:
                raise section.error(f"{name!r} resting on itself through {below!r} in :init", "a fixture at the bottom")
            chain.append(below)
            below = support.get(below)
    return tuple(initial)
