"""The architecture as imports make it: read from source, held to the order in docs/develop.md, drawn into the docs.

``python scripts/architecture.py`` draws docs/figures/architecture.svg anew; tests/test_architecture.py holds
what docs/develop.md promises.
"""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator, Mapping
from graphlib import CycleError, TopologicalSorter
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
SOURCE = ROOT / "src"
PACKAGE = "lerobot_memobench"
PLAN = ROOT / "docs" / "develop.md"
PICTURE = ROOT / "docs" / "figures" / "architecture.svg"

Imports = Mapping[str, set[str]]
"""Module -> the modules of this project that it imports, dotted names, wherever in the file the import stands."""


def modules() -> dict[str, Path]:
    """Return dotted name -> file of every module of the package; a folder's own name is its ``__init__.py``."""
    found = {}
    for path in sorted((SOURCE / PACKAGE).rglob("*.py")):
        parts = path.relative_to(SOURCE).with_suffix("").parts
        found[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = path
    return found


def imported(tree: ast.AST) -> Iterator[tuple[str, str | None]]:
    """Yield (module, name taken from it) of every absolute import in a file; None where the module itself is taken."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from ((alias.name, None) for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            yield from ((node.module, alias.name) for alias in node.names)


def read_imports() -> dict[str, set[str]]:
    """Return the imports among the package's modules, as their source has them."""
    known = modules()
    found: dict[str, set[str]] = {}
    for module, path in known.items():
        mine = found.setdefault(module, set())
        for source, name in imported(ast.parse(path.read_text())):
            whole = f"{source}.{name}"
            target = whole if whole in known else source
            if target in known and target != module:
                mine.add(target)
    return found


def circle(imports: Imports) -> list[str]:
    """Return modules that import each other in a ring, [] where there is none."""
    try:
        TopologicalSorter(imports).prepare()
    except CycleError as error:
        return list(reversed(error.args[1]))
    return []


def package_of(module: str) -> str:
    """Return the part of a dotted name that docs/develop.md lists: ``lerobot_memobench.sim.world`` -> ``sim``."""
    return module.removeprefix(PACKAGE).lstrip(".").partition(".")[0]


def plan() -> dict[str, str]:
    """Return package -> its question, lowest first, from the table in docs/develop.md."""
    rows = re.findall(r"^\| `(\w+)` \| (.+?) \|$", PLAN.read_text(), flags=re.MULTILINE)
    return dict(rows)


def arrows(imports: Imports) -> dict[str, set[str]]:
    """Return package -> the packages that its modules import."""
    found: dict[str, set[str]] = {package_of(module): set() for module in imports if package_of(module)}
    for module, targets in imports.items():
        here = package_of(module)
        if here:
            found[here] |= {package_of(target) for target in targets} - {here, ""}
    return found


def direct(found: Mapping[str, set[str]]) -> dict[str, set[str]]:
    """Return the arrows that do not follow from others: a -> c goes where a -> b -> c stands."""

    def reach(start: str) -> set[str]:
        return set().union(*({target} | reach(target) for target in found[start]))

    return {
        here: {target for target in targets if not any(target in reach(other) for other in targets)}
        for here, targets in found.items()
    }


def floors(found: Mapping[str, set[str]]) -> list[list[str]]:
    """Return the packages by floor, the ground first: each stands one above the highest that it imports."""
    level: dict[str, int] = {}
    for package in TopologicalSorter(found).static_order():
        level[package] = 1 + max((level[target] for target in found[package]), default=-1)
    order = list(plan())
    return [
        sorted((package for package in found if level[package] == floor), key=order.index)
        for floor in range(max(level.values()) + 1)
    ]


def contents(package: str) -> tuple[int, int]:
    """Return files and lines of a package."""
    base = SOURCE / PACKAGE / package
    files = sorted(base.rglob("*.py")) if base.is_dir() else [base.with_suffix(".py")]
    return len(files), sum(len(path.read_text().splitlines()) for path in files)


WIDTH, HEIGHT, BESIDE, BETWEEN = 1.55, 0.52, 0.2, 0.36
"""Size of a package's box and what is left beside it and between floors, inches: five boxes are as wide as a page."""

INK, DARK, PALE = "#35506b", "#1b2733", "#4d5f70"


def places(storeys: list[list[str]]) -> dict[str, tuple[float, float]]:
    """Return package -> centre of its box, inches; neighbouring floors are shifted so that arrows pass between."""
    found = {}
    for floor, packages in enumerate(storeys):
        shift = 0.16 if floor % 2 else -0.16
        for k, package in enumerate(packages):
            x = (k - (len(packages) - 1) / 2) * (WIDTH + BESIDE) + shift
            found[package] = x, floor * (HEIGHT + BETWEEN)
    return found


def draw_package(axis: Any, package: str, x: float, y: float) -> None:
    """Draw a box with the package's name and size; its question stands in the table of docs/develop.md."""
    from matplotlib.patches import FancyBboxPatch

    count, lines = contents(package)
    corner, style = (x - WIDTH / 2, y - HEIGHT / 2), "round,pad=0,rounding_size=0.06"
    axis.add_patch(FancyBboxPatch(corner, WIDTH, HEIGHT, boxstyle=style, facecolor="#eef3f8", edgecolor=INK, zorder=2))
    axis.text(x, y + 0.1, package, weight="bold", fontsize=11.5, color=DARK, va="center", ha="center", zorder=3)
    size = f"{count} file{'s' * (count > 1)}, {lines:,} lines"
    axis.text(x, y - 0.12, size, fontsize=8.5, color=PALE, va="center", ha="center", zorder=3)


def draw_arrow(axis: Any, name: str, start: tuple[float, float], end: tuple[float, float]) -> None:
    """Draw an arrow from the bottom of a box to the top of another; its id in the picture is its name."""
    from matplotlib.patches import FancyArrowPatch

    (x0, y0), (x1, y1) = start, end
    lean = max(-WIDTH / 3, min(WIDTH / 3, 0.3 * (x1 - x0)))
    ends = (x0 + lean, y0 - HEIGHT / 2), (x1 - lean, y1 + HEIGHT / 2)
    arrow = FancyArrowPatch(*ends, arrowstyle="-|>", mutation_scale=11, color=INK, shrinkA=0, shrinkB=0, zorder=1)
    arrow.set_gid(name)
    axis.add_patch(arrow)


def draw(picture: Path = PICTURE) -> None:
    """Draw packages as boxes on floors, and what they import as arrows."""
    import matplotlib

    matplotlib.use("Agg")
    matplotlib.rcParams.update({"svg.hashsalt": "architecture", "svg.fonttype": "none", "font.family": "sans-serif"})
    from matplotlib import pyplot as plt

    found = arrows(read_imports())
    centres = places(floors(found))
    xs, ys = zip(*centres.values(), strict=True)
    left, right = min(xs) - WIDTH / 2 - 0.05, max(xs) + WIDTH / 2 + 0.05
    bottom, top = -HEIGHT / 2 - 0.1, max(ys) + HEIGHT / 2 + 0.1
    figure = plt.figure(figsize=(right - left, top - bottom))
    axis = figure.add_axes((0, 0, 1, 1), xlim=(left, right), ylim=(bottom, top))
    axis.set_axis_off()
    for package, (x, y) in centres.items():
        draw_package(axis, package, x, y)
    for here, targets in sorted(direct(found).items()):
        for target in sorted(targets):
            draw_arrow(axis, f"{here}-{target}", centres[here], centres[target])
    figure.savefig(picture, metadata={"Date": None} if picture.suffix == ".svg" else None, dpi=100)
    plt.close(figure)


def drawn(picture: Path = PICTURE) -> dict[str, set[str]]:
    """Return the arrows of the picture, by their ids."""
    found: dict[str, set[str]] = {}
    for here, target in re.findall(r'id="(\w+)-(\w+)"', picture.read_text()):
        found.setdefault(here, set()).add(target)
    return found


if __name__ == "__main__":
    draw()
    print(PICTURE.relative_to(ROOT))
