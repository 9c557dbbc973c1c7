"""Check of submissions: each is refused with one sentence, without running any part of it.

`lerobot_memobench.board.rules` holds the rules that an honest evaluation may break. The check here recounts everything
from the log: scenes, variants and checkpoints are those that this version of the package draws. It cannot prove that a
rollout took place; therefore the board marks rows that were not rerun.
"""

from __future__ import annotations

import itertools
import re
import statistics
from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from packaging.version import Version

from lerobot_memobench.board.rules import FEWEST, check_control, check_evaluation, supervised_with_answer
from lerobot_memobench.board.submission import About
from lerobot_memobench.constants import EVIDENCE_EPISODES, MEMORY_POLICY, PROMPT_HORIZON, SCENE_HASH_VERSION
from lerobot_memobench.envs.episode import referent_of
from lerobot_memobench.envs.episode_log import evidence_line
from lerobot_memobench.envs.evaluation_file import INPUTS, OF_ONE_EVALUATION, POLICY, differences
from lerobot_memobench.envs.lerobot import EXECUTED, MemobenchEnvConfig
from lerobot_memobench.envs.observations import DETECTIONS, NO_INPUT, PIXEL_INPUT, PRIVILEGED, READ_OBJECTS, SIMULATOR
from lerobot_memobench.envs.pacing import STEPS_BETWEEN_PAUSES, longest
from lerobot_memobench.envs.settings import OBJECTS, PIXELS, SCENE_HASHES, EnvSettings
from lerobot_memobench.errors import MemobenchError, check_choice, nearest
from lerobot_memobench.evaluation.metrics import failure_of, operations
from lerobot_memobench.policies.checkpoint import tree_hash
from lerobot_memobench.policies.memobench_mem.configuration_memobench_mem import MemobenchMemConfig
from lerobot_memobench.policies.memobench_mem.memory import NONE, OURS
from lerobot_memobench.rollouts.plan import SCRIPTED
from lerobot_memobench.tasks.assessment import CUT_OFF, FAULTS, Choice, chance, scene_and_variant
from lerobot_memobench.tasks.catalogue import get_task
from lerobot_memobench.tasks.formula import And, Formula, Never, Then, atoms, children, format_formula, walk
from lerobot_memobench.tasks.task import REFERENTS, STANDARD, STRICT, Task
from tools.board.submission import Submission, Submitted, read_submission

RERUNS = "reruns.json"
"""File of the board, kept by its maintainers: row -> `Submission.digest` of what they ran or repeated."""
CONTROL_FIELDS = ("paused_steps", "choice", "answered", "variants", "chance")
"""Fields of a line of the log that only evaluations with pauses or evidence have."""
KNOWN_INPUTS = (PIXEL_INPUT, DETECTIONS, PRIVILEGED, SIMULATOR, NO_INPUT)
COPIED, CLOSE = 0.5, 2
"""Share of similar successful episodes above which a log counts as a copy, and steps by which similar ones differ."""
FASTEST = 20
"""Fewest steps to a checkpoint, 1 s; the fastest of 7,764 kept rollouts needed 66."""
SCENE = re.compile(r"[0-9a-f]{16}")
DECISIVE = ("memory", "align", "align_targets")
"""Settings of `memobench_mem` that decide whether it is supervised with the answer."""
OBJECTS_READ = "objects"
"""Value of the setting ``perception`` of a policy that reads objects."""


def read_board(board: Path) -> list[Submission]:
    """Return the submissions of a board that pass `check_submission`, and each other.

    Raises:
        MemobenchError: one is refused.
    """
    accepted: list[Submission] = []
    for folder in sorted(path for path in board.iterdir() if path.is_dir() or path.is_symlink()):
        submission = read_submission(folder)
        check_submission(submission, accepted)
        accepted.append(submission)
    check_partners(accepted)
    return accepted


def check_partners(submissions: Sequence[Submission]) -> None:
    """Check that each partner without a memory is another row of the board, of the same protocol, tasks and episodes.

    Raises:
        MemobenchError: one is not, or its settings name a memory.
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
        if remembers(_block(protocols[partner][POLICY].get("settings"))):
            raise MemobenchError(f"{mine}: the policy of {partner} has a memory; name the row of a partner without one")
        if unlike := differences(protocols[mine], protocols[partner], extent=True, ignore=OF_ONE_EVALUATION):
            raise MemobenchError(
                f"{mine} and its partner without a memory, {partner}, differ in {unlike[0]}; evaluate both with the "
                "same settings"
            )


def remembers(settings: Mapping[str, Any]) -> bool:
    """Return whether the settings of a policy name a memory."""
    return bool(settings.get("use_visual_memory")) or settings.get("memory") not in (None, False, NONE)


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


def check_submission(submission: Submission, others: Sequence[Submission] = ()) -> None:
    """Check a submission by all rules.

    Args:
        others: rows that are on the board already.

    Raises:
        MemobenchError: naming the first rule that it breaks.
    """
    run = submission.evaluation
    check_evaluation(run)
    _check_mark(run, submission.about)
    _check_log(run)
    for name, control in submission.controls.items():
        check_control(run, control, name)
        _check_log(control)
    for other in others:
        _check_original(submission, other)
    _check_scenes([run for each in (*others, submission) for run in (each.evaluation, *each.controls.values())])


# --- the log against card, catalogue and seeds ---


def _check_log(run: Submitted) -> None:
    _check_inputs(run)
    _check_policy(run)
    most, absent = longest(_check_plan(run)), None if run.protocol["suite"] == STRICT else 0
    for record in run.records:
        _check_record(run, record)
        held, wall = record.get("held_steps", absent), record.get("wall_s") or 0
        if held is None or not 0 <= held <= most or wall < 0:
            raise MemobenchError(f"{run.folder}: found held_steps={held} and wall_s={wall}; submit the log unchanged")
    if (problem := first_variant_mismatch(run.records)) is not None:
        raise MemobenchError(f"{run.folder}: another version drew the variants ({problem}); evaluate with this version")


def _check_record(run: Submitted, record: Mapping[str, Any]) -> None:
    """Check one line: facts that logs of other tools omit, and an outcome that this task can have."""
    protocol = run.protocol
    where = f"{run.folder}: {record['task']}, episode {record['episode']}"
    if lacking := [key for key in ("seed", "variant") if record.get(key) is None]:
        raise MemobenchError(f"{where} has no {lacking[0]}; evaluate with this version")
    task = get_task(record["task"]).variant(record["variant"])
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


def _paused(pause_steps: int, replan_steps: int | None, steps: int) -> range:
    """Return the possible numbers of paused steps after so many execution steps at full speed, empty without pauses."""
    chunk = replan_steps or 1
    pause = -(-pause_steps // chunk) * chunk  # whole chunks
    fewest, most = STEPS_BETWEEN_PAUSES
    # A rollout may end in a pause.
    return range(max(steps // (most + chunk - 1) - 1, 0) * pause, (steps // fewest + 1) * pause)


def _check_control_fields(where: str, protocol: Mapping[str, Any], record: Mapping[str, Any]) -> None:
    steps = record.get("paused_steps")
    possible = _paused(protocol["pause_steps"], protocol["replan_steps"], record.get("steps") or 0)
    expected: dict[str, Any] = {"paused_steps": steps if steps in possible else possible} if possible else {}
    if protocol["evidence"]:
        choice = record.get("choice")
        answered = choice is not None or record.get("answered", False)
        choices = _choices(record["task"], record["variant"], record["success"], record.get("lost", False))
        expected |= evidence_line(get_task(record["task"]), choice, answered)
        expected |= {} if choice in choices else {"choice": choices}
    logged = {key: record[key] for key in CONTROL_FIELDS if key in record}
    if logged != expected:
        raise MemobenchError(f"{where} has {logged}, expected {expected}; submit the log of this control unchanged")


@cache
def _choices(name: str, variant: int, success: bool, lost: bool) -> Sequence[int | None]:
    """Return the variants that a rollout of a task with this end can have acted on; None for none of them."""
    task = get_task(name).variant(variant)
    fitting = Choice(task).fitting
    if len(fitting) == 1:
        return [variant]
    others = {k: order for k, order in fitting.items() if k != variant}
    forbidden = {atom for part in walk(task.goal) if isinstance(part, Never) for atom in atoms(part)}
    # Either all variants handle the same, and the first goal to become true decides, or the goal forbids to handle what
    # the others begin with. Elsewhere a success proves nothing: an object lifted by mistake may be put back.
    by_goal = all(order == fitting[variant] for order in others.values())
    decided = by_goal or {order[0] for order in others.values()} <= forbidden
    if task.suite != STRICT or chance(task) is None or not decided:
        return [None, *fitting]
    return [variant] if success else [None, *(others if lost else ()), *(() if by_goal else (variant,))]


def _check_plan(run: Submitted) -> EnvSettings:
    """Check that the intervals of plans are those that the policy's settings give, and return the run's settings."""
    kind, of_environment = run.card[POLICY].get("type"), EnvSettings.__dataclass_fields__
    policy = SimpleNamespace(**{**_block(run.card[POLICY].get("settings")), "type": kind})
    own = MemobenchEnvConfig(**{key: value for key, value in run.protocol.items() if key in of_environment})
    of_kind = getattr(_trained_class(kind), "__dataclass_fields__", {})
    problems = [f"no {name}" for name in EXECUTED if name in of_kind and not isinstance(vars(policy).get(name), int)]
    try:
        problems += differences(vars(own.settings), vars(own.settings_for(policy)), ignore=["prompt_in"])
    except Exception as error:  # a card may hold any values
        problems.append(" ".join(str(error).split()))
    if problems:
        raise MemobenchError(f"{run.folder}: its plans are not its policy's ({problems[0]}); submit the card unchanged")
    return own.settings


def _check_inputs(run: Submitted) -> None:
    """Check that the inputs on a card agree with its observations, its policy and the policy's features."""
    policy, obs_type = run.card[POLICY], run.protocol["obs_type"]
    kind, settings = str(policy.get("type")), policy.get("settings", {})
    claimed = {*str(run.protocol.get(INPUTS)).split(", ")}
    for part in claimed:
        check_choice(f"{run.folder}: {INPUTS}", part, KNOWN_INPUTS)
    features = [*_block(settings.get("input_features")).values()]
    types = {str(_block(each).get("type")) for each in features} & {"VISUAL", "ENV"}
    detector = settings.get("detector")
    drawn = {PIXEL_INPUT, DETECTIONS} if obs_type != OBJECTS and (types != {"ENV"} or detector is not None) else set()
    objects = {PRIVILEGED} if obs_type != PIXELS and types != {"VISUAL"} else set()
    ignored = _trained_class(kind) is not None and kind not in (*READ_OBJECTS, MEMORY_POLICY)
    reads = settings["perception"] == OBJECTS_READ if "perception" in settings else not ignored
    needed = objects if reads and "ENV" in types and detector is None else set()
    asked = _block(run.card.get("settings", {}).get("env"))
    if kind in SCRIPTED or asked.get("expert_action") or asked.get("blind_action"):
        needed = {SIMULATOR}
    if claimed - drawn - objects - {SIMULATOR, NO_INPUT} or needed - claimed:
        raise MemobenchError(
            f"{run.folder}: inputs are {run.protocol[INPUTS]!r} on the card with obs_type={obs_type} and the policy "
            f"{kind} of {' and '.join(sorted(types)) or 'unknown'} features; expected {needed or drawn | objects}"
        )


def _trained_class(kind: str | None) -> type | None:
    """Return the configuration class of a policy of LeRobot or of `memobench_mem`, which have weights; else None."""
    import lerobot.policies  # noqa: F401 - registers the types
    from lerobot.configs.policies import PreTrainedConfig

    config = PreTrainedConfig.get_known_choices().get(kind)
    return config if kind == MEMORY_POLICY or str(getattr(config, "__module__", "")).startswith("lerobot.") else None


def _block(value: Any) -> Mapping[str, Any]:
    return value if isinstance(value, Mapping) else {}


def _check_mark(run: Submitted, about: About) -> None:
    """Check that the mark of supervision with the answer is there, and agrees with the alignment and the memory."""
    marked, policy = supervised_with_answer(run, about), run.card[POLICY]
    decisive: Any = {name: str(_block(policy.get("settings")).get(name)) for name in DECISIVE}
    if policy.get("type") != MEMORY_POLICY:
        return
    plugin = decisive["memory"] not in (NONE, *OURS, str(None))  # it is not here: the alignment alone decides
    known = decisive | ({"memory": MemobenchMemConfig.memory} if plugin else {})
    if MemobenchMemConfig(device="cpu", **known).supervised_with_answer and not marked:
        raise MemobenchError(
            f"{run.folder}: supervised_with_answer is false on the card of a policy with {decisive}; submit the card "
            "unchanged"
        )


def _check_policy(run: Submitted) -> None:
    there, checkpoint = run.card[POLICY].get("sha256"), run.card["checkpoint"] or {}
    if there != (tree_hash(checkpoint["files"]) if checkpoint.get("files") else None):
        raise MemobenchError(
            f"{run.folder}: the policy's sha256 {str(there)[:12]} is not that of the checkpoint's files on the card; "
            "submit the card unchanged"
        )
    if there is None and _trained_class(kind := run.card[POLICY].get("type")) is not None:
        raise MemobenchError(f"{run.folder}: the card names no checkpoint of {kind}; evaluate a trained policy")


def _check_scenes(runs: Sequence[Submitted]) -> None:
    """Check that each seed of a task has one scene in all evaluations, and that no two seeds share one.

    Hashes of scenes depend on MuJoCo, on LIBERO's missing scans and on the version of the hash.
    """
    scenes: dict[Any, tuple[str, Path]] = {}
    seeds: dict[Any, tuple[int, Path]] = {}
    for run in runs:
        version = run.protocol[SCENE_HASHES]
        if version > SCENE_HASH_VERSION:
            raise MemobenchError(
                f"{run.folder}: {SCENE_HASHES} is {version}; expected at most {SCENE_HASH_VERSION}, that of this "
                "version"
            )
        simulator = Version(Version(run.card["runs"][-1]["versions"]["mujoco"]).base_version), version
        for record in run.records:
            kind = (*simulator, *record.get("stand_ins", ()), record["task"])
            scene, seed = str(record.get("scene_hash")), record["seed"]
            of_seed, at = scenes.setdefault((kind, seed), (scene, run.folder))
            of_scene, there = seeds.setdefault((kind, scene), (seed, run.folder))
            if not SCENE.fullmatch(scene) or (of_seed, of_scene) != (scene, seed):
                raise MemobenchError(
                    f"{run.folder}: {record['task']}, episode {record['episode']} has the scene {scene[:20]!r} of seed "
                    f"{seed}; {at} has {of_seed[:20]!r} for this seed, and {there} this scene for {of_scene}; expected "
                    "hashes of 16 digits, equal for equal seeds only: one of these folders was changed"
                )


def first_variant_mismatch(records: Iterable[Mapping[str, Any]]) -> str | None:
    """Return the first episode of a log whose variant this version would not draw by its seed, None for none."""
    for record in records:
        variant, seed = record["variant"], record["seed"]
        if record["referent"] == REFERENTS[0]:
            continue
        task = get_task(record["task"]).at(record.get("difficulty", STANDARD))
        if "choice" in record:  # each scene was run with each variant
            here = scene_and_variant(task, record["episode"])[1]
        else:
            here = referent_of(task, seed, record.get("salt")).variant_index
        if here != variant:
            return f"{record['task']}, episode {record['episode']}: variant {variant} there, {here} by its seed here"
    return None


# --- copies ---


def _check_original(submission: Submission, other: Submission) -> None:
    mine, theirs = submission.evaluation, other.evaluation
    if mine.digest == theirs.digest or _copied(mine.records, theirs.records) > COPIED:
        raise MemobenchError(
            f"{mine.folder} has the episodes of the row {other.name!r}; expected an evaluation of its own"
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
    return record["task"], record["seed"], record["variant"]


def _reached(record: Mapping[str, Any]) -> list[int]:
    """Return the first step of each checkpoint, 0 for never."""
    return [mark["first_step"] or 0 for mark in record["checkpoints"]]


def ranked(run: Submitted) -> bool:
    """Return whether an evaluation enters the ranking: strict suite, each scene with each variant, all scenes.

    Without evidence a table from first observations to answers would be right: both follow from public seeds.
    """
    protocol = run.protocol
    return protocol["suite"] == STRICT and protocol["evidence"] and protocol["episodes"] == EVIDENCE_EPISODES
