"""The rules of docs/develop.md for packages and imports, checked in the source."""

from __future__ import annotations

import ast
import re
from collections.abc import Collection, Iterator
from functools import cache

from tests.support.scripts import load_script

architecture = load_script("architecture")
PACKAGE = architecture.PACKAGE


@cache
def trees() -> dict[str, ast.Module]:
    """Return the syntax tree of each module; cached, and not read during collection."""
    return architecture.read_trees()


@cache
def imports() -> dict[str, set[str]]:
    return architecture.imports_among(trees())


def test_develop_page_lists_all_packages() -> None:
    assert set(architecture.plan()) == {architecture.package_of(name) for name in imports()} - {""}


def upward_imports(found: dict[str, set[str]], order: list[str]) -> list[str]:
    """Return the imports of a package that is listed below the importing one."""
    level = {"": -1} | {package: k for k, package in enumerate(order)}
    rank = {name: level[architecture.package_of(name)] for name in found}
    return [f"{name} imports {target}" for name in found for target in found[name] if rank[target] > rank[name] >= 0]


def test_imports_follow_package_order() -> None:
    assert upward_imports(imports(), list(architecture.plan())) == []


def test_imported_modules_exist() -> None:
    """mypy ignores missing imports."""
    missing = [
        f"{name} imports {source}"
        for name, tree in trees().items()
        for source, _ in architecture.imported(tree)
        if source.partition(".")[0] == PACKAGE and source not in imports()
    ]
    assert not missing


def test_rasterizer_imports_nothing_of_this_project() -> None:
    """`mujoco_raster` is a package of its own: it can be used, and published, without the benchmark."""
    files = sorted((architecture.SOURCE / "mujoco_raster").rglob("*.py"))
    found = {source for path in files for source, _ in architecture.imported(ast.parse(path.read_text()))}
    ours = {path.name for path in architecture.SOURCE.iterdir()} | {"research", "tests"}
    assert {source for source in found if source.partition(".")[0] in ours - {"mujoco_raster"}} == set()
    assert "mujoco_raster" in {source.partition(".")[0] for source in found}


def test_packages_import_neither_research_nor_tests() -> None:
    sources = sorted(architecture.SOURCE.rglob("*.py"))
    found = {source for path in sources for source, _ in architecture.imported(ast.parse(path.read_text()))}
    assert {source.partition(".")[0] for source in found} & {"research", "tests", PACKAGE} == {PACKAGE}


def test_no_circular_imports() -> None:
    assert architecture.circle(imports()) == []


def test_no_platform_specific_modules() -> None:
    """Reports and training must work on Windows and macOS."""
    unix = {"fcntl", "grp", "posix", "pty", "pwd", "resource", "syslog", "termios", "tty"}
    windows = {"_winapi", "msvcrt", "winreg"}
    found = [(name, source) for name, tree in trees().items() for source, _ in architecture.imported(tree)]
    assert [(name, source) for name, source in found if source in unix | windows] == []


def renames(tree: ast.AST) -> Iterator[str]:
    """Yield calls that rename files or create temporary files."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute):
            call = ast.unparse(node.func)
            creates = node.func.attr in ("rename", "mkstemp", "mktemp", "NamedTemporaryFile")
            path_replaces = node.func.attr == "replace" and len(node.args) == 1 and not node.keywords
            if creates or path_replaces or call in ("os.replace", "shutil.move"):
                yield call


def test_only_io_writes_files_atomically() -> None:
    """The other allowed modules move finished folders that no other process uses."""
    datasets = ("datasets.stage", "datasets.write")
    movers = ("io", *datasets, "training.trainer")
    allowed = {f"{PACKAGE}.{name}" for name in movers}
    assert [(name, call) for name, tree in trees().items() for call in renames(tree) if name not in allowed] == []


def is_private(name: str) -> bool:
    return name.startswith("_") and not name.endswith("__")


def private_uses(tree: ast.AST, known: Collection[str]) -> Iterator[str]:
    """Yield private names of other modules: ``from module import _name`` and ``module._name``."""
    froms = [node for node in ast.walk(tree) if isinstance(node, ast.ImportFrom) and node.module]
    taken = [(node.module, alias) for node in froms for alias in node.names if str(node.module).startswith(PACKAGE)]
    yield from (f"{module}.{alias.name}" for module, alias in taken if is_private(alias.name))
    bound = {alias.asname or alias.name for module, alias in taken if f"{module}.{alias.name}" in known}
    for node in ast.walk(tree):
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id in bound:
            yield from [f"{node.value.id}.{node.attr}"] * is_private(node.attr)


def test_private_names_stay_in_their_module() -> None:
    assert [(name, use) for name, tree in trees().items() for use in private_uses(tree, trees())] == []


def test_checks_detect_violations() -> None:
    sources = {
        "p": "from p import a",
        "p.a": "def f():\n    from p import b",
        "p.b": "import p.a, os\nfrom p.b import c",
    }
    found = architecture.imports_among({name: ast.parse(source) for name, source in sources.items()})
    assert found == {"p": {"p.a"}, "p.a": {"p.b"}, "p.b": {"p.a"}}
    assert set(architecture.circle(found)) == {"p.a", "p.b"}
    modules = {f"{PACKAGE}.{name}": {f"{PACKAGE}.{target}"} for name, target in (("io", "sim.x"), ("sim.x", "io"))}
    assert upward_imports(modules, ["io", "sim"]) == [f"{PACKAGE}.io imports {PACKAGE}.sim.x"]
    calls = "os.replace(a, b); a.replace(b); draft.rename(b); tempfile.mkstemp(); 'text'.replace('t', 'x')"
    assert len(list(renames(ast.parse(calls)))) == 4
    source = f"from {PACKAGE}.sim import world\nfrom {PACKAGE}.io import _to_disk\nworld._x, world.__doc__"
    assert list(private_uses(ast.parse(source), trees())) == [f"{PACKAGE}.io._to_disk", "world._x"]


def test_image_shows_current_imports() -> None:
    found = architecture.direct(architecture.arrows(imports()))
    assert architecture.drawn() == {here: targets for here, targets in found.items() if targets}, (
        "update the image: python scripts/architecture.py"
    )


def test_developer_pages_name_existing_files() -> None:
    source, pages = architecture.SOURCE / PACKAGE, sorted((architecture.ROOT / "docs" / "develop").glob("*.md"))
    assert len(pages) == 7
    folders = [architecture.ROOT, source, *(path for path in source.rglob("*") if path.is_dir())]
    for page in pages:
        names = re.findall(r"`([\w/]+\.py)", page.read_text())
        assert [name for name in names if not any((base / name).is_file() for base in (page.parent, *folders))] == []
        long = ("way_of_a_frame.md", "scenes.md", "add_an_object_class.md")  # the last one has files in full
        assert page.name in long or len(page.read_text().splitlines()) <= 40
