"""Read the regions of a BDDL file."""

from __future__ import annotations

from collections.abc import Mapping

from lerobot_memobench.errors import nearest
from lerobot_memobench.tasks.bddl.names import Names
from lerobot_memobench.tasks.bddl.problem import Region
from lerobot_memobench.tasks.bddl.sexpr import Node, Reader

_EXPECTED = "a region such as (NAME (:target FIXTURE) (:ranges ((x1 y1 x2 y2))) (:yaw_rotation ((low high))))"
_CLAUSES = (":target", ":ranges", ":yaw_rotation")


def read_regions(reader: Reader, nodes: list[Node], names: Names) -> tuple[dict[str, Region], dict[Region, str]]:
    """Return full name -> region, and declare these names; and the regions on what is not declared.

    LIBERO's files hold some of those, which nothing uses. Each comes with the sentence for who does.
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
    """Return a region, and what is wrong with its target."""
    items = reader.sequence(node, _EXPECTED)
    if not items:
        raise reader.error(node, "an empty list ()", _EXPECTED)
    name = reader.word(items[0], _EXPECTED)
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
        raise reader.error(node, f"region {name!r} without (:target ...)", _EXPECTED)
    return Region(name, target, tuple(ranges), yaw), problem


def _clause(reader: Reader, clause: Node, name: str, seen: set[str]) -> tuple[str, Node]:
    """Return a clause's keyword and its one value; ``seen`` holds the keywords before it and takes this one."""
    key, values = reader.head(clause, "(:target ...), (:ranges ...) or (:yaw_rotation ...)")
    if key in seen:
        raise reader.error(clause, f"a second {key} in region {name!r}", "one")
    if key not in _CLAUSES:
        found = f"the unknown clause {key!r} in region {name!r}"
        raise reader.error(clause, found, ":target, :ranges or :yaw_rotation")
    seen.add(key)
    if len(values) != 1:
        raise reader.error(clause, f"{len(values)} values in {key} of region {name!r}", "one")
    return key, values[0]


def _target(reader: Reader, clause: Node, value: Node, name: str, targets: Mapping[str, str]) -> tuple[str, str | None]:
    """Return a target as it is declared; one that is not as it is written, with the sentence that says so."""
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
