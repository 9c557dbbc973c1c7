"""Read the imports among packages from the source, and draw docs/figures/architecture.svg.

    python scripts/architecture.py

tests/test_architecture.py compares the imports with the order in docs/develop.md.
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
IMAGE = ROOT / "docs" / "figures" / "architecture.svg"

Imports = Mapping[str, set[str]]
"""Module -> imported modules of this project, as dotted names; includes imports inside functions."""


def modules() -> dict[str, Path]:
    """Return dotted name -> file of each module; a package's name maps to its ``__init__.py``."""
    found = {}
    for path in sorted((SOURCE / PACKAGE).rglob("*.py")):
        parts = path.relative_to(SOURCE).with_suffix("").parts
        found[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = path
    return found


def imported(tree: ast.AST) -> Iterator[tuple[str, str | None]]:
    """Yield (module, imported name) of each absolute import; the name is None for ``import module``."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from ((alias.name, None) for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            yield from ((node.module, alias.name) for alias in node.names)


def imports_among(trees: Mapping[str, ast.AST]) -> dict[str, set[str]]:
    """Return the imports among modules, given as name -> syntax tree."""
    found: dict[str, set[str]] = {}
    for module, tree in trees.items():
        pairs = [(f"{source}.{name}", source) for source, name in imported(tree)]
        targets = {submodule if submodule in trees else source for submodule, source in pairs}
        found[module] = targets & trees.keys() - {module}
    return found


def read_trees() -> dict[str, ast.Module]:
    """Return the syntax tree of each module."""
    return {name: ast.parse(path.read_text()) for name, path in modules().items()}


def circle(imports: Imports) -> list[str]:
    """Return the modules of a circular import, [] if there is none."""
    try:
        TopologicalSorter(imports).prepare()
    except CycleError as error:
        return list(reversed(error.args[1]))
    return []


def package_of(module: str) -> str:
    """Return the package as named in docs/develop.md: ``lerobot_memobench.sim.world`` -> ``sim``."""
    return module.removeprefix(PACKAGE).lstrip(".").partition(".")[0]


def plan() -> dict[str, str]:
    """Return package -> responsibility, lowest first, from the table in docs/develop.md."""
    return dict(re.findall(r"^\| `(\w+)` \| (.+?) \|$", PLAN.read_text(), flags=re.MULTILINE))


def arrows(imports: Imports) -> dict[str, set[str]]:
    """Return package -> packages that its modules import."""
    found: dict[str, set[str]] = {package_of(module): set() for module in imports if package_of(module)}
    for module, targets in imports.items():
        if here := package_of(module):
            found[here] |= {package_of(target) for target in targets} - {here, ""}
    return found


def direct(found: Mapping[str, set[str]]) -> dict[str, set[str]]:
    """Return the arrows without those that follow from others: no a -> c if a -> b -> c."""

    def reach(start: str) -> set[str]:
        return set().union(*({target} | reach(target) for target in found[start]))

    return {
        here: {target for target in targets if not any(target in reach(other) for other in targets)}
        for here, targets in found.items()
    }


def layers(found: Mapping[str, set[str]]) -> list[list[str]]:
    """Return the packages in layers, lowest first; a package is one layer above the highest that it imports."""
    level: dict[str, int] = {}
    for package in TopologicalSorter(found).static_order():
        level[package] = 1 + max((level[target] for target in found[package]), default=-1)
    order = list(plan())
    return [sorted((p for p in level if level[p] == k), key=order.index) for k in range(max(level.values()) + 1)]


def size_of(package: str) -> tuple[int, int]:
    """Return files and lines of a package."""
    base = SOURCE / PACKAGE / package
    files = sorted(base.rglob("*.py")) if base.is_dir() else [base.with_suffix(".py")]
    return len(files), sum(len(path.read_text().splitlines()) for path in files)


WIDTH, HEIGHT, GAP_X, GAP_Y, SHIFT = 1.55, 0.52, 0.2, 0.36, 0.16
"""Size of a box, gaps between boxes and between layers, and the alternating shift of layers, inches."""
EDGE, TITLE, SUBTITLE, FILL = "#35506b", "#1b2733", "#4d5f70", "#eef3f8"


def draw_package(axis: Any, package: str, x: float, y: float) -> None:
    """Draw a box with a package's name and size."""
    from matplotlib.patches import FancyBboxPatch

    count, lines = size_of(package)
    corner, style = (x - WIDTH / 2, y - HEIGHT / 2), "round,pad=0,rounding_size=0.06"
    axis.add_patch(FancyBboxPatch(corner, WIDTH, HEIGHT, boxstyle=style, facecolor=FILL, edgecolor=EDGE, zorder=2))
    axis.text(x, y + 0.1, package, weight="bold", fontsize=11.5, color=TITLE, va="center", ha="center", zorder=3)
    size = f"{count} file{'s' * (count > 1)}, {lines:,} lines"
    axis.text(x, y - 0.12, size, fontsize=8.5, color=SUBTITLE, va="center", ha="center", zorder=3)


def draw_arrow(axis: Any, name: str, start: tuple[float, float], end: tuple[float, float]) -> None:
    """Draw an arrow from the bottom of a box to the top of another; ``name`` becomes its id in the SVG."""
    from matplotlib.patches import FancyArrowPatch

    (x0, y0), (x1, y1) = start, end
    lean = max(-WIDTH / 3, min(WIDTH / 3, 0.3 * (x1 - x0)))
    ends = (x0 + lean, y0 - HEIGHT / 2), (x1 - lean, y1 + HEIGHT / 2)
    arrow = FancyArrowPatch(*ends, arrowstyle="-|>", mutation_scale=11, color=EDGE, shrinkA=0, shrinkB=0, zorder=1)
    arrow.set_gid(name)
    axis.add_patch(arrow)


def draw(image: Path = IMAGE) -> None:
    """Draw packages as boxes and direct imports as arrows."""
    import matplotlib

    matplotlib.use("Agg")
    matplotlib.rcParams.update({"svg.hashsalt": "architecture", "svg.fonttype": "none", "font.family": "sans-serif"})
    from matplotlib import pyplot as plt

    found = arrows(imports_among(read_trees()))
    centres = {}
    for k, packages in enumerate(layers(found)):
        left = -(len(packages) - 1) / 2 * (WIDTH + GAP_X) + (SHIFT if k % 2 else -SHIFT)
        centres |= {p: (left + i * (WIDTH + GAP_X), k * (HEIGHT + GAP_Y)) for i, p in enumerate(packages)}
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
    figure.savefig(image, metadata={"Date": None})
    plt.close(figure)


def drawn(image: Path = IMAGE) -> dict[str, set[str]]:
    """Return the arrows of the SVG, from their ids."""
    found: dict[str, set[str]] = {}
    for here, target in re.findall(r'id="(\w+)-(\w+)"', image.read_text()):
        found.setdefault(here, set()).add(target)
    return found


if __name__ == "__main__":
    draw()
    print(IMAGE.relative_to(ROOT))
