"""Rules of the board: a submission is refused with one sentence, without running any part of it.

The check recounts everything from the log: scenes, variants, tasks and checkpoints are those that this version of the
package draws. It cannot prove that a rollout took place; therefore the board marks rows that were not rerun.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from lerobot_memobench.board.submission import EVIDENCE, PAUSES, Evaluation, Submission, read_submission
from lerobot_memobench.datasets.generation import task_hash
from lerobot_memobench.envs.episode_log import INPUTS, OF_THE_POLICY, OMITTED, POLICY, differences, evidence_line
from lerobot_memobench.envs.observations import DETECTIONS, NO_INPUT, PIXEL_INPUT, PRIVILEGED, SIMULATOR
from lerobot_memobench.envs.settings import MEMORY_CONTROLS, EnvSettings
from lerobot_memobench.errors import MemobenchError, check_choice, nearest
from lerobot_memobench.evaluation.agreement import disagreements
from lerobot_memobench.evaluation.metrics import failure_of, operations, seed_base
from lerobot_memobench.protocol import EVALUATION_EPISODES, PAPER, SEALED, SPLITS
from lerobot_memobench.run.card import PACKAGES, first_variant_mismatch
from lerobot_memobench.run.sealed import scenes_hash
from lerobot_memobench.tasks.catalogue import get_task, task_names
from lerobot_memobench.tasks.task import STRICT

FEWEST, MOST = 10, EVALUATION_EPISODES
"""Episodes of each task; a row is ranked with the most."""
SEEDS = {SPLITS[name].start: name for name in (PAPER, SEALED)}
"""Seed of the first episode -> split of seeds that count."""
MAY_DIFFER = {
    *("suite", "world", "seed_base", "obs_type", "referent", "demonstration_prompt", "prompt_in", "replan_steps"),
}
"""Settings of the protocol that a submission may choose; all others have their defaults."""
CONTROL_SETTING: Mapping[str, Mapping[str, Any]] = {EVIDENCE: {"evidence": True}, PAUSES: {"pause_steps": 100}}
CONTROL_FIELDS = ("paused_steps", "choice", "answered", "variants", "chance")
"""Fields of a line of the log that only a control has."""
KNOWN_INPUTS = (PIXEL_INPUT, DETECTIONS, PRIVILEGED, SIMULATOR, NO_INPUT)
COPIED = 0.5
"""Share of equal successful episodes, step for step, from which on one log counts as a copy of another."""


def read_board(board: Path) -> list[Submission]:
    """Return the submissions of a board that pass `check_submission`, and each other.

    Raises:
        MemobenchError: one is refused.
    """
    found: list[Submission] = []
    for folder in sorted(path for path in board.iterdir() if path.is_dir() or path.is_symlink()):
        submission = read_submission(folder)
        check_submission(submission, found)
        found.append(submission)
    check_partners(found)
    return found


def check_partners(submissions: Sequence[Submission]) -> None:
    """Check that each partner without a memory is another row of the board, with the same protocol.

    Raises:
        MemobenchError: one is not.
    """
    protocols = {submission.name: submission.evaluation.protocol for submission in submissions}
    for submission in submissions:
        mine, partner = submission.name, submission.about.without_memory
        others = protocols.keys() - {mine}
        if partner is None:
            continue
        if partner not in others:
            raise MemobenchError(
                f"{mine}: the partner without a memory, {partner!r}, is no other row; {nearest(partner, others)}"
            )
        if found := differences(protocols[mine], protocols[partner], ignore=OF_THE_POLICY):
            raise MemobenchError(
                f"{mine} and its partner without a memory, {partner}, differ in {found[0]}; evaluate both with the "
                "same settings"
            )


def check_paths(changed: Iterable[str], board: str = "results/board") -> None:
    """Check that a pull request with a submission changes folders of rows only.

    Args:
        changed: paths that it changes, relative to the repository.
        board: folder of the board.

    Raises:
        MemobenchError: it also changes another file.
    """
    parts = {path: path.removeprefix(f"{board}/").split("/") for path in changed}
    rows = [path for path in parts if path.startswith(f"{board}/") and len(parts[path]) > 1]
    others = [path for path in parts if path not in rows]
    if rows and others:
        raise MemobenchError(
            f"the pull request also changes {others[0][:80]!r}; expected files in folders of {board} only: move the "
            "rest to another pull request"
        )


def check_submission(submission: Submission, others: Sequence[Submission] = ()) -> None:
    """Check a submission by all rules.

    Args:
        others: rows that are on the board already.

    Raises:
        MemobenchError: naming the first rule that it breaks.
    """
    run = submission.evaluation
    _check_protocol(run)
    _check_evaluation(run, task_names(suite=run.protocol["suite"]))
    for name, control in submission.controls.items():
        _check_control(run, control, name)
    for other in others:
        _check_original(submission, other)


# --- protocol ---


def _fixed_settings(protocol: Mapping[str, Any], **control: Any) -> dict[str, Any]:
    """Return the settings that the board, and a control, require with the free ones of a protocol."""
    board = EnvSettings(**{key: protocol[key] for key in MAY_DIFFER if key in protocol}, **control)
    return {key: value for key, value in board.protocol_block.items() if key not in MAY_DIFFER}


def departures(protocol: Mapping[str, Any]) -> list[str]:
    """Return the settings that differ from those of the board; raise for unknown values."""
    return differences(protocol, _fixed_settings(protocol), ignore=MAY_DIFFER)


def _check_protocol(run: Evaluation, **control: Any) -> None:
    """Check that the card's settings are those of the board, and of a control."""
    protocol = run.protocol
    try:
        fixed = _fixed_settings(protocol, **control)
    except MemobenchError as error:
        raise MemobenchError(f"{run.place}: {error}") from None
    if missing := sorted({*fixed, *MAY_DIFFER} - {*protocol}):
        raise MemobenchError(
            f"{run.place}: the card's protocol lacks {', '.join(missing)}; submit a card of `lerobot eval`"
        )
    if found := differences(protocol, fixed, ignore=MAY_DIFFER):
        raise MemobenchError(f"{run.place}: {found[0]} on the board; evaluate with the value of the board")


def _check_control(run: Evaluation, control: Evaluation, name: str) -> None:
    """Check that an evaluation is of the same policy under one control."""
    _check_protocol(control, **CONTROL_SETTING[name])
    for key in ("type", "sha256", "settings"):
        mine, other = (each.card[POLICY].get(key) for each in (run, control))
        if mine != other:
            raise MemobenchError(f"{control.place} is of another policy ({key} differs); evaluate the same checkpoint")
    if found := differences(run.protocol, control.protocol, ignore=CONTROL_SETTING[name]):
        raise MemobenchError(f"{run.place} and {control.place} differ in {found[0]}; evaluate with the same settings")
    names = task_names(suite=run.protocol["suite"])
    if name == EVIDENCE:
        names = [task for task in names if get_task(task).num_variants > 1]
    _check_evaluation(control, names)


# --- the log against card, catalogue and seeds ---


def _check_evaluation(run: Evaluation, names: Sequence[str]) -> None:
    _check_versions(run, names)
    _check_extent(run, names)
    for record in run.records:
        _check_record(run, record)
    if (problem := first_variant_mismatch(run.records)) is not None:
        raise MemobenchError(f"{run.place}: another version drew the variants ({problem}); evaluate with this version")
    if found := disagreements(run.card["episodes"], run.records):
        raise MemobenchError(f"{run.place}: card and log disagree: {found[0]}; submit both unchanged")
    _check_sealed(run)


def _check_versions(run: Evaluation, names: Sequence[str]) -> None:
    """Check that one version ran all parts, with the task files of this version."""
    for package in PACKAGES[:3]:
        versions = {start["versions"].get(package) for start in run.card["runs"]}
        if len(versions) > 1:
            raise MemobenchError(
                f"{run.place}: its parts ran under {package} {' and '.join(sorted(map(str, versions)))}; evaluate "
                "again with one version"
            )
    for name in names:
        here, there = task_hash(get_task(name)), run.card["task_files"].get(name)
        if here != there:
            raise MemobenchError(
                f"{run.place}: the files of {name} have the hash {str(there)[:16]} on the card and {here} in this "
                "version; evaluate with this version"
            )


def _check_extent(run: Evaluation, names: Sequence[str]) -> None:
    """Check that the log holds each episode of each task once, from the first seed of a split on."""
    protocol, seed = run.protocol, run.card[POLICY].get("seed")
    count, base = protocol["episodes"], protocol["seed_base"]
    least, most = FEWEST, MOST
    if protocol["evidence"]:  # whole scenes
        least, most = max(len(get_task(name).random_variants) for name in names), 12 * MOST
    if base not in list(SEEDS) or seed != base:
        raise MemobenchError(
            f"{run.place}: the first episode has the seed {seed}; expected {' or '.join(map(str, SEEDS))}, the first "
            "of the seeds that count"
        )
    if not least <= count <= most or sorted(protocol["tasks"]) != sorted(names):
        raise MemobenchError(
            f"{run.place}: the protocol has {count} episodes of {len(protocol['tasks'])} tasks; expected {least} to "
            f"{most} of each of the {len(names)} tasks of the suite"
        )
    asked = set(itertools.product(names, range(count)))
    there = {(record["task"], record["episode"]) for record in run.records if "not_run" not in record}
    for task, episode in sorted(asked ^ there)[:1]:
        problem = "is missing in the log" if (task, episode) in asked else "is not part of the protocol"
        raise MemobenchError(
            f"{run.place}: {task[:80]}, episode {episode}, {problem}; expected {count} rollouts of each of the "
            f"{len(names)} tasks"
        )


def _check_record(run: Evaluation, record: Mapping[str, Any]) -> None:
    """Check one line: settings as on the card, seed, and an outcome that this task can have."""
    protocol, named = run.protocol, (run.records[0].get(POLICY), str(run.card[POLICY].get("type")))
    where = f"{run.place}: {record['task']}, episode {record['episode']}"
    settings = ("suite", "world", "difficulty", "protocol", "convention", "referent", "replan_steps", INPUTS)
    for key in (*settings, *MEMORY_CONTROLS):
        value = record.get(key, OMITTED.get(key))
        expected = protocol.get(key)
        if value != expected:
            raise MemobenchError(f"{where} has {key}={value} and the card {key}={expected}; submit one evaluation only")
    for part in str(record.get(INPUTS)).split(", "):
        check_choice(f"{where}: {INPUTS}", part, KNOWN_INPUTS)
    if record.get(POLICY) != named[0] or not str(named[0]).startswith(named[1]):
        raise MemobenchError(f"{where} is of the policy {record.get(POLICY)!r}; expected the policy of the card only")
    if record.get("seed") is None or seed_base(record) != protocol["seed_base"]:
        raise MemobenchError(
            f"{where} has the seed {record.get('seed')}; expected those from {protocol['seed_base']} on, in order"
        )
    if (variant := record.get("variant")) is None:
        raise MemobenchError(f"{where} has no variant; evaluate with this version")
    task = get_task(record["task"]).variant(variant)
    if record["memory_type"] != task.memory_type or operations(record) != task.operations:
        raise MemobenchError(
            f"{where} has other checkpoints than the task ({task.operations}); evaluate with this version"
        )
    _check_control_fields(where, protocol, record)
    failure_of(record)
    steps, reached = record.get("steps"), [mark["first_step"] for mark in record["checkpoints"]]
    ordered = [mark.get("ordered_step") for mark in record["checkpoints"]]
    within = all(step is None or 1 <= step <= (steps or 0) for step in (*reached, *ordered))
    if steps is None or steps > protocol["horizon"] or not within:
        raise MemobenchError(
            f"{where} has {steps} steps and checkpoints at {reached}, in order at {ordered}; expected at most "
            f"{protocol['horizon']} steps, and checkpoints within them"
        )
    if record["success"] and (record.get("lost") or record.get("fault")):
        raise MemobenchError(f"{where} is a success and was lost or broken off; submit the log unchanged")
    if record["success"] and protocol["suite"] == STRICT and None in reached:  # the goal includes each checkpoint
        raise MemobenchError(f"{where} is a success without all checkpoints ({reached}); submit the log unchanged")


def _check_control_fields(where: str, protocol: Mapping[str, Any], record: Mapping[str, Any]) -> None:
    """Check that a line has the fields of its control and no others, with the catalogue's variants and chance."""
    expected = {"paused_steps": record.get("paused_steps")} if protocol["pause_steps"] else {}
    if protocol["evidence"]:
        choice = record.get("choice")
        answered = choice is not None or record.get("answered", False)
        expected |= evidence_line(get_task(record["task"]), choice, answered)
    found = {key: record[key] for key in CONTROL_FIELDS if key in record}
    if found != expected:
        raise MemobenchError(f"{where} has {found}, expected {expected}; submit the log of this control unchanged")


def _check_sealed(run: Evaluation) -> None:
    """Check that a sealed evaluation was committed to this policy and these scenes when it started."""
    sealed = run.card.get("sealed")
    if SEEDS[run.protocol["seed_base"]] != SEALED:
        return
    expected = {"scenes": scenes_hash(run.card), "policy": run.card[POLICY].get("sha256")}
    for key, value in expected.items():
        there = None if sealed is None else sealed.get(key)
        if there is None or (value is not None and there != value):
            raise MemobenchError(
                f"{run.place}: the commitment of the sealed test does not match ({key}: {str(there)[:12]} there, "
                f"{str(value)[:12]} by the card); evaluate by `memobench test-sealed`"
            )


# --- copies ---


def _check_original(submission: Submission, other: Submission) -> None:
    """Check that a row does not repeat another row."""
    mine, theirs = submission.evaluation, other.evaluation
    if mine.digest == theirs.digest or _copied(mine.records, theirs.records) > COPIED:
        raise MemobenchError(
            f"{mine.place} has the episodes of the row {other.name!r}; expected an evaluation of its own"
        )


def _copied(mine: Sequence[Mapping[str, Any]], theirs: Sequence[Mapping[str, Any]]) -> float:
    """Return the share of equal episodes among those in which both policies succeed in the same scene.

    Two policies seldom need the same number of steps to each checkpoint; steps after the last one are easily edited.
    Failures do not count: two policies may reach nothing.
    """
    scenes = {(record["task"], record["seed"]): record for record in theirs if record["success"]}
    pairs = [
        (record, scenes[key])
        for record in mine
        if record["success"] and (key := (record["task"], record["seed"])) in scenes
    ]
    equal = sum(a["checkpoints"] == b["checkpoints"] for a, b in pairs)
    return equal / len(pairs) if len(pairs) >= FEWEST else 0.0


def ranked(run: Evaluation) -> bool:
    """Return whether an evaluation enters the ranking: strict suite, all scenes."""
    return bool(run.protocol["suite"] == STRICT and run.protocol["episodes"] == MOST)
