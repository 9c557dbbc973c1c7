"""Every link within the documents leads somewhere: the file is there, and so is the heading."""

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
DOCUMENTS = sorted([*ROOT.glob("*.md"), *ROOT.glob("docs/**/*.md"), *ROOT.glob("src/**/*.md")])
BLOCK = re.compile(r"```.*?```", re.DOTALL)
WORDS = re.compile(r"`[^`\n]*`")
LINK = re.compile(r"\]\(([^()\s]+)\)")


def links(document: Path) -> list[str]:
    """Return where a document's links lead, those to other sites left out."""
    text = WORDS.sub("", BLOCK.sub("", document.read_text()))
    return [to for to in LINK.findall(text) if not re.match(r"[a-z]+:", to)]


def anchors(document: Path) -> set[str]:
    """Return the names that GitHub gives a document's headings."""
    headings = re.findall(r"^#+ (.+)$", BLOCK.sub("", document.read_text()), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


def broken(document: Path) -> list[str]:
    """Return a document's links that lead nowhere."""
    found = []
    for link in links(document):
        path, _, anchor = link.partition("#")
        there = (document.parent / path).resolve() if path else document
        if not there.exists() or (anchor and anchor not in anchors(there)):
            found.append(link)
    return found


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: str(path.relative_to(ROOT)))
def test_links_lead_somewhere(document: Path) -> None:
    assert not broken(document)


def test_what_leads_nowhere_is_found(tmp_path: Path) -> None:
    document = tmp_path / "one.md"
    document.write_text(
        "# Here & there\n\n[a](#here--there) [b](#nowhere) [e](two.md) `[c](#code)` [d](https://a.b#c)\n"
    )
    assert links(document) == ["#here--there", "#nowhere", "two.md"]
    assert anchors(document) == {"here--there"}
    assert broken(document) == ["#nowhere", "two.md"]


@pytest.mark.parametrize("command", ["eval", "train"])
def test_the_table_of_short_forms_is_the_help(command: str) -> None:
    text = (ROOT / "docs" / {"eval": "evaluate.md", "train": "train.md"}[command]).read_text()
    lines = text[text.index("| short form |") :].split("\n\n")[0].splitlines()[2:]
    plain = [re.sub(r"\[([^][]*)\]\([^)]*\)", r"\1", line).replace("`", "") for line in lines]
    rows = [[cell.strip() for cell in line.strip("| ").split(" | ")] for line in plain]
    assert rows == [row[: len(rows[0])] for row in helped(command)]


def helped(command: str) -> list[list[str]]:
    """Return the rows of the help: what is typed, what it sets, what holds without it ("" where nothing is said)."""
    text = (ROOT / "src/lerobot_memobench/cli" / f"lerobot_{command}.txt").read_text()
    blocks = re.findall(r"^  (\S.*)\n((?: {8}.*\n)+)", text, re.MULTILINE)
    told = [(typed, " ".join(explained.split())) for typed, explained in blocks]
    splits = [(typed, *re.fullmatch(r"(.*?)(?: \(default: (.*)\))?", words).groups("")) for typed, words in told]
    return [list(row) for row in splits]
