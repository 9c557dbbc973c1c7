"""Public names are the field's terms (docs/benchmark/glossary.md): words that were once our own do not come back."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
OLD = {
    **dict.fromkeys(("eye", "eyes"), "detector or visual encoder"),
    **dict.fromkeys(("finds",), "detections"),
    **dict.fromkeys(("sight", "sights"), "inputs or detection noise"),
    **dict.fromkeys(("seen", "looked", "looking", "saw"), "observation, tokens or inputs"),
    **dict.fromkeys(("moment", "moments"), "frame"),
    **dict.fromkeys(("twin", "twins"), "strict task"),
    **dict.fromkeys(("film", "films", "filmed"), "video"),
    **dict.fromkeys(("lesson", "lessons", "school"), "detector data or training"),
    "told": "privileged object state",
    "doubts": "uncertainty",
    "crowd": "distractors",
    "catches": "detents",
    "driving": "DAgger",
    "integration": "memory fusion",
    "house": "architecture",
    "orders": "run options",
}


def words(name: str) -> set[str]:
    """Split ``snake_case`` and ``CamelCase`` into lower-case words."""
    return {part.lower() for part in re.findall(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+", name)}


def public_names(tree: ast.Module) -> Iterator[str]:
    """Yield classes, functions, methods, constants, fields and parameters that do not begin with an underscore."""
    for node in ast.walk(tree):
        if isinstance(node, ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
            yield node.name
        if isinstance(node, ast.ClassDef | ast.Module):
            for part in node.body:
                if isinstance(part, ast.AnnAssign) and isinstance(part.target, ast.Name):
                    yield part.target.id
                if isinstance(part, ast.Assign):
                    yield from (target.id for target in part.targets if isinstance(target, ast.Name))


def old_words(root: Path) -> list[str]:
    """Return ``file: name (what it should be called)`` of every public name with an old word."""
    found = []
    for path in sorted(root.rglob("*.py")):
        if path.name.startswith("test_"):
            continue
        place = path.relative_to(root)
        for name in [*place.with_suffix("").parts, *public_names(ast.parse(path.read_text()))]:
            if not name.startswith("_"):
                found += [f"{place}: {name} ({OLD[word]})" for word in sorted(words(name) & OLD.keys())]
    return found


@pytest.mark.parametrize("root", ["src/lerobot_memobench", "research", "examples"])
def test_public_names_are_the_fields(root: str) -> None:
    assert old_words(ROOT / root) == []


def test_old_words_are_found() -> None:
    source = "class RowEyes:\n    told_objects: int\n\ndef finds(): ...\n\ndef _twin(): ..."
    found = {word for name in public_names(ast.parse(source)) if name[0] != "_" for word in words(name) & OLD.keys()}
    assert found == {"eyes", "told", "finds"}
