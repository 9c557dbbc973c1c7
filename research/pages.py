"""Markdown pages of which a study's command makes a part, between two marks."""

from __future__ import annotations

from pathlib import Path

from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.io import write_file

END = "<!-- end of what it made -->"


def begin(study: str) -> str:
    """Return the mark before what ``python -m research.<study> --page`` makes."""
    return f"<!-- made by `python -m research.{study} --page`: -->"


def around(page: Path, study: str) -> tuple[str, str]:
    """Return what stands before and after a study's part of a page, its marks included.

    Raises:
        MemobenchError: there is no such page, or it lacks the marks.
    """
    try:
        text = page.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        reason = getattr(error, "strerror", None) or error
        raise MemobenchError(f"the page {page} cannot be read ({reason}); name a Markdown file") from None
    before, mark, rest = text.partition(begin(study))
    _, end, after = rest.partition(END)
    if not mark or not end:
        raise MemobenchError(
            f"the page {page} lacks the lines {begin(study)!r} and {END!r}; put them where the table goes"
        )
    return before + mark, end + after


def put_into(page: Path, study: str, made: str) -> Path:
    """Put what a study made into a page, between its two marks; return the page.

    Raises:
        MemobenchError: see `around`.
    """
    before, after = around(page, study)
    return write_file(page, f"{before}\n\n{made}\n\n{after}")
