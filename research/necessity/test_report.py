"""The table of the study in a page of the documentation."""

from __future__ import annotations

from pathlib import Path

import pytest

from lerobot_memobench.errors import MemobenchError
from research.necessity.__main__ import necessity
from research.necessity.report import PAGE_BEGIN, PAGE_END, put_into_page


def test_a_page_gets_the_table_between_its_marks(tmp_path: Path) -> None:
    page = tmp_path / "page.md"
    page.write_text(f"before\n{PAGE_BEGIN}\nold\n{PAGE_END}\nafter\n")
    text = put_into_page(page, []).read_text()
    assert text.startswith(f"before\n{PAGE_BEGIN}\n\n| task |")
    assert text.endswith(f"{PAGE_END}\nafter\n")
    assert "old" not in text
    assert put_into_page(page, []).read_text() == text
    page.write_text("no marks")
    with pytest.raises(MemobenchError, match="put them where the table goes"):
        put_into_page(page, [])
    assert page.read_text() == "no marks"


@pytest.mark.parametrize("content", [None, b"no marks", b"\xff"])
def test_a_page_without_a_place_is_told_before_anything_is_simulated(tmp_path: Path, content: bytes | None) -> None:
    page = tmp_path / "page.md"
    if content is not None:
        page.write_bytes(content)
    with pytest.raises(MemobenchError, match=r"the page .*page\.md"):
        necessity(page=page, out=tmp_path / "out")
    assert not (tmp_path / "out").exists()
