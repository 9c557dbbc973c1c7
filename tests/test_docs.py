"""The documents: links lead somewhere, commands are understood, hashes stay in the results, README is short."""

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

import draccus
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import typer
from lerobot.scripts.lerobot_edit_dataset import EditDatasetConfig
from PIL import Image

from lerobot_memobench.cli import memobench
from lerobot_memobench.commands.command_line import (
    HELP,
    as_command_line,
    is_of_benchmark,
    parse_words,
    read_words,
    resolve_recipe,
    typed,
)
from lerobot_memobench.envs import episode_log, evaluation_file
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.policies.memobench_mem.memory import OURS
from lerobot_memobench.rollouts.plan import read_settings, take_run_options
from lerobot_memobench.training.command import take_training_options
from research import kept
from tests.support.logs import rollout, write_log
from tests.support.scripts import load_script

reference = load_script("docs_reference")
recompute = load_script("recompute")

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
RESULTS = sorted((ROOT / "results").glob("*.md"))
PAGES = sorted([*ROOT.glob("*.md"), *DOCS.glob("**/*.md")])
DOCUMENTS = [*PAGES, *RESULTS, *sorted(ROOT.glob("src/**/*.md"))]
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
    """Return the links of a document, without those to other sites."""
    text = WORDS.sub("", BLOCK.sub("", document.read_text()))
    return [link for link in LINK.findall(text) if not re.match(r"[a-z]+:", link)]


def anchors(document: Path) -> set[str]:
    """Return the anchors that GitHub gives to a document's headings."""
    headings = re.findall(r"^#+ (.+)$", BLOCK.sub("", document.read_text()), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


def broken(document: Path) -> list[str]:
    """Return the broken links of a document; anchors of generated pages are checked by the site's build only."""
    found = []
    for link in links(document):
        path, _, anchor = link.partition("#")
        target = (document.parent / path).resolve() if path else document
        if target not in MADE and (not target.exists() or (anchor and anchor not in anchors(target))):
            found.append(link)
    return found


def test_links_are_valid() -> None:
    assert {name(document): links for document in DOCUMENTS if (links := broken(document))} == {}


def test_readme_does_not_link_to_generated_pages() -> None:
    assert not [link for link in links(ROOT / "README.md") if (ROOT / link.partition("#")[0]).resolve() in MADE]


# --- what belongs into the notes ---

HASH = re.compile(r"\b(?=[0-9a-f]*[0-9])(?=[0-9a-f]*[a-f])[0-9a-f]{7,64}\b")
PROCESSOR = re.compile(r"\b(Xeon|EPYC|Ryzen|Opteron|Haswell|Skylake|Zen ?\d|A40|A100|H100|H200|llvmpipe)\b")


def of_a_laboratory(text: str) -> list[str]:
    """Return hashes, commits and names of processors in a text."""
    return [found[0] for pattern in (HASH, PROCESSOR) for found in pattern.finditer(text)]


@pytest.mark.parametrize("document", PAGES, ids=name)
def test_hashes_commits_and_processors_stay_in_the_notes(document: Path) -> None:
    assert not of_a_laboratory(document.read_text())


LISTS = ("README.md", "figures.md")


@pytest.mark.parametrize("page", [page for page in RESULTS if page.name not in LISTS], ids=name)
def test_results_are_dated_and_short(page: Path) -> None:
    text = page.read_text()
    assert re.search(r"\b\d{1,2} [A-Z][a-z]+ 20\d\d\b", "\n".join(text.splitlines()[:6]))
    assert len([word for word in text.split() if word != "|"]) <= 1000


def test_readme_is_short() -> None:
    assert len((ROOT / "README.md").read_text().splitlines()) <= 120


def test_navigation_lists_every_page_once() -> None:
    """The strict build of the site checks this too, but it is slow."""
    listed = re.findall(r"[\w/-]+\.md", (ROOT / "mkdocs.yml").read_text().partition("\nnav:")[2])
    pages = {str(page.relative_to(DOCS)) for page in DOCS.glob("**/*.md")}
    assert set(listed) == pages | set(reference.PAGES) | set(reference.COPIES.values())
    urls = Counter(re.sub(r"(^|/)index$", "", page.removesuffix(".md")) for page in listed)
    assert [url for url, count in urls.items() if count > 1] == []


@pytest.mark.slow
def test_site_is_built_strictly(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(tmp_path)]
    environment = {**os.environ, "NO_MKDOCS_2_WARNING": "1"}
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert "stock LIBERO" in (tmp_path / "results/scenes/index.html").read_text()


TEST = re.compile(r"`((?:tests|research)/[\w/]+\.py)::(\w+)`")


def test_tests_that_pages_name_exist() -> None:
    found = [each for page in PAGES for each in TEST.findall(page.read_text(encoding="utf-8"))]
    missing = [f"{file}::{test}" for file, test in found if f"\ndef {test}(" not in (ROOT / file).read_text()]
    assert found
    assert missing == []


# --- figures ---


@pytest.mark.parametrize("page", recompute.PAGES, ids=name)
def test_published_figures_are_those_of_their_sources(page: Path) -> None:
    assert [*recompute.problems_of_tables(page), *recompute.problems_of_prose(page)] == []
    assert any(recompute.source_of(page, source) for _, _, source in recompute.rows_of(page))


def test_rows_of_the_study_are_rows_of_its_program(tmp_path: Path) -> None:
    assert recompute.problems_of_study() == []
    page, head = tmp_path / "study.md", "| | training seeds | SR |\n|---|---|---|\n"
    page.write_text(f"{head}| ceiling without a memory | – | 33.7 |\n| no memory | 3 | **90.0** |\n")
    (problem,) = recompute.problems_of_study(page)
    assert "no memory | 3 | **90.0** is in no table" in problem


def test_claims_and_their_sources_stand_where_the_list_has_them() -> None:
    assert recompute.problems_of_claims() == []
    assert recompute._claims(recompute.CLAIMS)


def test_tables_of_results_are_small() -> None:
    assert sum(file.stat().st_size for file in recompute.RESULTS.glob("**/*.parquet")) < 2_000_000


HEAD = "| policy | SR | MSR | MUR | MCR | rollouts | |\n|---|---|---|---|---|---:|---|\n"
KEPT = "75.0 [30.1–95.4]"
ONE = "[`one`](rollouts.parquet)"


@pytest.mark.parametrize(
    ("row", "problem"),
    [
        (f"| a | {KEPT} | {KEPT} | – | – | 4 | {ONE} |", None),
        (f"| a | 76.0 [30.1–95.4] | | | | 4 | {ONE} |", "SR 76.0 .*, and 75.0 .* by its source"),
        (f"| a | {KEPT} | | | | 4 | [note](note.md) |", "lacks 'log not kept'"),
        ("| a | 100 [96.3–100] | | | | 100 | [`short`](demonstrations.parquet) |", "100 .*, and 99.0 .* by its source"),
    ],
)
def test_a_figure_that_differs_from_its_source_is_found(tmp_path: Path, row: str, problem: str | None) -> None:
    task = "turn_on_the_stove_and_turn_it_off"
    lines = [rollout(task, "temporal", "S", [k > 0], k > 0, k) for k in range(4)]
    keep_one(tmp_path, [lines[0] | {"settled": False}, *lines[1:]])
    runs = ["run"] * 100 + ["short"] * 100
    table = pa.table({"run": runs, "solved": [True] * 199 + [False]})
    pq.write_table(table, tmp_path / "demonstrations.parquet")
    page = tmp_path / "page.md"
    page.write_text(f"{HEAD}{row}\n")
    found = recompute.problems_of_tables(page)
    assert len(found) == (problem is not None)
    assert problem is None or re.search(problem, found[0])


def keep_one(folder: Path, lines: list[dict[str, Any]]) -> None:
    """Keep a log under the name ``one`` in the folder's tables."""
    write_log(folder / "logs" / "one", lines)
    kept.keep(folder / "logs", ["one"], folder)


def test_a_kept_evaluation_is_restored_as_a_new_folder(tmp_path: Path) -> None:
    keep_one(tmp_path, [rollout("turn_on_the_stove_and_turn_it_off", "temporal", "S", [True], True, 0)])
    (tmp_path / "logs" / "training.json").write_text("{}")
    kept.keep(tmp_path / "logs", ["training"], tmp_path)
    folder = tmp_path / "outputs" / "one"
    assert recompute.main(["restore", str(tmp_path), "one", str(folder)]) == 0
    assert [line["success"] for line in episode_log.read_lines(folder)] == [True]
    for name, target, words in (("one", folder, "exists already"), ("training", tmp_path / "b", "no rollouts")):
        with pytest.raises(MemobenchError, match=words):
            recompute.main(["restore", str(tmp_path), name, str(target)])


# --- commands ---


def commands(document: Path) -> Iterator[list[str]]:
    """Yield the words of each command in the shell blocks of a document."""
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


TYPED = [(document, words) for document in [*PAGES, *RESULTS] for words in commands(document)]


@pytest.mark.parametrize(("document", "words"), TYPED, ids=lambda it: name(it) if isinstance(it, Path) else it[0])
def test_commands_are_valid(document: Path, words: list[str]) -> None:
    check(words)


def check(words: list[str]) -> None:
    """Raise an error for an unknown command or argument; nothing is executed."""
    program, *rest = words
    if program == "accelerate":  # it runs the program after `$(which lerobot)`
        program, rest = "lerobot", rest[rest.index("lerobot)") + 1 :]
    match program:
        case "lerobot":
            check_lerobot(rest[0], rest[1:])
        case "lerobot-eval" | "lerobot-train":
            check_lerobot(program.partition("-")[2], [as_pair(word) for word in as_command_line(parse_words(rest))])
        case "memobench":
            check_memobench(rest)
        case _ if program == "python" or program.endswith("/bin/python"):
            check_python(rest)
        case "vla-eval":
            check_vla_eval(rest)
        case "lerobot-dataset-viz":
            check_viewer(rest)
        case "lerobot-edit-dataset":
            draccus.parse(EditDatasetConfig, args=rest)
        case "sbatch":
            check_sbatch(rest)
        case "make":
            assert re.search(rf"^{rest[0]}:", (ROOT / "Makefile").read_text(), re.MULTILINE)
        case _ if program.startswith("scripts/"):
            assert (ROOT / program).is_file(), program
        case _:
            assert program in ("source", "export", "pip", "uv", "gzip"), f"unknown program {program}"


def as_pair(flag: str) -> str:
    """Return a flag of LeRobot's as a pair: ``--env.type=x`` is ``env=x``."""
    key, _, value = flag.removeprefix("--").partition("=")
    return f"{key.removesuffix('.type').removesuffix('.path')}={value}"


def check_lerobot(command: str, line: list[str]) -> None:
    """Parse a line as `lerobot` does; folders, repositories and example policies are replaced by existing ones."""
    existing = {"policy": "policy=memobench_mem", "dataset": "dataset.root=outputs"}
    pairs = [existing[key] if (key := word.partition("=")[0]) in existing and is_place(word) else word for word in line]
    given = parse_words(pairs)
    if command == "eval" and is_of_benchmark(given):
        read_settings(take_run_options(given)[1])
        return
    if command == "train":
        given = take_training_options(resolve_recipe(given))[-1]
        given = {"dataset.repo_id": "none", **given}
    if HELP not in given:
        asked = read_words(command, given)
        typed(asked.config, asked.settings)


def is_place(pair: str) -> bool:
    """Return whether a value is a folder, a repository or the policy of `examples/`."""
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
    """Compare flags with the source of LeRobot's viewer, whose parser cannot be used alone."""
    spec = importlib.util.find_spec("lerobot.scripts.lerobot_dataset_viz")
    known = set(re.findall(r"add_argument\(\s*\"(--[\w-]+)\"", Path(str(spec.origin)).read_text()))
    assert not {word for word in line if word.startswith("--")} - known


def check_sbatch(line: list[str]) -> None:
    """Check long options, and the command of an array's job 1."""
    *options, wrapped = line
    assert [option for option in options if not re.fullmatch(r"--[a-z-]+(=\S+)?", option)] == []
    assert wrapped.startswith("--wrap=")
    check(shlex.split(re.sub(r"\$\{?SLURM_ARRAY_TASK_ID\}?", "1", wrapped.removeprefix("--wrap="))))


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


USAGE_ERROR: Any = typer.BadParameter.__base__
"""Error of invalid options; typer does not export it."""


def check_python(line: list[str]) -> None:
    """Check that the script or module exists."""
    if line[0] == "-m":
        assert importlib.util.find_spec(line[1]), line[1]
    elif line[0] != "-c":
        assert (ROOT / line[0]).is_file(), line[0]


@pytest.mark.parametrize(
    "line",
    [
        "lerobot eval env=memobench episode=10",
        "lerobot train policy=memobench_mem memory_strides=3",
        "memobench generate --task object",
        "lerobot-dataset-viz --episode 0",
        "sbatch --array=1-4 --wrap='memobench merges outputs/$SLURM_ARRAY_TASK_ID'",
        "python examples/no_such.py",
        "make coffee",
    ],
)
def test_invalid_commands_are_detected(line: str) -> None:
    with pytest.raises((MemobenchError, AssertionError, KeyError, USAGE_ERROR, SystemExit)):
        check(shlex.split(line))


# --- generated pages ---


@pytest.mark.parametrize("command", ["eval", "train"])
def test_short_forms_agree_with_help(command: str) -> None:
    """Guides list the most important ones, the reference all."""
    in_help = {word for typed, *_ in reference.short_forms(command) for word in re.findall(r"\w+=", typed)}
    text = (DOCS / "guides" / {"eval": "evaluate.md", "train": "train.md"}[command]).read_text()
    lines = text[text.index("| short form |") :].split("\n\n")[0].splitlines()[2:]
    in_guide = {word for line in lines for word in re.findall(r"\w+=", line.split("|")[1])}
    assert in_guide
    assert in_guide <= in_help
    page = reference.lerobot_page().partition(f"## lerobot {command}")[2].partition("\n## ")[0]
    assert all(f"`{word}`" in page for word in in_help)


@pytest.mark.parametrize("page", reference.PAGES)
def test_generated_pages_have_valid_tables(page: str) -> None:
    text = reference.PAGES[page]()
    assert text.startswith("# ")
    for block in re.findall(r"(?:^\|.*\n)+", text, re.MULTILINE):
        widths = {len(re.findall(r"(?<!\\)\|", row)) for row in block.splitlines()}
        assert len(widths) == 1, block


def test_all_fields_of_log_and_card_have_a_meaning() -> None:
    for kind in (
        episode_log.EpisodeRecord,
        episode_log.CheckpointRecord,
        evaluation_file.Protocol,
        evaluation_file.Card,
        evaluation_file.CardSettings,
    ):
        assert all(meaning for _, meaning, _ in reference.typed_rows(kind)), kind
    rows = reference.typed_rows(episode_log.EpisodeRecord)
    required = [name.strip("`") for name, _, kind in rows if kind.endswith("required")]
    assert required == ["task", "memory_type", "episode", "success", "checkpoints"]


@pytest.mark.parametrize("number", [1, 6, 20, 30])
def test_task_images_are_cropped_at_their_edges(number: int) -> None:
    """The background of the sheet is nearly white."""
    with Image.open(io.BytesIO(reference.scene(number))) as image:
        pixels = np.asarray(image.convert("RGB")).astype(int)
    assert pixels.shape == (256, 256, 3)
    assert max(edge.mean() for edge in (pixels[0], pixels[-1], pixels[:, 0], pixels[:, -1])) < 230


def test_policy_page_lists_all_settings() -> None:
    from lerobot_memobench.policies.memobench_mem.configuration_memobench_mem import MemobenchMemConfig

    page = reference.policies_page()
    own = {field.name for field in dataclasses.fields(MemobenchMemConfig)} & set(MemobenchMemConfig.__annotations__)
    assert [field for field in own if f"`{field}`" not in page] == []


def test_memory_guides_are_complete() -> None:
    index = (ROOT / "docs/guides/memories.md").read_text()
    assert [name for name in OURS if f"| [`{name}`](memory/{name}.md)" not in index] == []
    assert [name for name in OURS if not (ROOT / f"docs/guides/memory/{name}.md").is_file()] == []
