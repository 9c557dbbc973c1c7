"""The lab imports the product, never the other way round."""

from __future__ import annotations

import ast

from tests.support.scripts import load_script

architecture = load_script("architecture")


def test_the_product_imports_nothing_of_the_lab() -> None:
    sources = sorted(architecture.SOURCE.rglob("*.py"))
    assert sources
    for path in sources:
        roots = {module.partition(".")[0] for module, _ in architecture.imported(ast.parse(path.read_text()))}
        assert not roots & {"research", "tests"}, path
