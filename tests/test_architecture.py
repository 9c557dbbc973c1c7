"""What docs/develop.md promises of the packages, read from the source: order, circles, private names."""

from __future__ import annotations

import ast
import re
from collections.abc import Collection, Iterator
from functools import cache

from tests.support.scripts import load_script

architecture = load_script("architecture")
PACKAGE = architecture.PACKAGE


@cache
def imports() -> dict[str, set[str]]:
    """Return what each module imports; not read while tests are collected, which every worker does."""
    return architecture.read_imports()


@cache
def trees() -> dict[str, ast.Module]:
    """Return each module as it is parsed."""
    return {name: ast.parse(path.read_text()) for name, path in architecture.modules().items()}


def test_the_plan_names_every_package() -> None:
    listed = set(architecture.plan())
    there = {architecture.package_of(name) for name in imports()} - {""}
    assert listed == there, "docs/develop.md lists the packages, lowest first"


def test_imports_go_down_the_plan_only() -> None:
    order = list(architecture.plan())
    upwards = [
        f"{name} imports {target}"
        for name, targets in imports().items()
        for target in targets
        if architecture.package_of(name) and target != PACKAGE
        if order.index(architecture.package_of(target)) > order.index(architecture.package_of(name))
    ]
    assert not upwards


def test_what_is_imported_from_the_project_is_there() -> None:
    """The type checker lets an import of a module that is gone pass."""
    known = set(imports())
    absent = [
        f"{name} imports {source}"
        for name, tree in trees().items()
        for source, _ in architecture.imported(tree)
        if source.partition(".")[0] == PACKAGE and source not in known
    ]
    assert not absent


def test_no_files_import_each_other_in_a_circle() -> None:
    assert architecture.circle(imports()) == []


def test_a_circle_is_found() -> None:
    assert architecture.circle({"a": {"b"}, "b": {"c"}, "c": set()}) == []
    assert set(architecture.circle({"a": {"b"}, "b": {"c"}, "c": {"b"}})) == {"b", "c"}


def test_no_module_of_one_system_is_imported() -> None:
    """Each can be imported on Windows and macOS, whose users read reports and train without the simulator."""
    of_unix = {"fcntl", "grp", "posix", "pty", "pwd", "resource", "syslog", "termios", "tty"}
    of_windows = {"_winapi", "msvcrt", "winreg"}
    found = [(name, source) for name, tree in trees().items() for source, _ in architecture.imported(tree)]
    assert [(name, source) for name, source in found if source in of_unix | of_windows] == []


def renamed(tree: ast.AST) -> Iterator[str]:
    """Yield calls that give a file its name once it is written, or make a file under a name of their own."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute):
            call = ast.unparse(node.func)
            made = node.func.attr in ("rename", "mkstemp", "mktemp", "NamedTemporaryFile")
            path_replaces = node.func.attr == "replace" and len(node.args) == 1 and not node.keywords
            if made or path_replaces or call in ("os.replace", "shutil.move"):
                yield call


def test_files_are_written_whole_in_one_place() -> None:
    """Elsewhere finished folders are moved, by the one process that holds their destination."""
    movers = (
        "io",
        "datasets.staging",
        "datasets.lerobot_format.assembling",
        "training.view",
        "policies.update_checkpoint",
    )
    allowed = {f"{PACKAGE}.{name}" for name in movers}
    assert [(name, call) for name, tree in trees().items() for call in renamed(tree) if name not in allowed] == []


def test_a_renaming_is_found() -> None:
    source = "os.replace(a, b); a.replace(b); draft.rename(b); tempfile.mkstemp(); 'text'.replace('t', 'x')"
    assert len(list(renamed(ast.parse(source)))) == 4


def is_private(name: str) -> bool:
    return name.startswith("_") and not name.endswith("__")


def private_names(tree: ast.AST, known: Collection[str]) -> Iterator[str]:
    """Yield what a file takes by ``from module import _name``, and what it reads as ``module._name``."""
    froms = [node for node in ast.walk(tree) if isinstance(node, ast.ImportFrom) and node.module]
    taken = [(node.module, alias) for node in froms for alias in node.names if str(node.module).startswith(PACKAGE)]
    yield from (f"{module}.{alias.name}" for module, alias in taken if is_private(alias.name))
    bound = {alias.asname or alias.name for module, alias in taken if f"{module}.{alias.name}" in known}
    for node in ast.walk(tree):
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id in bound:
            yield from [f"{node.value.id}.{node.attr}"] * is_private(node.attr)


def test_no_private_name_crosses_modules() -> None:
    assert [(name, found) for name, tree in trees().items() for found in private_names(tree, trees())] == []


def test_a_private_name_is_found() -> None:
    source = f"from {PACKAGE}.sim import world\nfrom {PACKAGE}.io import _to_disk\nworld._x, world.__doc__"
    assert list(private_names(ast.parse(source), trees())) == [f"{PACKAGE}.io._to_disk", "world._x"]


def test_the_picture_shows_the_imports_of_today() -> None:
    wanted = {here: targets for here, targets in architecture.direct(architecture.arrows(imports())).items() if targets}
    assert architecture.drawn() == wanted, "draw it anew: python scripts/architecture.py"


def test_the_pages_for_newcomers_name_what_is_there() -> None:
    source, pages = architecture.SOURCE / PACKAGE, sorted((architecture.ROOT / "docs" / "develop").glob("*.md"))
    assert len(pages) == 6
    for page in pages:
        assert page.name in ("way_of_a_frame.md", "paper_world.md") or len(page.read_text().splitlines()) <= 40
        names = re.findall(r"`([\w/]+\.py)", page.read_text())
        here = [architecture.ROOT, source, page.parent, *(path for path in source.rglob("*") if path.is_dir())]
        assert [name for name in names if not any((base / name).is_file() for base in here)] == []
