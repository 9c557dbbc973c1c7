"""Hostile submissions: each invents or contradicts something, and is refused with one sentence.

Strict ones are made from a row without a simulation (`tests.support.board`), published ones from a kept row.
"""

from __future__ import annotations

import gzip
import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from lerobot_memobench.board.submission import CARD, LOG, About, write_submission
from lerobot_memobench.envs.episode import referent_of
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.tasks.catalogue import get_task
from tests.support.board import ABOUT, SALT, both, evaluation, in_card, in_log, scene_of, sealed, stating
from tools.board.__main__ import main as check_board
from tools.board.check import check_author, check_paths, check_submission, read_board
from tools.board.page import board_rows
from tools.board.submission import read_submission

Json = dict[str, Any]
Change = Callable[[Path], object]


@pytest.fixture(scope="module")
def row(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A valid row with a control; do not change it."""
    place = tmp_path_factory.mktemp("hostile")
    folders = {"": evaluation(place / "m"), "pauses": evaluation(place / "p", pause_steps=100)}
    return write_submission(place / "one", About(**ABOUT), folders)


@pytest.fixture(scope="module")
def published(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A valid row of published tasks; do not change it."""
    place = tmp_path_factory.mktemp("published")
    return write_submission(
        place / "one", About(**ABOUT), {"": evaluation(place / "m", suite="published", referent="random")}
    )


def put(**fields: Any) -> Callable[[Json], object]:
    return lambda record: record.update(fields)


def every(change: Callable[[Json], object]) -> Change:
    return in_log(lambda log: [change(record) for record in log])


def successes(change: Callable[[Json], object]) -> Change:
    return every(lambda record: change(record) if record["success"] else None)


def failures(change: Callable[[Json], object]) -> Change:
    return every(lambda record: None if record["success"] else change(record))


def one(change: Callable[[Json], object], number: int = 1) -> Change:
    return in_log(lambda log: change(log[number]))


def marked(record: Json, steps: list[int | None], ordered: list[int | None] | None = None) -> None:
    for mark, first, second in zip(record["checkpoints"], steps, steps if ordered is None else ordered, strict=True):
        mark.update(first_step=first, ordered_step=second)


def firsts(record: Json) -> list[Any]:
    return [mark["first_step"] for mark in record["checkpoints"]]


def features(kinds: dict[str, str]) -> Change:
    made = {name: {"type": kind, "shape": [1]} for name, kind in kinds.items()}
    return in_card(lambda card: card["policy"]["settings"].update(input_features=made))


def protocol(**settings: Any) -> Change:
    return in_card(lambda card: card["protocol"].update(settings))


def versions(**changed: Any) -> Change:
    return in_card(lambda card: card["runs"][0]["versions"].update(changed))


def in_pauses(**facts: Any) -> Change:
    return lambda folder: in_card(lambda card: card["policy"].update(facts))(folder / "pauses")


def server(folder: Path, path: str) -> None:
    """Make the card one of a policy server, whose weights have no hash here."""
    in_card(lambda card: (card["policy"].pop("sha256"), card["policy"].update(type="memobench_remote")))(folder)
    in_card(lambda card: card.update(checkpoint={"path": path}))(folder)


def drawn(salt: str | None) -> Callable[[Json], object]:
    """The variant that seed and salt draw."""

    def change(record: Json) -> None:
        record["variant"] = referent_of(get_task(record["task"]), record["seed"], salt).variant_index

    return change


def twice(file: str, text: str) -> Change:
    def change(folder: Path) -> None:
        content = (folder / file).read_text().replace("{", "{" + text, 1)
        (folder / file).write_text(content)

    return change


def relabelled(folder: Path) -> None:
    """Move the seeds to the sealed ones and keep what was drawn from the others."""
    in_log(lambda log: [record.update(seed=100_007 + record["episode"]) for record in log])(folder)
    in_card(lambda card: (card["protocol"].update(seed_base=100_007), card["policy"].update(seed=100_007)))(folder)


STRICT: dict[str, tuple[Change, str]] = {
    # steps that no execution can have
    "longer than the horizon": (failures(put(steps=1300)), "at most 1200"),
    "order without checkpoints": (
        one(lambda record: marked(record, firsts(record), [None] * len(record["checkpoints"]))),
        "in order at None",
    ),
    "order after the checkpoint": (
        one(lambda record: record["checkpoints"][0].update(ordered_step=firsts(record)[0] + 10)),
        "in order at",
    ),
    # ends that no execution can have
    "given up early": (failures(put(steps=900, lost=False)), "ended after 900 of 1200"),
    "cut off by a horizon": (failures(put(failure="cut_off")), "the failure class cut_off"),
    "a fault without a reason": (failures(put(failure="unstable_physics")), "unstable_physics and the fault None"),
    "lost and solved": (successes(put(lost=True)), "was lost or broken off"),
    "never asked whether it was lost": (every(lambda record: record.pop("lost", None)), "has lost=None"),
    "a goal that did not end it": (successes(put(steps=1100)), "the goal ends a rollout"),
    # prompts
    "no prompt": (every(put(prompt_steps=0)), "begins after 0 steps"),
    "a prompt of a task without": (
        every(lambda record: record.update(prompt_shown=get_task(record["task"]).prompt is None or None)),
        "prompt_shown",
    ),
    # scenes
    "no scenes": (every(lambda record: record.pop("scene_hash")), "hashes of 16 digits"),
    "other scenes in a control": (
        lambda folder: one(put(scene_hash="ab" * 8))(folder / "pauses"),
        "equal for equal seeds only",
    ),
    "a hash of a version to come": (protocol(scene_hash_version=99), "scene_hash_version is 99"),
    "other scenes of a local version": (
        lambda folder: both(one(put(scene_hash="ab" * 8)), versions(mujoco="3.9.0+x"))(folder / "pauses"),
        "equal for equal seeds only",
    ),
    # numbers that no log holds
    "held longer than a rollout": (every(put(held_steps=10**9)), "found held_steps=1000000000"),
    "holds left out": (every(lambda record: record.pop("held_steps")), "found held_steps=None"),
    "over before it began": (one(put(wall_s=-1.0)), r"wall_s=-1\.0"),
    "lines of another end": (
        lambda folder: (folder / LOG).write_bytes(
            gzip.compress(gzip.decompress((folder / LOG).read_bytes()).replace(b"\n", b"\r"))
        ),
        "line 1: it is not JSON",
    ),
    # pauses
    "pauses of another identity": (in_pauses(identity="act 123"), r"another policy \(identity differs"),
    "pauses of another detector": (in_pauses(detector_sha256="f" * 64), r"another policy \(detector_sha256 differs"),
    "pauses of other weights without a hash": (
        lambda folder: [server(folder, "one"), server(folder / "pauses", "two")],
        r"another policy \(checkpoint differs",
    ),
    "more pauses than steps": (
        lambda folder: one(put(paused_steps=10**6))(folder / "pauses"),
        r"has \{'paused_steps': 1000000\}, expected",
    ),
    # who acted, on what
    "both read, pixels named": (
        both(
            protocol(inputs="pixels", obs_type="both"),
            features({"observation.environment_state": "ENV", "observation.images.image": "VISUAL"}),
        ),
        "inputs are 'pixels'",
    ),
    "the expert as pixels": (
        in_card(lambda card: card["policy"].update(type="memobench_expert")),
        "inputs are 'pixels'",
    ),
    "the expert's action as pixels": (
        in_card(lambda card: card["settings"].update(env={"expert_action": True})),
        "inputs are 'pixels'",
    ),
    "another checkpoint": (in_card(lambda card: card["policy"].update(sha256="3" * 64)), "the policy's sha256"),
    "no checkpoint": (
        in_card(lambda card: (card["policy"].pop("sha256"), card.update(checkpoint=None))),
        "names no checkpoint of act",
    ),
    "longer plans than logged": (
        in_card(lambda card: card["policy"]["settings"].update(n_action_steps=500)),
        "the policy executes 500 actions per plan",
    ),
    "plans left out": (
        both(protocol(replan_steps=None), in_card(lambda card: card["policy"]["settings"].pop("n_action_steps"))),
        "no n_action_steps",
    ),
    "more frames than logged": (
        in_card(lambda card: card["policy"]["settings"].update(n_obs_steps=30)),
        "window_steps: 1 and 30",
    ),
    "a version left out": (
        in_card(lambda card: card["runs"][0]["versions"].pop("lerobot_policy_memobench")),
        "the card names lerobot_policy_memobench None",
    ),
    "versions of other years": (
        versions(lerobot="0.1.0"),
        "the card names lerobot 0.1.0",
    ),
    "a version without a form": (
        versions(mujoco="not 3"),
        "the card names mujoco not 3",
    ),
    # seeds
    "seeds named as sealed": (relabelled, "expected a salt with the sealed"),
    "sealed without a salt": (both(sealed, protocol(salt=None)), "expected a salt with the sealed"),
    "a salt of public seeds": (both(every(drawn(SALT)), protocol(salt=SALT)), "and none with others"),
    # statements
    "a key twice on the card": (twice(CARD, '"protocol": {},'), "a key twice"),
    "look-alike letters": (stating("model", "mеmobench"), "one alphabet"),
    "a call of many people": (stating("submitter", "@team @all"), "submitter = "),
    "a date to come": (stating("date", "9999-12-31"), "date = "),
    "a look-alike host": (stating("links", {"code": "https://www.xn--ggle-55da.com/"}), "begins with https"),
}


@pytest.mark.parametrize("name", STRICT)
def test_hostile_submission_is_refused(row: Path, tmp_path: Path, name: str) -> None:
    change, reason = STRICT[name]
    folder = shutil.copytree(row, tmp_path / "one")
    change(folder)
    with pytest.raises(MemobenchError, match=reason) as refused:
        check_submission(read_submission(folder))
    assert "\n" not in str(refused.value)


PUBLISHED: dict[str, tuple[Change, str]] = {
    "prompts never played": (every(put(prompt_steps=0, prompt_shown=None)), "begins after 0"),
    "failures as successes": (
        failures(put(success=True, failure=None, steps=1000)),
        "without the checkpoint|the goal ends a rollout",
    ),
    "lost goals": (failures(put(lost=True)), "lost: absent and True"),
    "seeds named as sealed": (relabelled, "expected a salt with the sealed"),
}


@pytest.mark.parametrize("name", PUBLISHED)
def test_hostile_published_submission_is_refused(published: Path, tmp_path: Path, name: str) -> None:
    change, reason = PUBLISHED[name]
    folder = shutil.copytree(published, tmp_path / "one")
    check_submission(read_submission(folder))
    change(folder)
    with pytest.raises(MemobenchError, match=reason):
        check_submission(read_submission(folder))


def test_scenes_agree_with_those_of_the_board(tmp_path: Path) -> None:
    """A row of fixed referents draws no variants: its seeds are known by their scenes."""
    for speed in (50, 90):
        made = evaluation(tmp_path / f"m{speed}", speed=speed, suite="published", referent="fixed")
        write_submission(tmp_path / "board" / f"row_{speed}", About(**ABOUT), {"": made})
    others = [read_submission(tmp_path / "board" / "row_50")]
    folder = shutil.copytree(tmp_path / "board" / "row_90", tmp_path / "one")
    check_submission(read_submission(folder), others)
    both(relabelled, protocol(salt=SALT))(folder)
    check_submission(read_submission(folder))
    with pytest.raises(MemobenchError, match="equal for equal seeds only"):
        check_submission(read_submission(folder), others)
    folder = shutil.copytree(tmp_path / "board" / "row_90", tmp_path / "two")
    every(lambda record: record.update(scene_hash=scene_of(record["task"], record["seed"] + 1)))(folder)
    check_submission(read_submission(folder))
    with pytest.raises(MemobenchError, match=r"row_50 has .* for this seed"):
        check_submission(read_submission(folder), others)


@pytest.mark.parametrize(
    "change",
    [
        stating("model", "Other"),
        in_card(lambda card: card["checkpoint"].update(path="user/other")),
        lambda folder: in_card(lambda card: card["checkpoint"].update(path="user/other"))(folder / "pauses"),
        lambda folder: one(put(wall_s=1.0))(folder / "pauses"),
        lambda folder: shutil.rmtree(folder / "pauses"),
    ],
    ids=["another model", "other weights", "a control's card", "a control's log", "a control less"],
)
def test_mark_of_a_rerun_covers_the_whole_row(row: Path, tmp_path: Path, change: Change) -> None:
    board = tmp_path / "board"
    folder = shutil.copytree(row, board / "one")
    (board / "reruns.json").write_text(json.dumps({"one": read_submission(folder).digest}))
    assert [each.rerun for each in board_rows(board)] == [True]
    change(folder)
    assert [each.rerun for each in board_rows(board)] == [False]


def test_a_pull_request_changes_one_row_of_its_author(
    row: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    board = Path("submitted")
    shutil.copytree(row, board / "one")
    Path("changed").write_text(f"results/board/one/{CARD}\0results/board/one/{LOG}\0")
    assert check_board([str(board), "changed", "One"]) == 0
    assert f"accepted: one {read_board(board)[0].digest}" in capsys.readouterr().out
    assert check_board([str(board), "changed"]) == 0, "a maintainer"
    assert check_board([str(board), "changed", ""]) == 1, "an author without an account"
    capsys.readouterr()
    assert check_board([str(board), "changed", "other"]) == 1
    assert "changes one of @one; expected" in capsys.readouterr().err
    stating("submitter", "@other")(shutil.copytree(row, Path("results/board/one")))
    assert check_board([str(board), "changed", "one"]) == 1, "the row belongs to somebody else so far"
    assert "one of @other" in capsys.readouterr().err
    check_paths(["src/x.py", "results/board/reruns.json"])  # no row
    for paths in (["one/a", "two/a"], ["one/a", "reruns.json"], ["one/a", "../../src/x.py"], ["one/a", "x"]):
        with pytest.raises(MemobenchError, match="the pull request also changes"):
            check_paths(f"results/board/{path}" for path in paths)
    with pytest.raises(MemobenchError, match=r"changes reruns.json of the maintainers"):
        check_author("one", check_paths(["results/board/reruns.json"]), board, board)
