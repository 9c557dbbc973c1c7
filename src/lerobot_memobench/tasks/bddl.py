"""Reader and writer of BDDL problems in LIBERO's dialect.

A file holds ``(define (problem NAME) (:domain ..) (:language ..) (:regions ..) (:fixtures ..) (:objects ..)
(:obj_of_interest ..) (:init ..) (:goal ..))``. Keywords and predicates are read in any case; names keep
theirs, and a reference that differs from the declared name only in case means that name. Anything unknown is
an error that tells file and line, never dropped.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, replace

from lerobot_memobench.errors import MemobenchError, nearest
from lerobot_memobench.tasks.formula import (
    LATCHES,
    MAX_DEPTH,
    PREDICATES,
    And,
    Atom,
    Formula,
    atoms,
    children,
    format_formula,
    is_operator,
    make_atom,
    make_operator,
    rename,
)
from lerobot_memobench.tasks.sexpr import Node, Reader

_SECTIONS = (
    ":domain",
    ":language",
    ":regions",
    ":fixtures",
    ":objects",
    ":obj_of_interest",
    ":init",
    ":goal",
)
_REQUIRED = (":language", ":fixtures", ":init", ":goal")
#: Declared names: lower case -> (what it is, the name as declared). Two names may not differ in case alone.
_Used = dict[str, tuple[str, str]]


@dataclass(frozen=True)
class Region:
    """A named place on ``target``.

    Attributes:
        name: name inside the file; atoms use ``full_name``.
        target: fixture (or object) that carries the region.
        ranges: rectangles (x1, y1, x2, y2) in metres relative to the target's centre; empty for a site of the
            target itself.
        yaw: interval (low, high) in radians from which the yaw of what starts here is drawn.
    """

    name: str
    target: str
    ranges: tuple[tuple[float, float, float, float], ...] = ()
    yaw: tuple[float, float] = (0.0, 0.0)

    @property
    def full_name(self) -> str:
        """The name by which atoms refer to the region: ``<target>_<name>``."""
        return f"{self.target}_{self.name}"


@dataclass(frozen=True)
class Problem:
    """What a BDDL file says; names in ``init`` and ``goal`` are declared. Mappings keep the file's order."""

    name: str
    domain: str
    language: str
    objects: dict[str, str]
    fixtures: dict[str, str]
    regions: dict[str, Region]
    objects_of_interest: tuple[str, ...]
    init: tuple[Atom, ...]
    goal: Formula

    def entity_kind(self, name: str) -> str | None:
        """Return "object", "fixture", "region" or None."""
        kinds: tuple[tuple[str, Mapping[str, object]], ...] = (
            ("object", self.objects),
            ("fixture", self.fixtures),
            ("region", self.regions),
        )
        return next((kind for kind, names in kinds if name in names), None)

    def resolve(self, formula: Formula, where: str) -> Formula:
        """Return ``formula`` with its names spelt as declared; one that is not, or does not fit, raises."""
        declared = {name.lower(): name for name in (*self.objects, *self.fixtures, *self.regions)}
        spelling: dict[str, str] = {}
        for atom in atoms(formula):
            for position, arg in enumerate(atom.args):
                if arg.lower() not in declared:
                    raise MemobenchError(
                        f"{where}: found the name {arg!r}, which none of :objects, :fixtures and :regions "
                        f"(as <target>_<region>) declares, {nearest(arg, declared.values())}"
                    )
                spelling[arg] = declared[arg.lower()]
                self._check_kind(atom, position, spelling[arg], where)
        return rename(formula, spelling)

    def _check_kind(self, atom: Atom, position: int, name: str, where: str) -> None:
        kind = self.entity_kind(name)
        allowed: tuple[str, ...]
        if atom.predicate == "on":
            allowed = ("object", "fixture") if position == 0 else ("object", "fixture", "region")
        elif atom.predicate == "in":
            allowed = ("object", "fixture") if position == 0 else ("region",)
        else:
            allowed = ("fixture", "region")
        if kind not in allowed:
            raise MemobenchError(f"{where}: found the {kind} {name!r} in {atom}, expected {' or '.join(allowed)} there")


# --- the problem ---


def parse_bddl(text: str, path: object = "<text>") -> Problem:
    """Read a BDDL problem; ``path`` is only named in errors.

    Raises ``MemobenchError`` with file, line, what was found and what was expected.
    """
    # Comments become spaces, so that offsets and line numbers stay those of the file.
    blanked = re.sub(r";[^\n]*", lambda match: " " * len(match.group()), text)
    reader = Reader(str(path), blanked)
    root = reader.read()
    expected = "(define (problem NAME) ...)"
    head, rest = reader.head(root, expected)
    if head != "define" or not rest:
        raise reader.error(root, f"({head} ...)", expected)
    head, words = reader.head(rest[0], "(problem NAME)")
    if head != "problem" or len(words) != 1:
        raise reader.error(rest[0], str(rest[0]), "(problem NAME)")
    name = reader.word(words[0], "(problem NAME)")

    sections: dict[str, Node] = {}
    for node in rest[1:]:
        key, _ = reader.head(node, "a section such as (:objects ...)")
        if key not in _SECTIONS:
            raise reader.error(node, f"the unknown section {key!r}", f"one of {', '.join(_SECTIONS)}")
        if key in sections:
            raise reader.error(node, f"a second {key}", f"one, as on line {sections[key].line}")
        sections[key] = node
    missing = [key for key in _REQUIRED if key not in sections]
    if missing:
        raise reader.error(root, f"no {' or '.join(missing)} section", f"all of {', '.join(_REQUIRED)}")

    def items(key: str) -> list[Node]:
        return (sections[key].items or [])[1:] if key in sections else []

    used: _Used = {}
    fixtures = _declarations(reader, items(":fixtures"), used)
    objects = _declarations(reader, items(":objects"), used)
    # Goal and starting state are read last, against what is declared.
    problem = Problem(
        name=name,
        domain=_domain(reader, sections.get(":domain")),
        language=_language(reader, sections[":language"]),
        objects=objects,
        fixtures=fixtures,
        regions=_regions(reader, items(":regions"), used),
        objects_of_interest=_of_interest(reader, items(":obj_of_interest"), used),
        init=(),
        goal=And(()),
    )
    goals = items(":goal")
    if len(goals) != 1:
        raise reader.error(sections[":goal"], f"{len(goals)} formulas in :goal", "exactly one")
    goal = _formula(reader, problem, goals[0])
    init = _init(reader, problem, sections[":init"], items(":init"))
    return replace(problem, init=init, goal=goal)


def _domain(reader: Reader, node: Node | None) -> str:
    if node is None:
        return ""
    items = reader.sequence(node, "(:domain NAME)")[1:]
    if len(items) != 1:
        raise reader.error(node, f"{len(items)} words in :domain", "one name")
    return reader.word(items[0], "a domain name")


def _language(reader: Reader, node: Node) -> str:
    """The free text as written, white space joined; it may hold commas, dots and balanced parentheses."""
    assert node.items is not None
    language = " ".join(reader.text[node.items[0].end : node.end - 1].split())
    if not language:
        raise reader.error(node, "an empty :language", "the instruction of the task in words")
    return language


def _declare(reader: Reader, node: Node, name: str, what: str, used: _Used) -> None:
    if name.lower() in used:
        first = " ".join(used[name.lower()])
        raise reader.error(node, f"the name {name!r} declared again", f"another name, since {first} is there")
    used[name.lower()] = (what, name)


def _declarations(reader: Reader, nodes: list[Node], used: _Used) -> dict[str, str]:
    """Read ``a b - class c - class`` into {instance: class}."""
    expected = "names, '-' and a class, such as 'bowl_1 bowl_2 - akita_black_bowl'"
    declared: dict[str, str] = {}
    waiting: list[Node] = []
    position = 0
    while position < len(nodes):
        node = nodes[position]
        word = reader.word(node, expected)
        if word == "-":
            follows = nodes[position + 1].word if position + 1 < len(nodes) else ""
            if not waiting or follows in ("", "-"):
                raise reader.error(
                    node,
                    "a '-' without " + ("a name before it" if not waiting else "a class after it"),
                    expected,
                )
            for name in waiting:
                _declare(reader, name, name.word, f"the {follows}", used)
                declared[name.word] = follows
            waiting = []
            position += 1
        else:
            waiting.append(node)
        position += 1
    if waiting:
        raise reader.error(waiting[0], f"{waiting[0].word!r} without a class", expected)
    return declared


def _regions(reader: Reader, nodes: list[Node], used: _Used) -> dict[str, Region]:
    regions: dict[str, Region] = {}
    spelling = {key: name for key, (_, name) in used.items()}
    for node in nodes:
        region = _region(reader, node, spelling)
        _declare(reader, node, region.full_name, "the region", used)
        regions[region.full_name] = region
    return regions


def _region(reader: Reader, node: Node, targets: Mapping[str, str]) -> Region:
    expected = "a region such as (NAME (:target FIXTURE) (:ranges ((x1 y1 x2 y2))) (:yaw_rotation ((low high))))"
    head_items = reader.sequence(node, expected)
    if not head_items:
        raise reader.error(node, "an empty list ()", expected)
    name = reader.word(head_items[0], expected)
    target: str | None = None
    ranges: list[tuple[float, float, float, float]] = []
    yaw = (0.0, 0.0)
    seen: set[str] = set()
    for clause in head_items[1:]:
        key, values = reader.head(clause, "(:target ...), (:ranges ...) or (:yaw_rotation ...)")
        if key in seen:
            raise reader.error(clause, f"a second {key} in region {name!r}", "one")
        if key not in (":target", ":ranges", ":yaw_rotation"):
            raise reader.error(
                clause, f"the unknown clause {key!r} in region {name!r}", ":target, :ranges or :yaw_rotation"
            )
        seen.add(key)
        if len(values) != 1:
            raise reader.error(clause, f"{len(values)} values in {key} of region {name!r}", "one")
        if key == ":target":
            given = reader.word(values[0], "the name of a fixture or object")
            if given.lower() not in targets:
                raise reader.error(
                    clause,
                    f"the target {given!r} of region {name!r}, which is not declared",
                    f"a name from :fixtures or :objects, {nearest(given, targets.values())}",
                )
            target = targets[given.lower()]
        elif key == ":ranges":
            for box in reader.sequence(values[0], "a list of (x1 y1 x2 y2)"):
                x1, y1, x2, y2 = reader.numbers(box, 4, "x1 y1 x2 y2 in metres")
                if x1 > x2 or y1 > y2:
                    raise reader.error(box, f"the range ({x1} {y1} {x2} {y2})", "x1 <= x2 and y1 <= y2")
                ranges.append((x1, y1, x2, y2))
            if not ranges:
                raise reader.error(clause, f"empty :ranges in region {name!r}", "at least one (x1 y1 x2 y2)")
        else:
            pairs = reader.sequence(values[0], "a list of one (low high)")
            if len(pairs) != 1:
                raise reader.error(clause, f"{len(pairs)} yaw intervals in region {name!r}", "one (low high)")
            low, high = reader.numbers(pairs[0], 2, "low high in radians")
            if low > high:
                raise reader.error(pairs[0], f"the yaw interval ({low} {high})", "low <= high")
            yaw = (low, high)
    if target is None:
        raise reader.error(node, f"region {name!r} without (:target ...)", expected)
    return Region(name, target, tuple(ranges), yaw)


def _of_interest(reader: Reader, nodes: list[Node], used: _Used) -> tuple[str, ...]:
    names = []
    for node in nodes:
        name = reader.word(node, "a declared name")
        if name.lower() not in used:
            hint = nearest(name, [known for _, known in used.values()])
            raise reader.error(node, f"{name!r} in :obj_of_interest", f"a declared name, {hint}")
        names.append(used[name.lower()][1])
    return tuple(names)


def _formula(reader: Reader, problem: Problem, node: Node, depth: int = 0) -> Formula:
    expected = "a formula such as (On a b) or (And ...)"
    if depth > MAX_DEPTH:
        raise reader.error(node, f"a formula nested deeper than {MAX_DEPTH} levels", "a flatter one")
    head, rest = reader.head(node, expected)
    if is_operator(head):
        return make_operator(head, [_formula(reader, problem, item, depth + 1) for item in rest], reader.where(node))
    assert node.items is not None
    args = [reader.word(item, f"an entity name as argument of {node.items[0].word}") for item in rest]
    return problem.resolve(make_atom(node.items[0].word, args, reader.where(node)), reader.where(node))


def _init(reader: Reader, problem: Problem, section: Node, nodes: list[Node]) -> tuple[Atom, ...]:
    """Read the starting state: atoms only, every object placed once, nothing resting on itself."""
    found: list[Atom] = []
    place: dict[str, str] = {}
    for node in nodes:
        head, _ = reader.head(node, "an atom such as (On a b)")
        if is_operator(head) or head in LATCHES:
            allowed = ", ".join(spelling for key, (spelling, _) in PREDICATES.items() if key not in LATCHES)
            raise reader.error(node, f"{head!r} in :init", f"one of {allowed}")
        atom = _formula(reader, problem, node)
        assert isinstance(atom, Atom)
        found.append(atom)
        if atom.predicate in ("on", "in"):
            thing, support = atom.args
            if thing in place:
                raise reader.error(node, f"a second place for {thing!r}", "one place per object in :init")
            place[thing] = problem.regions[support].target if support in problem.regions else support
            region = problem.regions.get(support)
            if (
                region
                and not region.ranges
                and region.target in problem.fixtures
                and "table" in problem.fixtures[region.target]
            ):
                raise reader.error(
                    node,
                    f"{thing!r} on region {region.name!r} without :ranges",
                    "a region with :ranges on the table",
                )
    for name in problem.objects:
        if name not in place:
            raise reader.error(
                section, f"no place for the object {name!r} in :init", f"(On {name} ...) or (In {name} ...)"
            )
    for name in place:
        chain, below = [name], place.get(name)
        while below is not None:
            if below in chain:
                raise reader.error(
                    section,
                    f"{name!r} resting on itself through {below!r} in :init",
                    "a fixture at the bottom",
                )
            chain.append(below)
            below = place.get(below)
    return tuple(found)


# --- writing ---


def format_bddl(problem: Problem, comment: str = "") -> str:
    """Return ``problem`` as BDDL text in this project's layout; ``parse_bddl`` reads it back."""
    lines = [f"; {line}" for line in comment.splitlines()]
    lines += [f"(define (problem {problem.name})"]
    if problem.domain:
        lines += [f"  (:domain {problem.domain})"]
    lines += [f"  (:language {problem.language})"]

    def section(name: str, rows: list[str]) -> None:
        if rows:
            lines.extend(["", f"  (:{name}", *(f"    {row}" for row in rows), "  )"])

    regions = []
    for region in problem.regions.values():
        row = f"({region.name} (:target {region.target})"
        if region.ranges:
            boxes = " ".join(f"({' '.join(map(repr, box))})" for box in region.ranges)
            row += f" (:ranges ({boxes})) (:yaw_rotation (({region.yaw[0]!r} {region.yaw[1]!r})))"
        elif region.yaw != (0.0, 0.0):
            row += f" (:yaw_rotation (({region.yaw[0]!r} {region.yaw[1]!r})))"
        regions.append(row + ")")
    section("regions", regions)
    for name, declared in (("fixtures", problem.fixtures), ("objects", problem.objects)):
        by_class: dict[str, list[str]] = {}
        for instance, class_name in declared.items():
            by_class.setdefault(class_name, []).append(instance)
        # One line per class keeps the order of declaration only if instances of a class stand together.
        grouped = [instance for names in by_class.values() for instance in names] == list(declared)
        rows = by_class.items() if grouped else [(class_name, [instance]) for instance, class_name in declared.items()]
        section(name, [f"{' '.join(names)} - {class_name}" for class_name, names in rows])
    section("obj_of_interest", [" ".join(problem.objects_of_interest)] if problem.objects_of_interest else [])
    lines += ["", "  (:init", *(f"    {format_formula(atom)}" for atom in problem.init), "  )"]
    lines += ["", "  (:goal", *_goal_rows(problem.goal, "    "), "  )", ")"]
    return "\n".join(lines) + "\n"


def _goal_rows(formula: Formula, indent: str) -> list[str]:
    """One line where it fits, else one child per line."""
    flat = indent + format_formula(formula)
    if len(flat) <= 110 or isinstance(formula, Atom):
        return [flat]
    rows = [f"{indent}({type(formula).__name__}"]
    for part in children(formula):
        rows += _goal_rows(part, indent + "  ")
    rows[-1] += ")"
    return rows
