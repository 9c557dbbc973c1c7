"""Read a BDDL problem in LIBERO's dialect.

A file holds ``(define (problem NAME) (:domain ..) (:language ..) (:regions ..) (:fixtures ..) (:objects ..)
(:obj_of_interest ..) (:init ..) (:goal ..))``. Keywords and predicates are read in any case; names keep
theirs, and a reference that differs from the declared name only in case means that name. Anything unknown is
an error that tells file and line, never dropped; but a region on what is not declared is let pass until it is used.
"""

from __future__ import annotations

import re
from dataclasses import replace

from lerobot_memobench.errors import nearest
from lerobot_memobench.tasks.bddl.names import Names
from lerobot_memobench.tasks.bddl.problem import Problem
from lerobot_memobench.tasks.bddl.regions import read_regions
from lerobot_memobench.tasks.bddl.sexpr import Node, Reader
from lerobot_memobench.tasks.bddl.statements import read_goal, read_init
from lerobot_memobench.tasks.formula import And

_SECTIONS = (":domain", ":language", ":regions", ":fixtures", ":objects", ":obj_of_interest", ":init", ":goal")
_REQUIRED = (":language", ":fixtures", ":init", ":goal")

Sections = dict[str, Node]


def parse_bddl(text: str, path: object = "<text>") -> Problem:
    """Read a BDDL problem; ``path`` is only named in errors.

    Raises ``MemobenchError`` with file, line, what was found and what was expected.
    """
    # Comments become spaces, so that offsets and line numbers stay those of the file.
    blanked = re.sub(r";[^\n]*", lambda match: " " * len(match.group()), text)
    reader = Reader(str(path), blanked)
    root = reader.read()
    name, nodes = _problem(reader, root)
    sections = _sections(reader, root, nodes)
    problem = _declared(reader, name, sections)
    # Goal and starting state are read last, against what is declared.
    goal = read_goal(reader, problem, sections[":goal"], _items(sections, ":goal"))
    init = read_init(reader, problem, sections[":init"], _items(sections, ":init"))
    return replace(problem, init=init, goal=goal)


def _problem(reader: Reader, root: Node) -> tuple[str, list[Node]]:
    """Return the problem's name and the nodes of its sections."""
    expected = "(define (problem NAME) ...)"
    head, rest = reader.head(root, expected)
    if head != "define" or not rest:
        raise reader.error(root, f"({head} ...)", expected)
    head, words = reader.head(rest[0], "(problem NAME)")
    if head != "problem" or len(words) != 1:
        raise reader.error(rest[0], str(rest[0]), "(problem NAME)")
    return reader.word(words[0], "(problem NAME)"), rest[1:]


def _sections(reader: Reader, root: Node, nodes: list[Node]) -> Sections:
    sections: Sections = {}
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


def _items(sections: Sections, key: str) -> list[Node]:
    return (sections[key].items or [])[1:] if key in sections else []


def _declared(reader: Reader, name: str, sections: Sections) -> Problem:
    """Return the problem with all that it declares; starting state and goal are still empty."""
    names = Names(reader)
    fixtures = _declarations(reader, _items(sections, ":fixtures"), names)
    objects = _declarations(reader, _items(sections, ":objects"), names)
    regions, unplaced = read_regions(reader, _items(sections, ":regions"), names)
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
    """The free text as written, white space joined; it may hold commas, dots and balanced parentheses."""
    assert node.items is not None
    language = " ".join(reader.text[node.items[0].end : node.end - 1].split())
    if not language:
        raise reader.error(node, "an empty :language", "the instruction of the task in words")
    return language


def _declarations(reader: Reader, nodes: list[Node], names: Names) -> dict[str, str]:
    """Read ``a b - class c - class`` into {instance: class}."""
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


def _of_interest(reader: Reader, nodes: list[Node], names: Names) -> tuple[str, ...]:
    known = names.spelling()
    found = []
    for node in nodes:
        name = reader.word(node, "a declared name")
        if name.lower() not in known:
            hint = nearest(name, known.values())
            raise reader.error(node, f"{name!r} in :obj_of_interest", f"a declared name, {hint}")
        found.append(known[name.lower()])
    return tuple(found)
