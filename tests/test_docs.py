"""Every link within the documents leads somewhere: the file is there, and so is the heading."""

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
DOCUMENTS = sorted([*ROOT.glob("*.md"), *ROOT.glob("docs/**/*.md"), *ROOT.glob("src/**/*.md")])
CODE = re.compile(r"```.*?```|`[^`\n]*`", re.DOTALL)
LINK = re.compile(r"\]\(([^()\s]+)\)")


def links(document: Path) -> list[str]:
    """Return where a document's links lead, those to other sites left out."""
    text = CODE.sub("", document.read_text())
    return [to for to in LINK.findall(text) if not re.match(r"[a-z]+:", to)]


def anchors(document: Path) -> set[str]:
    """Return the names that GitHub gives a document's headings."""
    headings = re.findall(r"^#+ (.+)$", re.sub(r"```.*?```", "", document.read_text(), flags=re.DOTALL), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: str(path.relative_to(ROOT)))
def test_links_lead_somewhere(document: Path) -> None:
    broken = []
    for link in links(document):
        path, _, anchor = link.partition("#")
        there = (document.parent / path).resolve() if path else document
        if not there.exists() or (anchor and anchor not in anchors(there)):
            broken.append(link)
    assert not broken


def test_a_missing_heading_would_be_found(tmp_path: Path) -> None:
    document = tmp_path / "one.md"
    document.write_text("# Here & there\n\n[a](#here--there) [b](#nowhere) `[c](#code)` [d](https://a.b#c)\n")
    assert links(document) == ["#here--there", "#nowhere"]
    assert anchors(document) == {"here--there"}
