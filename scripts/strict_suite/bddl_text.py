"""Write a BDDL problem as text that `parse_bddl` reads back."""

from __future__ import annotations

from lerobot_memobench.tasks.bddl import Problem, Region
from lerobot_memobench.tasks.formula import Atom, Counted, Formula, children, format_formula

LONGEST_ROW = 110
"""Maximum columns of a formula on one line."""


def format_bddl(problem: Problem, comment: str = "") -> str:
    """Return ``problem`` as BDDL text, preceded by the lines of ``comment``."""
    lines = [f"; {line}" for line in comment.splitlines()]
    lines += [f"(define (problem {problem.name})"]
    if problem.domain:
        lines += [f"  (:domain {problem.domain})"]
    lines += [f"  (:language {problem.language})"]
    lines += _section("regions", [_region_row(region) for region in (*problem.regions.values(), *problem.unplaced)])
    lines += _section("fixtures", _declaration_rows(problem.fixtures))
    lines += _section("objects", _declaration_rows(problem.objects))
    lines += _section("obj_of_interest", [" ".join(problem.objects_of_interest)] if problem.objects_of_interest else [])
    lines += ["", "  (:init", *(f"    {format_formula(atom)}" for atom in problem.init), "  )"]
    lines += ["", "  (:goal", *_goal(problem.goal, "    "), "  )", ")"]
    return "\n".join(lines) + "\n"


def _section(name: str, rows: list[str]) -> list[str]:
    return ["", f"  (:{name}", *(f"    {row}" for row in rows), "  )"] if rows else []


def _region_row(region: Region) -> str:
    row = f"({region.name} (:target {region.target})"
    if region.ranges:
        boxes = " ".join(f"({' '.join(map(repr, box))})" for box in region.ranges)
        row += f" (:ranges ({boxes}))"
    if region.ranges or region.yaw != (0.0, 0.0):
        row += f" (:yaw_rotation (({region.yaw[0]!r} {region.yaw[1]!r})))"
    return row + ")"


def _declaration_rows(declared: dict[str, str]) -> list[str]:
    """Return a line per class if this keeps the order of declaration, else a line per instance."""
    by_class: dict[str, list[str]] = {}
    for instance, class_name in declared.items():
        by_class.setdefault(class_name, []).append(instance)
    grouped = [instance for names in by_class.values() for instance in names] == list(declared)
    rows = by_class.items() if grouped else [(class_name, [instance]) for instance, class_name in declared.items()]
    return [f"{' '.join(names)} - {class_name}" for class_name, names in rows]


def _goal(formula: Formula, indent: str) -> list[str]:
    flat = indent + format_formula(formula)
    if len(flat) <= LONGEST_ROW or isinstance(formula, Atom):
        return [flat]
    number = f" {formula.number}" if isinstance(formula, Counted) else ""
    rows = [f"{indent}({type(formula).__name__}{number}"]
    for part in children(formula):
        rows += _goal(part, indent + "  ")
    rows[-1] += ")"
    return rows
