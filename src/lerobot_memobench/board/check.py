"""Rules of the board: a submission is refused with one sentence, without running any part of it.

The check recounts everything from the log: scenes, variants, tasks and checkpoints are those that this version of the
package draws. It cannot prove that a rollout took place; therefore the board marks rows that were not rerun.
"""

from __future__ import annotations

import itertools
import re
import statistics
from collections.abc import Iterable, Iterator, Mapping, Sequence
from importlib import metadata
from pathlib import Path
from typing import Any

from packaging.requirements import Requirement
from packaging.version import InvalidVersion

from lerobot_memobench.board.submission import PAUSES, RERUNS, Evaluation, Submission, read_submission
from lerobot_memobench.datasets.generation import task_hash
from lerobot_memobench.envs.episode_log import INPUTS, OF_ONE_EVALUATION, OMITTED, POLICY, differences, evidence_line
from lerobot_memobench.envs.observations import DETECTIONS, NO_INPUT, PIXEL_INPUT, PRIVILEGED, READ_OBJECTS, SIMULATOR
from lerobot_memobench.envs.pacing import paused
from lerobot_memobench.envs.settings import MEMORY_CONTROLS, OBJECTS, PICTURES, PIXELS, SCENE_HASHES, EnvSettings
from lerobot_memobench.errors import MemobenchError, check_choice, nearest
from lerobot_memobench.evaluation.agreement import disagreements
from lerobot_memobench.evaluation.metrics import failure_of, operations, seed_base
from lerobot_memobench.policies.lerobot_config import tree_hash
from lerobot_memobench.protocol import (
    EVALUATION_EPISODES,
    EVIDENCE_EPISODES,
    PAPER,
    PROMPT_HORIZON,
    SEALED,
    SPLITS,
)
from lerobot_memobench.run.card import PACKAGES, first_variant_mismatch
from lerobot_memobench.sim.scene_hash import SCENE_HASH_VERSION
from lerobot_memobench.tasks.catalogue import get_task, task_names
from lerobot_memobench.tasks.failures import CUT_OFF, FAULTS
from lerobot_memobench.tasks.formula import And, Formula, Then, children, format_formula
from lerobot_memobench.tasks.task import LIBERO_SUITES, STRICT, Task

FEWEST, MOST = 10, EVALUATION_EPISODES
"""Episodes of each task, without evidence."""
SEEDS = {SPLITS[name].start: name for name in (PAPER, SEALED)}
"""Seed of the first episode -> split of seeds that count."""
MAY_DIFFER = {
    *("suite", "seed_base", "obs_type", "referent", "demonstration_prompt", "prompt_in", "replan_steps"),
    *("evidence", "salt"),
}
"""Settings of the protocol that a submission may choose; all others have their defaults."""
CONTROL_SETTING: Mapping[str, Mapping[str, Any]] = {PAUSES: {"pause_steps": 100}}
CONTROL_FIELDS = ("paused_steps", "choice", "answered", "variants", "chance")
"""Fields of a line of the log that only evaluations with pauses or evidence have."""
KNOWN_INPUTS = (PIXEL_INPUT, DETECTIONS, PRIVILEGED, SIMULATOR, NO_INPUT)
COPIED, CLOSE = 0.5, 2
"""Share of similar successful episodes above which a log counts as a copy, and steps by which similar ones differ."""
FASTEST = 20
"""Fewest steps to a checkpoint, 1 s; the fastest of 7,764 kept rollouts needed 66."""
REQUIRED = {
    found.name: found.specifier for found in map(Requirement, metadata.requires(PACKAGES[0]) or ()) if not found.marker
}
"""Package -> its versions under which this package runs."""
SCENE = re.compile(r"[0-9a-f]{16}")
SCRIPTS = ("memobench_expert", "memobench_blind")
"""Policies whose actions the simulator computes."""
OBJECTS_READ = "objects"
"""Value of the setting ``perception`` of a policy that reads objects."""


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
        if found := differences(protocols[mine], protocols[partner], ignore=OF_ONE_EVALUATION):
            raise MemobenchError(
                f"{mine} and its partner without a memory, {partner}, differ in {found[0]}; evaluate both with the "
                "same settings"
            )


def check_paths(changed: Iterable[str], board: str = "results/board") -> str | None:
    """Check that a pull request with a submission changes the folder of one row only, and return its name, if any.

    Args:
        changed: paths that it changes, relative to the repository.
        board: folder of the board.

    Raises:
        MemobenchError: it also changes another file, or another row.
    """
    paths = [*changed]
    rows = sorted({path.split("/")[board.count("/") + 1] for path in paths if path.startswith(f"{board}/")} - {RERUNS})
    others = [path for path in paths if not path.startswith(tuple(f"{board}/{row}/" for row in rows))]
    if rows and (others or len(rows) > 1):
        raise MemobenchError(
            f"the pull request also changes {(others or rows[1:])[0][:80]!r}; expected files in one folder of {board} "
            "only: move the rest to another pull request"
        )
    return rows[0] if rows else None


def check_author(author: str, name: str | None, *boards: Path) -> None:
    """Check that a pull request of somebody other than a maintainer changes a row of its author.

    Args:
        author: account on GitHub.
        name: the row that it changes, see `check_paths`.
        boards: the board with the change and without it.

    Raises:
        MemobenchError: the row names another submitter, or it changes no row.
    """
    rows = [read_submission(board / name) for board in boards if name and (board / name).exists()]
    submitters = {row.about.submitter.lower() for row in rows} or {"the maintainers"}
    if others := submitters - {f"@{author}".lower()}:
        raise MemobenchError(
            f"the pull request changes {name or RERUNS} of {min(others)}; expected a row whose submitter is its "
            f"author, @{author[:40]}: the maintainers enter results of others and {RERUNS}"
        )


def check_submission(submission: Submission, others: Sequence[Submission] = (), *, part: bool = False) -> None:
    """Check a submission by all rules.

    Args:
        others: rows that are on the board already.
        part: whether any tasks of the suite, and any number of their episodes, will do.

    Raises:
        MemobenchError: naming the first rule that it breaks.
    """
    run = submission.evaluation
    _check_protocol(run)
    names = run.protocol["tasks"] if part else task_names(suite=run.protocol["suite"])
    fewest = 1 if part else FEWEST
    _check_evaluation(run, names, fewest)
    for name, control in submission.controls.items():
        _check_control(run, control, name, names, fewest)
    for other in others:
        _check_original(submission, other)
    _check_scenes([run for each in (*others, submission) for run in (each.evaluation, *each.controls.values())])


# --- protocol ---


def _fixed_settings(protocol: Mapping[str, Any], **control: Any) -> dict[str, Any]:
    """Return the settings that the board, and a control, require with the free ones of a protocol."""
    if protocol.get("suite") in LIBERO_SUITES:
        raise MemobenchError(f"found suite={protocol['suite']}; the board is of memory tasks, published or strict")
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


def _check_control(run: Evaluation, control: Evaluation, name: str, names: Sequence[str], fewest: int) -> None:
    """Check that an evaluation is of the same policy under one control."""
    _check_protocol(control, **CONTROL_SETTING[name])
    for key in ("type", "sha256", "settings"):
        mine, other = (each.card[POLICY].get(key) for each in (run, control))
        if mine != other:
            raise MemobenchError(f"{control.place} is of another policy ({key} differs); evaluate the same checkpoint")
    if found := differences(run.protocol, control.protocol, ignore={*CONTROL_SETTING[name], "salt"}):
        raise MemobenchError(f"{run.place} and {control.place} differ in {found[0]}; evaluate with the same settings")
    _check_evaluation(control, names, fewest)


# --- the log against card, catalogue and seeds ---


def _check_evaluation(run: Evaluation, names: Sequence[str], fewest: int) -> None:
    _check_extent(run, names, fewest)
    _check_versions(run, names)
    _check_inputs(run)
    _check_policy(run)
    for record in run.records:
        _check_record(run, record)
    if (problem := first_variant_mismatch(run.records)) is not None:
        raise MemobenchError(f"{run.place}: another version drew the variants ({problem}); evaluate with this version")
    if found := disagreements(run.card["episodes"], run.records):
        raise MemobenchError(f"{run.place}: card and log disagree: {found[0]}; submit both unchanged")
    _check_salt(run)


def _check_versions(run: Evaluation, names: Sequence[str]) -> None:
    """Check that one version ran all parts, with the task files of this version."""
    for package in PACKAGES[:3]:
        versions = {start["versions"].get(package) for start in run.card["runs"]}
        if len(versions) > 1:
            raise MemobenchError(
                f"{run.place}: its parts ran under {package} {' and '.join(sorted(map(str, versions)))}; evaluate "
                "again with one version"
            )
        for version in map(str, versions):
            try:
                fits = package not in REQUIRED or REQUIRED[package].contains(version, prereleases=True)
            except InvalidVersion:
                fits = False
            if not fits:
                raise MemobenchError(
                    f"{run.place}: the card names {package} {version[:20]}; expected {package}{REQUIRED[package]}"
                )
    for name in names:
        here, there = task_hash(get_task(name)), run.card["task_files"].get(name)
        if here != there:
            raise MemobenchError(
                f"{run.place}: the files of {name} have the hash {str(there)[:16]} on the card and {here} in this "
                "version; evaluate with this version"
            )


def _check_extent(run: Evaluation, names: Sequence[str], fewest: int) -> None:
    """Check that the log holds each episode of each task once, from the first seed of a split on."""
    protocol, seed = run.protocol, run.card[POLICY].get("seed")
    count, base, most = protocol["episodes"], protocol["seed_base"], MOST
    if protocol["evidence"]:  # whole scenes
        fewest, most = max((len(get_task(name).random_variants) for name in names), default=1), EVIDENCE_EPISODES
    if base not in list(SEEDS) or seed != base:
        raise MemobenchError(
            f"{run.place}: the first episode has the seed {seed}; expected {' or '.join(map(str, SEEDS))}, the first "
            "of the seeds that count"
        )
    if not fewest <= count <= most or sorted(protocol["tasks"]) != sorted(names):
        raise MemobenchError(
            f"{run.place}: the protocol has {count} episodes of {len({*names}.intersection(protocol['tasks']))} of "
            f"{len(names)} tasks; expected {fewest} to {most} episodes of each"
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
    settings = ("suite", "world", "difficulty", "protocol", "referent", "salt", "replan_steps", INPUTS)
    for key in (*settings, *PICTURES, "camera_name_mapping", *MEMORY_CONTROLS):
        value = record.get(key, OMITTED.get(key))
        expected = protocol.get(key)
        if value != expected:
            raise MemobenchError(f"{where} has {key}={value} and the card {key}={expected}; submit one evaluation only")
    for part in str(record.get(INPUTS)).split(", "):
        check_choice(f"{where}: {INPUTS}", part, KNOWN_INPUTS)
    if record.get(POLICY) != named[0] or str(named[0]).rpartition(" ")[0] != named[1]:
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
    for problem in _contradictions(protocol, record, task):
        raise MemobenchError(f"{where} {problem}; submit the log unchanged")


def _contradictions(protocol: Mapping[str, Any], record: Mapping[str, Any], task: Task) -> Iterator[str]:
    """Yield what no execution of a task, a variant, can have written: its prompt, its steps, how it ended."""
    success, lost, fault, steps = record["success"], record.get("lost"), record.get("fault"), record.get("steps") or 0
    marks = [(mark["first_step"], mark.get("ordered_step")) for mark in record["checkpoints"]]
    named = [step for step in (*itertools.chain(*marks), steps if success else None) if step is not None]
    if steps > protocol["horizon"] or any(not FASTEST <= step <= steps for step in named):
        yield (
            f"has {steps} steps and checkpoints at {marks} (first, in order); expected at most {protocol['horizon']} "
            f"steps, and checkpoints within them, from step {FASTEST} on"
        )
    before: int | None = 0
    for goal, (first, ordered) in zip((each.goal for each in task.checkpoints), marks, strict=True):
        if goal == task.goal and first != (steps if success else None):
            yield f"has the goal at step {first}, success={success} and {steps} steps; the goal ends a rollout"
        if success and first is None and _conjuncts(goal, And) <= _conjuncts(task.goal, And | Then):
            yield f"is a success without the checkpoint {format_formula(goal)}, which is part of its goal"
        # A checkpoint counts in order at the first step at which it holds with all earlier ones complete.
        at_once = first is not None and before is not None and first >= before
        late = None not in (first, before, ordered) and (ordered or 0) >= (before or 0)
        if ordered != first if at_once else not (ordered is None or late):
            yield f"has a checkpoint at step {first} and in order at {ordered}, after one in order at {before}"
        before = ordered
    if success and protocol["suite"] == STRICT and any(first is None for first, _ in marks):
        yield f"is a success without all checkpoints ({marks})"  # the goal includes each checkpoint
    if success and (lost or fault):
        yield "is a success and was lost or broken off"
    if not (success or lost or fault or steps == protocol["horizon"]):
        yield f"ended after {steps} of {protocol['horizon']} steps without success, a lost goal or a fault"
    failure = record.get("failure")
    if (lost is None) == (protocol["suite"] == STRICT) or failure == CUT_OFF or (failure in FAULTS) != bool(fault):
        yield f"has lost={lost}, the failure class {failure} and the fault {fault}"
    shown = protocol["demonstration_prompt"] and task.prompt is not None
    hidden = task.prompt is not None and not task.prompt.restores
    longest = PROMPT_HORIZON if shown else 0
    at = (task.prompt_steps or 0) if shown else 0
    prompt = record.get("prompt_steps") or 0
    if prompt != at if task.suite == STRICT else not int(shown) <= prompt <= longest:
        yield f"begins after {prompt} steps of prompt; expected {at or f'{int(shown)} to {longest}'}"
    if (record.get("prompt_shown") is not None) != (shown or hidden):
        yield f"has prompt_shown={record.get('prompt_shown')}; its prompt was {'' if shown else 'not '}part of it"


def _conjuncts(formula: Formula, kinds: Any) -> set[Formula]:
    """Return the parts of a conjunction, and with `Then` those of a sequence: each has held when the whole holds."""
    if not isinstance(formula, kinds):
        return {formula}
    return {each for child in children(formula) for each in _conjuncts(child, kinds)}


def _check_control_fields(where: str, protocol: Mapping[str, Any], record: Mapping[str, Any]) -> None:
    """Check that a line has the fields of its control and no others, with the catalogue's variants and chance."""
    steps = record.get("paused_steps")
    possible = paused(protocol["pause_steps"], protocol["replan_steps"], record.get("steps") or 0)
    expected: dict[str, Any] = {"paused_steps": steps if steps in possible else possible} if possible else {}
    if protocol["evidence"]:
        choice = record.get("choice")
        answered = choice is not None or record.get("answered", False)
        expected |= evidence_line(get_task(record["task"]), choice, answered)
    found = {key: record[key] for key in CONTROL_FIELDS if key in record}
    if found != expected:
        raise MemobenchError(f"{where} has {found}, expected {expected}; submit the log of this control unchanged")


def _check_inputs(run: Evaluation) -> None:
    """Check that the inputs on a card agree with its observations, its policy and the policy's features."""
    policy, obs_type = run.card[POLICY], run.protocol["obs_type"]
    kind, settings = str(policy.get("type")), policy.get("settings", {})
    claimed = {*str(run.protocol[INPUTS]).split(", ")}
    features = [*_block(settings.get("input_features")).values()]
    types = {str(_block(each).get("type")) for each in features} & {"VISUAL", "ENV"}
    detector = settings.get("detector")
    drawn = {PIXEL_INPUT, DETECTIONS} if obs_type != OBJECTS and (types != {"ENV"} or detector is not None) else set()
    objects = {PRIVILEGED} if obs_type != PIXELS and types != {"VISUAL"} else set()
    reads = settings["perception"] == OBJECTS_READ if "perception" in settings else not _ignores_objects(kind)
    needed = objects if reads and "ENV" in types and detector is None else set()
    asked = _block(run.card.get("settings", {}).get("env"))
    if kind in SCRIPTS or asked.get("expert_action") or asked.get("blind_action"):
        needed = {SIMULATOR}
    if claimed - drawn - objects - {SIMULATOR, NO_INPUT} or needed - claimed:
        raise MemobenchError(
            f"{run.place}: inputs are {run.protocol[INPUTS]!r} on the card with obs_type={obs_type} and the policy "
            f"{kind} of {' and '.join(sorted(types)) or 'unknown'} features; expected {needed or drawn | objects}"
        )


def _ignores_objects(kind: str) -> bool:
    """Return whether a policy type is one of LeRobot's that do not read objects."""
    import lerobot.policies  # noqa: F401 - registers the types
    from lerobot.configs.policies import PreTrainedConfig

    found = PreTrainedConfig.get_known_choices().get(kind)
    return found is not None and found.__module__.startswith("lerobot.") and kind not in READ_OBJECTS


def _block(value: Any) -> Mapping[str, Any]:
    return value if isinstance(value, Mapping) else {}


def _check_policy(run: Evaluation) -> None:
    """Check that the hash of a checkpoint is that of its files on the card."""
    there, checkpoint = run.card[POLICY].get("sha256"), run.card["checkpoint"] or {}
    if there != (tree_hash(checkpoint["files"]) if checkpoint.get("files") else None):
        raise MemobenchError(
            f"{run.place}: the policy's sha256 {str(there)[:12]} is not that of the checkpoint's files on the card; "
            "submit the card unchanged"
        )


def _check_scenes(runs: Sequence[Evaluation]) -> None:
    """Check that each seed of a task has one scene in all evaluations, and that no two seeds share one.

    Hashes of scenes depend on MuJoCo, on LIBERO's missing scans and on the version of the hash.
    """
    scenes: dict[Any, tuple[str, Path]] = {}
    seeds: dict[Any, tuple[int, Path]] = {}
    for run in runs:
        version = run.protocol[SCENE_HASHES]
        if version > SCENE_HASH_VERSION:
            raise MemobenchError(
                f"{run.place}: {SCENE_HASHES} is {version}; expected at most {SCENE_HASH_VERSION}, that of this version"
            )
        simulator = run.card["runs"][-1]["versions"].get("mujoco"), version
        for record in run.records:
            kind = (*simulator, *record.get("stand_ins", ()), record["task"])
            scene, seed = str(record.get("scene_hash")), record["seed"]
            of_seed, at = scenes.setdefault((kind, seed), (scene, run.place))
            of_scene, there = seeds.setdefault((kind, scene), (seed, run.place))
            if not SCENE.fullmatch(scene) or (of_seed, of_scene) != (scene, seed):
                raise MemobenchError(
                    f"{run.place}: {record['task']}, episode {record['episode']} has the scene {scene[:20]!r} of seed "
                    f"{seed}; {at} has {of_seed[:20]!r} for this seed, and {there} this scene for {of_scene}; expected "
                    "hashes of 16 digits, equal for equal seeds only: one of these folders was changed"
                )


def _check_salt(run: Evaluation) -> None:
    """Check that an evaluation on the sealed seeds, and no other, has a salt."""
    if (SEEDS[run.protocol["seed_base"]] == SEALED) != bool(run.protocol["salt"]):
        raise MemobenchError(
            f"{run.place} has the salt {run.protocol['salt']}; expected a salt with the sealed seeds, and none with "
            "others: evaluate them by `memobench test-sealed`"
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
    """Return the share of similar episodes among those in which both policies succeed in the same scene.

    They are similar if no checkpoint differs by more than `CLOSE` from the median difference of both logs: two
    trainings on the same demonstrations share at most a third of them. Steps after the last checkpoint are easily
    edited. Failures do not count: two policies may reach nothing.
    """
    scenes = {_drawn(record): _reached(record) for record in theirs if record["success"]}
    pairs = [
        [a - b for a, b in zip(_reached(record), scenes[key], strict=True)]
        for record in mine
        if record["success"] and (key := _drawn(record)) in scenes
    ]
    if len(pairs) < FEWEST:
        return 0.0
    shift = statistics.median(itertools.chain(*pairs))
    return sum(all(abs(each - shift) <= CLOSE for each in steps) for steps in pairs) / len(pairs)


def _drawn(record: Mapping[str, Any]) -> tuple[str, int, int]:
    """Return the scene and the variant of a rollout."""
    return record["task"], record["seed"], record["variant"]


def _reached(record: Mapping[str, Any]) -> list[int]:
    """Return the first step of each checkpoint, 0 for never."""
    return [mark["first_step"] or 0 for mark in record["checkpoints"]]


def ranked(run: Evaluation) -> bool:
    """Return whether an evaluation enters the ranking: strict suite, each scene with each variant, all scenes."""
    return run.protocol["suite"] == STRICT and is_complete(run.protocol)


def is_complete(protocol: Mapping[str, Any]) -> bool:
    """Return whether a protocol has the episodes of a complete evaluation; of the strict suite one with evidence.

    Without evidence a table from first observations to answers would be right: both follow from public seeds.
    """
    if protocol["suite"] == STRICT or protocol["evidence"]:
        return bool(protocol["evidence"] and protocol["episodes"] == EVIDENCE_EPISODES)
    return bool(protocol["episodes"] == MOST)
