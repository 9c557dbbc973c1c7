"""The documents: links lead somewhere, commands are understood, hashes stay in the research notes, README is short."""

from __future__ import annotations

import dataclasses
import importlib.util
import io
import os
import re
import shlex
import subprocess
import sys
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import typer
from PIL import Image

from lerobot_memobench.cli import memobench
from lerobot_memobench.envs import episode_log, evaluation_file
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.evaluation.metrics import Rate
from lerobot_memobench.policies.memobench_mem.memory import OURS
from lerobot_memobench.run.arguments import (
    is_of_benchmark,
    joined,
    read_arguments,
    resolve_recipe,
    split_arguments,
)
from lerobot_memobench.run.plan import take_run_options
from lerobot_memobench.run.settings import read_settings
from lerobot_memobench.training.command import take_training_options
from tests.support.logs import rollout
from tests.support.scripts import load_script

reference = load_script("docs_reference")
recompute = load_script("recompute")

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
NOTES = DOCS / "research"
PAGES = sorted([*ROOT.glob("*.md"), *DOCS.glob("**/*.md")])
DOCUMENTS = [*PAGES, *sorted(ROOT.glob("src/**/*.md"))]
BY_HAND = [page for page in PAGES if NOTES not in page.parents or page.name in ("index.md", "logs.md")]
"""What is kept up to date; notes are frozen."""
MADE = {(DOCS / path).resolve() for path in (*reference.PAGES, *reference.COPIES.values())}
"""Pages that the site's build makes."""
BLOCK = re.compile(r"```.*?```", re.DOTALL)
WORDS = re.compile(r"`[^`\n]*`")
LINK = re.compile(r"\]\(([^()\s]+)\)")


def name(document: Path) -> str:
    """Return a document's place in the repository."""
    return str(document.relative_to(ROOT))


# --- links ---


def links(document: Path) -> list[str]:
    """Return where a document's links lead, those to other sites left out."""
    text = WORDS.sub("", BLOCK.sub("", document.read_text()))
    return [to for to in LINK.findall(text) if not re.match(r"[a-z]+:", to)]


def anchors(document: Path) -> set[str]:
    """Return the names that GitHub gives a document's headings."""
    headings = re.findall(r"^#+ (.+)$", BLOCK.sub("", document.read_text()), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


def broken(document: Path) -> list[str]:
    """Return a document's links that lead nowhere. Of pages that are made only the site's build knows the anchors."""
    found = []
    for link in links(document):
        path, _, anchor = link.partition("#")
        there = (document.parent / path).resolve() if path else document
        if there in MADE:
            continue
        if not there.exists() or (anchor and anchor not in anchors(there)):
            found.append(link)
    return found


@pytest.mark.parametrize("document", DOCUMENTS, ids=name)
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


def test_the_readme_needs_no_page_that_only_the_site_has() -> None:
    assert not [link for link in links(ROOT / "README.md") if (ROOT / link.partition("#")[0]).resolve() in MADE]


# --- what belongs into the notes ---

HASH = re.compile(r"\b(?=[0-9a-f]*[0-9])(?=[0-9a-f]*[a-f])[0-9a-f]{7,64}\b")
PROCESSOR = re.compile(r"\b(Xeon|EPYC|Ryzen|Opteron|Haswell|Skylake|Zen ?\d|A40|A100|H100|H200|llvmpipe)\b")


def of_a_laboratory(text: str) -> list[str]:
    """Return hashes, commits and names of processors in a text."""
    return [found[0] for pattern in (HASH, PROCESSOR) for found in pattern.finditer(text)]


@pytest.mark.parametrize("document", BY_HAND, ids=name)
def test_hashes_commits_and_processors_stay_in_the_notes(document: Path) -> None:
    assert not of_a_laboratory(document.read_text())


def test_what_belongs_into_the_notes_is_found() -> None:
    assert of_a_laboratory("log `12cac04f`, commit 7b9c630, 1,500 of 1500000000, defaced, on an EPYC") == [
        *("12cac04f", "7b9c630", "EPYC"),
    ]


@pytest.mark.parametrize("note", sorted(set(NOTES.glob("*.md")) - {NOTES / "index.md"}), ids=name)
def test_notes_are_dated(note: Path) -> None:
    assert re.search(r"\b(20\d\d-\d\d-\d\d|\d{1,2} [A-Z][a-z]+ 20\d\d)\b", "\n".join(note.read_text().splitlines()[:6]))


def test_the_readme_is_short() -> None:
    assert len((ROOT / "README.md").read_text().splitlines()) <= 120


def test_every_page_has_its_place_in_the_site() -> None:
    """The strict build says so too; here it is said without MkDocs."""
    told = set(pages_of_the_site())
    there = {str(page.relative_to(DOCS)) for page in DOCS.glob("**/*.md")}
    assert told == there | set(reference.PAGES) | set(reference.COPIES.values())


def pages_of_the_site() -> list[str]:
    return re.findall(r"[\w/-]+\.md", (ROOT / "mkdocs.yml").read_text().partition("\nnav:")[2])


def test_no_two_pages_share_an_address() -> None:
    addresses = Counter(re.sub(r"(^|/)index$", "", page.removesuffix(".md")) for page in pages_of_the_site())
    assert [address for address, count in addresses.items() if count > 1] == []


@pytest.mark.slow
def test_the_site_is_built_strictly(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(tmp_path)]
    environment = {**os.environ, "NO_MKDOCS_2_WARNING": "1"}
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert "The memory study" in (tmp_path / "research/study/index.html").read_text()


# --- figures ---


@pytest.mark.parametrize("page", recompute.PAGES, ids=name)
def test_published_figures_are_those_of_their_sources(page: Path) -> None:
    assert [*recompute.problems_of_tables(page), *recompute.problems_of_prose(page)] == []
    assert any(recompute.source_of(page, source) for _, _, source in recompute.rows_of(page))


def test_claims_and_their_sources_stand_where_the_list_has_them() -> None:
    assert recompute.problems_of_claims() == []


def test_every_log_is_among_the_results() -> None:
    """Or, of a comparison with stock LIBERO, on the page of the paper's world."""
    there = {folder.name for folder in recompute.LOGS.iterdir() if folder.is_dir()}
    results, world = (
        set(re.findall(r"research/logs/([\w-]+)/", page.read_text()))
        for page in (recompute.PAGES[1], ROOT / "docs" / "develop" / "paper_world.md")
    )
    assert results | {name for name in world if name.startswith("bridge_")} == there


@pytest.mark.parametrize(
    ("rate", "words"),
    [
        (Rate(0.979, 1500), "97.9 [97.0–98.5]"),
        (Rate(1.0, 1500), "100 [99.7–100]"),
        (Rate(0.0, 150), "0 [0–2.5]"),
        (Rate(None, 0), "–"),
    ],
)
def test_a_rate_as_documents_write_it(rate: Rate, words: str) -> None:
    assert recompute.in_words(rate) == words


def test_logs_are_small() -> None:
    assert sum(file.stat().st_size for file in recompute.LOGS.glob("**/*")) < 2_000_000


HEAD = "| policy | SR | MSR | MUR | MCR | rollouts | |\n|---|---|---|---|---|---:|---|\n"
KEPT = "75.0 [30.1–95.4]"


@pytest.mark.parametrize(
    ("row", "problem"),
    [
        (f"| a | {KEPT} | {KEPT} | – | – | 4 | [log](logs/one/episodes.jsonl) |", None),
        (f"| a | {KEPT} | | | | | [log](logs/one/episodes.jsonl) |", None),
        (
            "| a | 76.0 [30.1–95.4] | | | | 4 | [log](logs/one/episodes.jsonl) |",
            "SR 76.0 .*, and 75.0 .* by its source",
        ),
        (f"| a | {KEPT} | | | | 5 | [log](logs/one/episodes.jsonl) |", "rollouts 5, and 4 by its source"),
        (f"| a | {KEPT} | | | | 4 | [note](note.md) |", "does not say 'log not kept'"),
        (f"| a | {KEPT} | | | | 4 | [note](note.md), log not kept |", None),
        ("| a | 100 [96.3–100] | | | | 100 | [seeds](run/tables.md) |", None),
        ("| a | 100 [96.3–100] | | | | 100 | [seeds](short/tables.md) |", "100 .*, and 99.0 .* by its source"),
    ],
)
def test_a_figure_that_differs_from_its_source_is_found(tmp_path: Path, row: str, problem: str | None) -> None:
    task = "turn_on_the_stove_and_turn_it_off"
    lines = [rollout(task, "temporal", "S", [k > 0], k > 0, k) for k in range(4)]
    episode_log.write_episodes(tmp_path / "logs" / "one", lines)
    for folder, told in (
        ("run", "All 100 seeds asked for were solved"),
        ("short", "**1 of 100 seeds asked for have no"),
    ):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "tables.md").write_text(f"{told} demonstration here.\n")
    page = tmp_path / "page.md"
    page.write_text(f"{HEAD}{row}\n")
    found = recompute.problems_of_tables(page)
    assert len(found) == (problem is not None)
    assert problem is None or re.search(problem, found[0])


def test_rows_of_evidence_are_recomputed(tmp_path: Path) -> None:
    """One scene of two variants, of which both were answered by the first."""
    task = "put_the_butter_into_the_bowl_from_the_prompt_video"
    asked = [{"episode": k, "variant": k, "variants": 2, "choice": 0, "chance": 0.5} for k in (0, 1)]
    lines = [rollout(task, "object", "S", [True], one["choice"] == one["variant"], 7) | one for one in asked]
    episode_log.write_episodes(tmp_path / "logs" / "one", lines)
    page, log = tmp_path / "page.md", "[log](logs/one/episodes.jsonl)"
    interval = recompute.of_log(tmp_path / "logs" / "one")["follows"]
    assert interval.startswith("50.0 [")
    for told, wrong in ((interval, 0), ("90.0 [80–100]", 1)):
        page.write_text(f"| policy | follows | chance | |\n|---|---|---|---|\n| a | {told} | 50.0 | {log} |\n")
        assert len(recompute.problems_of_tables(page)) == wrong


def test_a_claim_that_went_or_that_nobody_listed_is_found(tmp_path: Path) -> None:
    page, claims = tmp_path / "page.md", tmp_path / "claims.md"
    (tmp_path / "note.md").write_text("It solved | 50 | of\n50.\n")
    page.write_text("With a memory 99\n[95–100].\n")
    head = "| page | it says | source | the source says | kept |\n|---|---|---|---|---|\n"
    claims.write_text(f"{head}| [page](page.md) | memory 99 [95–100] | [note](note.md) | 50 of 50 | no |\n")
    assert recompute.problems_of_claims(claims) == recompute.problems_of_prose(page, claims) == []
    claims.write_text(f"{head}| [page](page.md) | memory 98 | [note](note.md) | 49 of 50 | no |\n")
    assert [problem.split(" does")[0] for problem in recompute.problems_of_claims(claims)] == ["page.md", "note.md"]
    assert len(recompute.problems_of_prose(page, claims)) == 1


# --- commands ---


def commands(document: Path) -> Iterator[list[str]]:
    """Yield the words of each command in a document's shell blocks."""
    for block in re.findall(r"```bash\n(.*?)```", document.read_text(), re.DOTALL):
        for line in re.sub(r"\\\n\s*", " ", block).splitlines():
            words: list[str] = []
            for word in shlex.split(line, comments=True):
                if word == "&&":
                    yield words
                    words = []
                else:
                    words.append(word)
            if words:
                yield words


TYPED = [(document, words) for document in BY_HAND for words in commands(document)]


@pytest.mark.parametrize(("document", "words"), TYPED, ids=lambda it: name(it) if isinstance(it, Path) else it[0])
def test_commands_are_understood(document: Path, words: list[str]) -> None:
    check(words)


def check(words: list[str]) -> None:
    """Raise where a command is none, or has an argument that it does not know. Nothing is run."""
    program, *rest = words
    if program == "accelerate":  # it starts what stands behind `$(which lerobot)`
        program, rest = "lerobot", rest[rest.index("lerobot)") + 1 :]
    match program:
        case "lerobot":
            check_lerobot(rest[0], rest[1:])
        case "lerobot-eval" | "lerobot-train":
            check_lerobot(program.partition("-")[2], [as_pair(word) for word in joined(rest)])
        case "memobench":
            check_memobench(rest)
        case "python":
            check_python(rest)
        case "vla-eval":
            check_vla_eval(rest)
        case "lerobot-dataset-viz":
            check_viewer(rest)
        case "make":
            assert re.search(rf"^{rest[0]}:", (ROOT / "Makefile").read_text(), re.MULTILINE)
        case _ if program.startswith("scripts/"):
            assert (ROOT / program).is_file(), program
        case _:
            assert program in ("source", "pip", "uv", "gzip"), f"{program} is no command that the documents use"


def as_pair(flag: str) -> str:
    """Return a flag of LeRobot's as a pair: ``--env.type=x`` is ``env=x``."""
    key, _, value = flag.removeprefix("--").partition("=")
    return f"{key.removesuffix('.type').removesuffix('.path')}={value}"


def check_lerobot(command: str, line: list[str]) -> None:
    """Read a line as `lerobot` does. Folders, repositories and the example of the documents are not there: others stand
    for them.
    """
    stand_in = {"policy": "policy=memobench_mem", "dataset": "dataset.root=outputs"}
    pairs = [stand_in[key] if (key := word.partition("=")[0]) in stand_in and is_place(word) else word for word in line]
    given = split_arguments(pairs)
    if command == "eval" and is_of_benchmark(given):
        read_settings(take_run_options(given)[1])
        return
    if command == "train":
        given = take_training_options(resolve_recipe(given))[-1]
    read_arguments(command, given)


def is_place(pair: str) -> bool:
    """Whether a pair's value is a folder, a repository, or the policy of `examples/`."""
    key, _, value = pair.partition("=")
    return key == "dataset" or "/" in value or pair == "policy=window"


def check_vla_eval(line: list[str]) -> None:
    """Parse a line as vla-evaluation-harness does."""
    from vla_eval.cli import main

    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(sys, "argv", ["vla-eval", *line])
        patched.setattr(main, "cmd_run", lambda _: None)
        main.main()


def check_viewer(line: list[str]) -> None:
    """See that LeRobot's viewer knows the flags; its parser cannot be had without running it."""
    spec = importlib.util.find_spec("lerobot.scripts.lerobot_dataset_viz")
    assert spec is not None
    known = set(re.findall(r"add_argument\(\s*\"(--[\w-]+)\"", Path(str(spec.origin)).read_text()))
    assert not {word for word in line if word.startswith("--")} - known


def check_memobench(line: list[str]) -> None:
    """Parse a line as `memobench` does."""
    command: Any = typer.main.get_command(memobench.app)
    path = ["memobench"]
    if line[0].startswith("-"):
        assert line in (["--help"], ["--version"])
        return
    while hasattr(command, "commands"):
        if line[:1] == ["--help"]:
            return
        command = command.commands[line[0]]
        path, line = [*path, line[0]], line[1:]
    if line != ["--help"]:
        command.make_context(" ".join(path), list(line))


def click_error() -> type[Exception]:
    """Return the error of an option that a command does not know."""
    try:
        check_memobench(["tasks", "--no-such"])
    except Exception as error:
        return type(error)
    raise AssertionError("an option that is none was understood")


def check_python(line: list[str]) -> None:
    """See that the script or module is there."""
    if line[0] == "-m":
        assert importlib.util.find_spec(line[1]), line[1]
    elif line[0] != "-c":
        assert (ROOT / line[0]).is_file(), line[0]


@pytest.mark.parametrize(
    "line",
    [
        "lerobot eval env=memobench episode=10",
        "lerobot-eval --env.type=memobench --env.tusks=object",
        "lerobot train policy=memobench_mem memory_strides=3",
        "memobench generate --task object",
        "lerobot-dataset-viz --episode 0",
        "memobench no_such",
        "python examples/no_such.py",
        "make coffee",
        "roscore",
    ],
)
def test_commands_that_are_not_understood_are_found(line: str) -> None:
    with pytest.raises((MemobenchError, AssertionError, KeyError, click_error())):
        check(shlex.split(line))


# --- short forms, and pages that are made ---


@pytest.mark.parametrize("command", ["eval", "train"])
def test_short_forms_are_those_of_the_help(command: str) -> None:
    """Guides name the most used ones, the reference all."""
    helped = {word for typed, *_ in reference.short_forms(command) for word in re.findall(r"\w+=", typed)}
    text = (DOCS / "guides" / {"eval": "evaluate.md", "train": "train.md"}[command]).read_text()
    lines = text[text.index("| short form |") :].split("\n\n")[0].splitlines()[2:]
    typed = {word for line in lines for word in re.findall(r"\w+=", line.split("|")[1])}
    assert typed
    assert typed <= helped
    page = reference.lerobot_page().partition(f"## lerobot {command}")[2].partition("\n## ")[0]
    assert all(f"`{word}`" in page for word in helped)


@pytest.mark.parametrize("page", reference.PAGES)
def test_pages_that_are_made(page: str) -> None:
    text = reference.PAGES[page]()
    assert text.startswith("# ")
    for block in re.findall(r"(?:^\|.*\n)+", text, re.MULTILINE):
        widths = {len(re.findall(r"(?<!\\)\|", row)) for row in block.splitlines()}
        assert len(widths) == 1, block


def test_every_field_of_the_log_is_explained() -> None:
    for kind in (
        episode_log.EpisodeRecord,
        episode_log.CheckpointRecord,
        evaluation_file.WholeProtocol,
        evaluation_file.WholeCard,
        evaluation_file.CardEpisode,
    ):
        assert all(says for _, says, _ in reference.typed_rows(kind)), kind
    rows = reference.typed_rows(episode_log.EpisodeRecord)
    assert [name.strip("`") for name, _, kind in rows if kind.endswith("required")] == [
        *("task", "memory_type", "episode", "success", "checkpoints"),
    ]


def test_every_task_has_a_card() -> None:
    from lerobot_memobench.tasks.catalogue import task_names

    for suite in ("published", "strict"):
        text = reference.tasks_page(suite)
        assert all(f"\n`{one}`\n" in text for one in task_names(suite=suite))
        assert text.count("needs a memory") >= 30


@pytest.mark.parametrize("number", [1, 6, 20, 30])
def test_a_card_has_its_tasks_picture(number: int) -> None:
    """It is cut out of the sheet of all, along the picture's edge: the sheet's ground is nearly white."""
    with Image.open(io.BytesIO(reference.scene(number))) as picture:
        pixels = np.asarray(picture.convert("RGB")).astype(int)
    assert pixels.shape == (256, 256, 3)
    assert max(edge.mean() for edge in (pixels[0], pixels[-1], pixels[:, 0], pixels[:, -1])) < 230


def test_every_setting_of_a_policy_is_in_the_reference() -> None:
    from lerobot_memobench.policies.memobench_mem.configuration_memobench_mem import MemobenchMemConfig

    page = reference.policies_page()
    own = {field.name for field in dataclasses.fields(MemobenchMemConfig)} & set(MemobenchMemConfig.__annotations__)
    assert [field for field in own if f"`{field}`" not in page] == []


def test_cells_break_where_names_do_and_not_within_intervals() -> None:
    page = '<p>a_b</p><td><a href="x_y.html"><code>env.obs_type</code></a> 97.9 [96.9–98.5]</td>'
    assert reference.breakable(page) == (
        '<p>a_b</p><td><a href="x_y.html"><code>env.<wbr>obs_<wbr>type</code></a> '
        '97.9 <span class="interval">[96.9–98.5]</span></td>'
    )


def test_links_that_leave_the_site_are_turned() -> None:
    text = "[the lab](../../research/README.md), [a](../../src/x.py), [b](b.md), [`src/x.py`](../../src/x.py)"
    assert reference.at_home(text, "research/index.md") == (
        "[the lab](../develop/lab.md), a (`src/x.py`), [b](b.md), `src/x.py`"
    )


def test_every_memory_has_its_page_and_its_row() -> None:
    index = (ROOT / "docs/guides/memories.md").read_text()
    assert [name for name in OURS if f"| [`{name}`](memory/{name}.md)" not in index] == []
    assert [name for name in OURS if not (ROOT / f"docs/guides/memory/{name}.md").is_file()] == []
