"""The board: a valid submission is accepted, doctored ones are refused."""

from __future__ import annotations

import gzip
import json
import re
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import yaml
from huggingface_hub import parse_eval_result_entries

from lerobot_memobench.board.submission import CARD, LOG, PROMISES, About, write_submission
from lerobot_memobench.cli.memobench import main
from lerobot_memobench.envs.episode import referent_of
from lerobot_memobench.envs.episode_log import log_text
from lerobot_memobench.envs.evaluation_file import write_evaluation
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.evaluation.evidence import evidence_of
from lerobot_memobench.evaluation.report import HUB_FILE
from lerobot_memobench.policies.checkpoint import encoded_config
from lerobot_memobench.policies.memobench_mem.configuration_memobench_mem import MemobenchMemConfig
from lerobot_memobench.tasks.catalogue import get_task
from tests.support import browser as chromium
from tests.support.board import (
    ABOUT,
    IMAGES,
    TASKS,
    VERSIONS,
    both,
    evaluation,
    first_failure,
    in_card,
    in_log,
    sealed,
    stating,
)
from tools.board import page
from tools.board.__main__ import main as check_board
from tools.board.check import check_partners, check_submission, ranked, read_board
from tools.board.submission import read_submission

ROOT = Path(__file__).parents[2]
Json = dict[str, Any]


@pytest.fixture(scope="module")
def evaluated(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return evaluation(tmp_path_factory.mktemp("evaluated") / "one")


@pytest.fixture(scope="module")
def board(evaluated: Path) -> Path:
    """A board with one valid row; do not change it."""
    write_submission(evaluated.parent / "board" / "one", About(**ABOUT), {"": evaluated})
    return evaluated.parent / "board"


@pytest.fixture(scope="module")
def with_controls(board: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A valid submission with a control, whose partner is the row of ``board``; do not change it."""
    place = tmp_path_factory.mktemp("controls")
    folders = {"": evaluation(place / "m", speed=60), "pauses": evaluation(place / "p", pause_steps=100)}
    about = About(**ABOUT | {"without_memory": "one", "links": {"code": "https://one.example/code"}})
    return write_submission(place / "board" / "two", about, folders)


def test_valid_submission_is_accepted(board: Path) -> None:
    (row,) = page.board_rows(board)
    assert (row.ranked, row.rerun, row.episodes, row.suite, row.inputs) == (False, False, 10, "strict", "pixels")
    assert row.rates["SR"].value == pytest.approx(0.6)


def test_intervals_of_plans_and_memory_are_shown(board: Path, tmp_path: Path) -> None:
    folder = shutil.copytree(board / "one", tmp_path / "one")
    for memory, stride, known in (("frames", 8, 8), ("none", 8, None), ("frames", "<b>", None)):
        in_card(lambda card, m=memory, s=stride: card["policy"]["settings"].update(memory=m, memory_stride=s))(folder)
        row = page.board_row(read_submission(folder))
        assert (row.replan, row.memory_stride) == (5, known)


def test_board_of_the_repository_is_valid() -> None:
    rows = page.board_rows(ROOT / "results" / "board")
    assert {row.name: row.rerun for row in rows} == dict.fromkeys((row.name for row in rows), True)
    assert {row.name: f"{row.rates['SR'].value:.4f}" for row in rows}["memobench_expert_libero"] == "0.9930"


# --- doctored submissions ---


def protocol(**settings: Any) -> Callable[[Path], None]:
    return in_card(lambda card: card["protocol"].update(settings))


def to_success(records: list[Json]) -> None:
    record = first_failure(records)
    record.update(success=True, failure=None)
    for mark in record["checkpoints"]:
        mark.update(first_step=50, ordered_step=50)


def shifted(records: list[Json], by: Callable[[int, int], int]) -> None:
    """Move the steps of each success by a function of its number and the checkpoint's."""
    for number, record in enumerate(records):
        if record["success"]:
            for k, mark in enumerate(record["checkpoints"]):
                mark["first_step"] = mark["ordered_step"] = record["steps"] = mark["first_step"] + by(number, k)


def linked(folder: Path) -> None:
    (folder / LOG).unlink()
    (folder / LOG).symlink_to("/etc/passwd")


def other_variant(records: list[Json]) -> None:
    record = next(each for each in records if each["task"].startswith("find_the_artichoke_hidden"))
    record["variant"] = 1 + record["variant"] % 3


DOCTORED: dict[str, tuple[Callable[[Path], object], str]] = {
    "success with a failure class": (in_log(lambda log: first_failure(log).update(success=True)), "failure"),
    "checkpoint after the end": (in_log(lambda log: log[1].update(steps=10)), "checkpoints within them"),
    "unknown observations": (protocol(obs_type="eyes"), "obs_type is 'eyes'"),
    "settings in the log": (in_log(lambda log: log[0].update(replan_steps=1)), "replan_steps"),
    "pauses in the log only": (in_log(lambda log: log[0].update(paused_steps=300)), "paused_steps: absent and 300"),
    "other seeds": (protocol(seed_base=20_000), "seed_base: 20000 and 7"),
    "shifted seed": (in_log(lambda log: log[3].update(seed=99)), "seed_base: 7 and "),
    "other variant": (in_log(other_variant), "drew the variants"),
    "missing episode": (in_log(lambda log: log.pop(5)), "episode 5, is missing"),
    "repeated line": (in_log(lambda log: log.append(log[0])), "a second line"),
    "markup in a name": (stating("submitter", "[me](javascript:1)"), "submitter = "),
    "unknown file": (lambda folder: (folder / "run.py").write_text("print()"), "holds 'run.py'"),
    "missing log": (lambda folder: (folder / LOG).unlink(), f"lacks {LOG}"),
    "link to a file": (linked, "is a link"),
    "large card": (lambda folder: (folder / CARD).write_bytes(b" " * (3 << 20)), "expected at most 2.0 MiB"),
    "large log": (lambda folder: (folder / LOG).write_bytes(gzip.compress(b" " * (9 << 20))), "larger than 8.0 MiB"),
    "no log": (lambda folder: (folder / LOG).write_bytes(b"text"), "no whole gzip file"),
    "other task files": (in_card(lambda card: card["task_files"].update({TASKS[0]: "f" * 16})), "the files of"),
    "no statement on supervision": (
        in_card(lambda card: card["submission"].pop("supervised_with_answer")),
        "whether the policy was supervised with the answer",
    ),
    "long plan": (
        in_card(lambda card: card["protocol"].update(window_steps=200, replan_steps=1)),
        "are 201 together; expected at most 200",
    ),
    "mixed versions": (
        in_card(lambda card: card["runs"].append({**card["runs"][0], "versions": {**VERSIONS, "mujoco": "4.0.0"}})),
        "its parts ran under mujoco",
    ),
}


@pytest.mark.parametrize("name", DOCTORED)
def test_doctored_submission_is_refused(board: Path, tmp_path: Path, name: str) -> None:
    change, reason = DOCTORED[name]
    folder = shutil.copytree(board / "one", tmp_path / "one")
    change(folder)
    with pytest.raises(MemobenchError) as refused:
        check_submission(read_submission(folder))
    assert reason in str(refused.value)
    assert "\n" not in str(refused.value)


def test_settings_that_follow_from_the_policy_are_accepted(board: Path, tmp_path: Path) -> None:
    folder = shutil.copytree(board / "one", tmp_path / "one")
    protocol(window_steps=2, delay_steps=1, convention="libero", robot_state=True)(folder)
    check_submission(read_submission(folder))


DOCTORED_CONTROLS: dict[str, tuple[Callable[[Path], object], str]] = {
    "log without pauses": (
        in_log(lambda log: [each.pop("paused_steps") for each in log]),
        "paused_steps: recorded and absent",
    ),
    "missing setting": (in_card(lambda card: card["protocol"].pop("horizon")), "lacks horizon"),
}


@pytest.mark.parametrize("name", DOCTORED_CONTROLS)
def test_doctored_control_is_refused(with_controls: Path, tmp_path: Path, name: str) -> None:
    change, reason = DOCTORED_CONTROLS[name]
    folder = shutil.copytree(with_controls, tmp_path / "two")
    change(folder / "pauses")
    with pytest.raises(MemobenchError, match=reason):
        check_submission(read_submission(folder))


# --- the mark of supervision with the answer ---


def of_memory(recorded: bool | None = None, **settings: Any) -> Callable[[Path], None]:
    """Make the card one of `memobench_mem` with pixels; ``recorded`` replaces its mark."""
    config = encoded_config(MemobenchMemConfig(device="cpu", n_action_steps=5, **settings))
    config |= {"input_features": IMAGES} | ({} if recorded is None else {"supervised_with_answer": recorded})

    def change(card: Json) -> None:
        card["policy"].update(type="memobench_mem", settings=config)
        card["submission"].pop("supervised_with_answer", None)

    return in_card(change)


@pytest.mark.parametrize(
    ("change", "marked"),
    [
        (of_memory(), False),
        (of_memory(memory="none"), False),
        (of_memory(align="contrastive"), True),
        (of_memory(align="contrastive", align_targets="answers"), True),
        (of_memory(align="contrastive", align_targets="progress"), False),
        (of_memory(memory="subgoal"), True),
        (of_memory(True), True),  # began with a marked checkpoint
        (stating("supervised_with_answer", True), True),
        (in_card(lambda card: card["policy"].update(type="memobench_blind")), None),
    ],
)
def test_row_is_marked_by_its_policy(
    board: Path, tmp_path: Path, change: Callable[[Path], None], marked: bool | None
) -> None:
    folder = shutil.copytree(board / "one", tmp_path / "one")
    change(folder)
    if marked is not None:  # the inputs of the card are not those of a script
        check_submission(read_submission(folder))
    assert page.board_row(read_submission(folder)).supervised is marked


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (both(of_memory(align="contrastive"), stating("supervised_with_answer", False)), "True, and False is stated"),
        (both(of_memory(), stating("supervised_with_answer", True)), "False, and True is stated"),
        (
            both(
                of_memory(False, align="contrastive"),
                in_card(lambda card: card["policy"]["settings"].update(memory="a_plugins")),
            ),
            "is false on the card of a policy with",
        ),
        (of_memory(False, align="contrastive"), "is false on the card of a policy with"),
        (of_memory(False, memory="keyframes"), "is false on the card of a policy with"),
        (
            in_card(lambda card: card["policy"]["settings"].pop("supervised_with_answer")),
            "found no statement whether",
        ),
        (
            in_card(lambda card: card["policy"]["settings"].pop("align")),
            "has no align 'None'",
        ),
        (
            in_card(lambda card: card["policy"]["settings"].pop("memory")),
            "'None'",
        ),
    ],
)
def test_removed_or_edited_mark_is_refused(
    board: Path, tmp_path: Path, change: Callable[[Path], None], reason: str
) -> None:
    folder = shutil.copytree(board / "one", tmp_path / "one")
    of_memory()(folder)
    change(folder)
    with pytest.raises(MemobenchError, match=reason):
        check_submission(read_submission(folder))


# --- rows that rank ---


@pytest.fixture(scope="module")
def each_variant(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A valid submission of each scene with each variant; do not change it."""
    place = tmp_path_factory.mktemp("evidence")
    return write_submission(place / "one", About(**ABOUT), {"": evaluation(place / "e", evidence=True)})


def test_row_of_each_scene_with_each_variant_ranks(each_variant: Path) -> None:
    check_submission(found := read_submission(each_variant))
    row = page.board_row(found)
    assert (row.ranked, row.episodes, row.seeds) == (True, 36, "paper")
    assert row.rates["SR"].value == pytest.approx(2 / 3)
    assert row.evidence.rates["follows"].value == pytest.approx(2 / 3)
    low, high = row.rates["SR"].interval or (0.0, 0.0)
    assert high - low > 0.1, "225 scenes, not 1,080 rollouts"
    with pytest.raises(MemobenchError, match="has the episodes of the row 'one'"):
        check_submission(replace(found, name="two"), [found])


def test_table_of_public_scenes_is_no_better_than_chance(each_variant: Path, board: Path) -> None:
    """It knows the variant that the seed draws in each scene. It would be right in all rollouts of a plain row."""
    assert not ranked(read_submission(board / "one").evaluation)
    records = []
    for record in read_submission(each_variant).evaluation.records:
        task = get_task(record["task"])
        if task.prompt is not None:
            records.append({**record, "choice": referent_of(task, record["seed"]).variant_index, "answered": True})
    found = evidence_of(records).average
    assert found.rates["follows"].high < 0.5
    assert (found.rates["follows"].value or 1.0) <= found.chance


def of_task(name: str, success: bool = True, **fields: Any) -> Callable[[Path], None]:
    """Change the first rollout of a task with this outcome: a failure of variant 0, a success of variant 1."""

    def change(log: list[Json]) -> None:
        next(each for each in log if each["task"].startswith(name) and each["success"] == success).update(fields)

    return in_log(change)


def test_first_object_may_be_put_back_before_a_success(each_variant: Path, tmp_path: Path) -> None:
    folder = shutil.copytree(each_variant, tmp_path / "one")
    of_task("put_only_the_butter", choice=0)(folder)
    of_task("find_the_tomato_hidden", success=False, choice=1, answered=True, lost=True, failure="wrong_place")(folder)
    check_submission(read_submission(folder))


DOCTORED_VARIANTS: dict[str, tuple[Callable[[Path], object], str]] = {
    "lower chance": (in_log(lambda log: [each.update(chance=0.0) for each in log]), "'chance': 0.0"),
    "no answer chosen": (in_log(lambda log: log[1].update(answered=False)), "answered"),
    "choice of no variant": (of_task("put_only_the_butter", choice=9), r"'choice': \[None, 0, 1, 2"),
    "a success that opened another drawer": (of_task("find_the_tomato_hidden", choice=0), r"'choice': \[1\]"),
    "a success without an answer": (of_task("find_the_tomato_hidden", choice=None, answered=False), r"'choice': \[1\]"),
    "a failure in the right bowl": (
        of_task("put_the_butter_only", success=False, choice=0, answered=True),
        r"'choice': \[None\]",
    ),
    "no answer of one variant": (
        of_task("turn_the_stove_on_and_off_once", choice=None, answered=False),
        r"'choice': \[0\]",
    ),
    "a task less": (
        in_card(lambda card: card["protocol"].update(tasks=card["protocol"]["tasks"][1:])),
        "expected 12 to 36 episodes of each",
    ),
}


@pytest.mark.parametrize("name", DOCTORED_VARIANTS)
def test_doctored_variants_are_refused(each_variant: Path, tmp_path: Path, name: str) -> None:
    change, reason = DOCTORED_VARIANTS[name]
    folder = shutil.copytree(each_variant, tmp_path / "one")
    change(folder)
    with pytest.raises(MemobenchError, match=reason):
        check_submission(read_submission(folder))


def test_sealed_result_is_accepted(board: Path, tmp_path: Path) -> None:
    folder = shutil.copytree(board / "one", tmp_path / "one")
    sealed(folder)
    check_submission(found := read_submission(folder))
    assert page.board_row(found).seeds == "sealed"


@pytest.mark.parametrize(
    "change",
    [
        None,
        in_log(to_success),
        in_log(lambda log: shifted(log, lambda number, k: -25 if number % 5 == 0 else k)),
        in_log(lambda log: [each.update(scene_hash=None) for each in log]),
    ],
    ids=["copied", "another success", "a few changed much", "no hashes of scenes"],
)
def test_copied_card_is_refused(board: Path, tmp_path: Path, change: Callable[[Path], None] | None) -> None:
    both = shutil.copytree(board, tmp_path / "board")
    copy = shutil.copytree(both / "one", both / "two")
    if change:
        change(copy)
    with pytest.raises(MemobenchError, match="has the episodes of the row 'one'"):
        read_board(both)


def test_partner_is_another_row_of_the_same_protocol(with_controls: Path, board: Path, tmp_path: Path) -> None:
    others = read_board(board)
    check_partners([*others, read_submission(with_controls)])
    folder = shutil.copytree(with_controls, tmp_path / "two")
    stating("without_memory", "two")(folder)
    with pytest.raises(MemobenchError, match="'two', is no other row; known are 'one'"):
        check_partners([*others, read_submission(folder)])
    stating("without_memory", "one")(folder)
    for change, reason in (
        (in_card(lambda card: card["policy"]["settings"].update(memory="frames")), "the policy of one has a memory"),
        (protocol(episodes=20), "differ in episodes: 10 and 20"),
    ):
        partner = shutil.copytree(board / "one", tmp_path / "partner" / "one")
        change(partner)
        with pytest.raises(MemobenchError, match=reason):
            check_partners([read_submission(partner), read_submission(folder)])
        shutil.rmtree(partner)
    protocol(replan_steps=10)(folder)
    with pytest.raises(MemobenchError, match="differ in replan_steps: 10 and 5"):
        check_partners([*others, read_submission(folder)])


def test_refusal_is_one_line(board: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A line of its own would be a command of GitHub's workflow, such as ``::add-mask::``."""
    both = shutil.copytree(board, tmp_path / "board")
    protocol(render="\n::error::x")(both / "one")
    assert check_board([str(both)]) == 1
    assert check_board([str(tmp_path / "nowhere")]) == 1
    first, second = capsys.readouterr().err.splitlines()
    assert "render:  ::error::x and default" in first
    assert "No such file" in second


@pytest.mark.parametrize("name", ["One", "a b", "..", "<b>", "a" * 65])
def test_unsafe_names_of_rows_are_refused(tmp_path: Path, name: str) -> None:
    with pytest.raises(MemobenchError, match="found the folder"):
        read_submission(tmp_path / name)


# --- commands ---


def test_submission_of_a_new_user_is_accepted(
    evaluated: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    words = ["submit", str(evaluated), "--name", "mine", "--model", "Mine", "--submitter", "@me"]
    words += ["--training-data", "1,500 demonstrations", "--parameters", "450000000", "--out", "out"]
    assert main(words) == 2
    assert "`memobench submit --supervised-with-answer`" in capsys.readouterr().err
    words.append("--no-supervised-with-answer")
    assert main([*words[:5], "<b>", *words[6:]]) == 2
    assert main([*words[:3], "../mine", *words[4:]]) == 2
    assert main([*words, "--pauses", str(evaluated)]) == 2
    assert f"memobench: {evaluated}: pause_steps: 0" in capsys.readouterr().err
    assert not Path("out").exists()
    assert main(words) == 0
    text = Path("out/mine.md").read_text()
    assert re.search(r"\| \*\*average[^|]*\*\* \| 300 \| 60\.0 \[", text)
    assert "| parameters | 450000000 |" in text
    assert all(f"- [ ] {promise}" in text for promise in PROMISES)
    shutil.copytree("out/mine", "results/board/mine")
    changed = Path("changed")
    changed.write_text(f"results/board/mine/{CARD}\0results/board/mine/{LOG}\0")
    assert check_board(["results/board", "changed"]) == 0
    changed.write_text(f"{changed.read_text()}src/lerobot_memobench/board/rules.py\0")
    assert check_board(["results/board", "changed"]) == 1
    assert "also changes 'src/" in capsys.readouterr().err
    assert main([*words[:3], "other", *words[4:]]) == 0
    shutil.copytree("out/other", "results/board/other")  # a copy of the row that is there now
    assert check_board(["results/board"]) == 1
    assert "has the episodes of the row 'mine'" in capsys.readouterr().err


def test_part_of_the_tasks_is_checked_and_not_submitted(
    evaluated: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    part = Path(shutil.copytree(evaluated, "part"))
    lines = [json.loads(each) for each in (part / "episodes.jsonl").read_text().splitlines()]
    some = [each for each in lines if each["task"] in TASKS[:3] and each["episode"] < 3]
    (part / "episodes.jsonl").write_text(log_text(some))
    card = json.loads((part / CARD).read_text())
    card["protocol"].update(tasks=sorted(TASKS[:3]), episodes=3)
    card["task_files"] = {name: card["task_files"][name] for name in TASKS[:3]}
    write_evaluation(part, card)
    assert main(["submit", "part", "--check"]) == 2
    assert "`memobench submit --supervised-with-answer` or" in capsys.readouterr().err
    assert main(["submit", "part", "--check", "--no-supervised-with-answer"]) == 0
    assert "accepted: 9 rollouts of part; nothing is written" in capsys.readouterr().out
    assert [each.name for each in tmp_path.iterdir()] == ["part"]
    assert main(["submit", "part"]) == 2
    assert "needs --name, --model, --submitter, --training-data; to check" in capsys.readouterr().err
    words = ["--name", "mine", "--model", "Mine", "--submitter", "@me", "--training-data", "none"]
    assert main(["submit", "part", *words]) == 2
    assert "has 3 episodes of 3 of 30 tasks; expected 10 to 50 episodes of each" in capsys.readouterr().err
    (part / "episodes.jsonl").write_text(log_text(some[1:]))
    assert main(["submit", "part", "--check", "--no-supervised-with-answer"]) == 2
    assert "is missing in the log" in capsys.readouterr().err


def test_submission_replaces_an_earlier_one_only(with_controls: Path, evaluated: Path, tmp_path: Path) -> None:
    """No control of the earlier submission remains, and no evaluation is overwritten."""
    folder = shutil.copytree(with_controls, tmp_path / "two")
    write_submission(folder, About(**ABOUT), {"": evaluated})
    assert sorted(path.name for path in folder.iterdir()) == [LOG, CARD]
    before = (evaluated / CARD).read_bytes()
    with pytest.raises(MemobenchError, match="holds no submission"):
        write_submission(evaluated, About(**ABOUT), {"": evaluated})
    assert (evaluated / CARD).read_bytes() == before
    (folder / "pauses").symlink_to(evaluated)
    with pytest.raises(MemobenchError, match="pauses is a link to"):
        write_submission(folder, About(**ABOUT), {"": evaluated, "pauses": with_controls / "pauses"})
    assert (evaluated / CARD).read_bytes() == before


def test_page_template_and_form_ask_for_the_same() -> None:
    template = (ROOT / ".github/PULL_REQUEST_TEMPLATE/submission.md").read_text()
    form = (ROOT / ".github/ISSUE_TEMPLATE/results.yml").read_text()
    page = (ROOT / "docs/benchmark/board.md").read_text()
    assert all(promise in text for promise in PROMISES for text in (template, form))
    assert all(name in text for name in (CARD, LOG, "pauses") for text in (template, form, page))


@pytest.mark.parametrize("name", ["Δ-ACT", "清华 Robotics Lab", "ロボット研究室"])
def test_names_of_words_in_different_alphabets_are_accepted(name: str) -> None:
    assert About(model=name, submitter=name, training_data="none", date="2026-11-29").model == name


# --- the hub ---


def test_entries_of_the_hub(tmp_path: Path) -> None:
    folder = evaluation(tmp_path / "one")
    protocol(episodes=20)(folder)
    assert main(["export", str(folder), "--dataset", "user/memobench", "--out", str(tmp_path)]) == 0
    entries = parse_eval_result_entries(yaml.safe_load((tmp_path / HUB_FILE).read_text()))
    assert [entry.task_id for entry in entries] == ["strict_sr", "strict_msr", "strict_mur", "strict_mcr"]
    assert (entries[0].dataset_id, entries[0].value) == ("user/memobench", 60.0)
    for part in ("strict suite", "inputs: pixels", "incomplete", "missing: 300 of 600 episodes", "95 % interval"):
        assert part in str(entries[0].notes)


# --- the page in headless Chromium ---

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
    monkeypatch.setattr(page, "BOARD", tmp_path / "board")
    text = (DOCS / "benchmark" / "board.md").read_text().replace(page.PLACE, page.table())
    html = markdown.markdown(text, extensions=["md_in_html", "tables", "toc"])
    assert '<h1 id="board">' in html
    script = (DOCS / "javascripts" / "board.js").as_uri()
    file = tmp_path / "board.html"
    file.write_text(f'<!doctype html><meta charset="utf-8"><script src="{script}"></script>\n{html}')
    browser = chromium.Browser(tmp_path / "profile")
    try:
        browser.open(file.as_uri())
        ids = browser.js("[...document.querySelectorAll('[id]')].map((each) => each.id)")
        assert len(ids) == len({*ids})
        for column, order in (("policy", 1), ("SR", -1), ("parameters", -1)):
            number = page.HEAD.index(column) + 1
            cells = f"#{page.TABLE} tbody tr td:nth-child({number})"
            values = f"[...document.querySelectorAll('{cells}')].map((each) => each.dataset.sort)"
            for sign in (order, -order):
                browser.click(f"#{page.TABLE} th:nth-child({number}) button")
                found = browser.js(values)
                wanted = sorted(found, key=float if column != "policy" else str, reverse=sign < 0)
                assert found == wanted
                assert len({*found}) > 1
        assert browser.errors == []
    finally:
        browser.close()
