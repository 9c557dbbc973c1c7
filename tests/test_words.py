"""Words: public names are terms of the field (docs/benchmark/glossary.md), and texts are plain English."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterable, Iterator
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
"""Word of earlier versions -> term of the field."""

PER_1000_LINES = {
    "told, tells, telling": (re.compile(r"\b(told|tells|telling)\b", re.IGNORECASE), 0.5),
    "beside, anew, nobody": (re.compile(r"\b(beside|anew|nobody)\b", re.IGNORECASE), 0.5),
    "stands": (re.compile(r"\bstands\b", re.IGNORECASE), 0.5),
    "mended": (re.compile(r"\bmended\b", re.IGNORECASE), 0.5),
}
"""Words -> pattern and maximum number per 1,000 lines."""
TEXTS = {
    "package": ("src/lerobot_memobench", "src/mujoco_raster"),
    "pages": ("README.md", "docs/start", "docs/guides", "docs/benchmark", "docs/develop", "docs/develop.md"),
    "scripts": ("scripts", "benchmarks"),
}
"""Name -> files and folders, counted together."""


def words(name: str) -> set[str]:
    """Split ``snake_case`` and ``CamelCase`` into lower-case words."""
    return {part.lower() for part in re.findall(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+", name)}


def public_names(tree: ast.Module) -> Iterator[str]:
    """Yield classes, functions, methods, constants and fields without a leading underscore."""
    for node in ast.walk(tree):
        names: list[str] = []
        if isinstance(node, ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
            names.append(node.name)
        if isinstance(node, ast.ClassDef | ast.Module):
            for part in node.body:
                targets = part.targets if isinstance(part, ast.Assign) else [getattr(part, "target", None)]
                names += [target.id for target in targets if isinstance(target, ast.Name)]
        yield from (name for name in names if not name.startswith("_"))


def old_words(root: Path) -> list[str]:
    """Return ``file: name (term)`` of each public name with an old word."""
    found = []
    for path in sorted(root.rglob("*.py")):
        if not path.name.startswith("test_"):
            place = path.relative_to(root)
            for name in {*place.with_suffix("").parts, *public_names(ast.parse(path.read_text()))}:
                found += [f"{place}: {name} ({OLD[word]})" for word in sorted(words(name) & OLD.keys())]
    return found


@pytest.mark.parametrize("root", ["src/lerobot_memobench", "src/mujoco_raster", "research", "examples"])
def test_public_names_are_terms_of_the_field(root: str) -> None:
    assert old_words(ROOT / root) == []


def too_frequent(places: Iterable[Path]) -> dict[str, tuple[float, list[str]]]:
    """Return words above their limit -> their number per 1,000 lines and the lines."""
    files = [file for place in places for file in (sorted(place.rglob("*.*")) if place.is_dir() else [place])]
    lines = [
        (f"{file.name}:{number}: {line.strip()}", line)
        for file in files
        if file.suffix in (".md", ".py", ".txt")
        for number, line in enumerate(file.read_text(encoding="utf-8").splitlines(), 1)
    ]
    found = {}
    for group, (pattern, limit) in PER_1000_LINES.items():
        counts = [(shown, len(pattern.findall(line))) for shown, line in lines]
        rate = 1000 * sum(count for _, count in counts) / len(lines)
        if rate > limit:
            found[group] = rate, [shown for shown, count in counts if count]
    return found


@pytest.mark.parametrize("name", TEXTS)
def test_texts_use_plain_words(name: str) -> None:
    assert too_frequent(ROOT / place for place in TEXTS[name]) == {}
