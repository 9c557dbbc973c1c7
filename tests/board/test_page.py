"""The board's page in headless Chromium: its columns sort."""

from __future__ import annotations

from pathlib import Path

import pytest

from lerobot_memobench.board.submission import About, write_submission
from tests.support import browser as chromium
from tests.support.board import ABOUT, evaluation
from tools.board import page as board

DOCS = Path(__file__).parents[2] / "docs"


@pytest.mark.skipif(
    chromium.find_chromium() is None,
    reason="Chromium is missing; `make test` installs it where it may, else: apt-get install chromium",
)
def test_board_is_sorted_by_a_click(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The page has the heading *Board*, whose id is ``board``, as MkDocs makes it."""
    markdown = pytest.importorskip("markdown", reason="the dependencies of the site are missing")
    for k, name in enumerate(("one", "two")):
        made = evaluation(tmp_path / name, speed=50 + 40 * k, evidence=k == 0)
        about = About(**ABOUT | {"model": name.title(), "parameters": 10 + k})
        write_submission(tmp_path / "board" / name, about, {"": made})
    monkeypatch.setattr(board, "BOARD", tmp_path / "board")
    text = (DOCS / "benchmark" / "board.md").read_text().replace(board.PLACE, board.table())
    html = markdown.markdown(text, extensions=["md_in_html", "tables", "toc"])
    assert '<h1 id="board">' in html
    script = (DOCS / "javascripts" / "board.js").as_uri()
    page = tmp_path / "board.html"
    page.write_text(f'<!doctype html><meta charset="utf-8"><script src="{script}"></script>\n{html}')
    browser = chromium.Browser(tmp_path / "profile")
    try:
        browser.open(page.as_uri())
        ids = browser.js("[...document.querySelectorAll('[id]')].map((each) => each.id)")
        assert len(ids) == len({*ids})
        for column, order in (("policy", 1), ("SR", -1), ("parameters", -1)):
            number = board.HEAD.index(column) + 1
            cells = f"#{board.TABLE} tbody tr td:nth-child({number})"
            values = f"[...document.querySelectorAll('{cells}')].map((each) => each.dataset.sort)"
            for sign in (order, -order):
                browser.click(f"#{board.TABLE} th:nth-child({number}) button")
                found = browser.js(values)
                wanted = sorted(found, key=float if column != "policy" else str, reverse=sign < 0)
                assert found == wanted
                assert len({*found}) > 1
        assert browser.errors == []
    finally:
        browser.close()
