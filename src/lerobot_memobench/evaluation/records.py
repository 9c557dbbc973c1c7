"""Evaluations read back from their folders: the evaluation's file, rollouts, names, and the headline of a report.

An evaluation is given as its folder, or as ``NAME=FOLDER``. Evaluations of the same name are one method at several
replan intervals; without names, those of the same policy are. Evaluations of one policy in several suites of LIBERO are
joined to one, whose average is the mean over suites.
"""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import pairwise
from pathlib import Path
from typing import Any

from lerobot_memobench.constants import PAPER, split_of
from lerobot_memobench.envs.episode_log import has_log, joined, key_of, not_run, notes_on_not_run, read_lines
from lerobot_memobench.envs.evaluation_file import EXTENT, MOST_EPISODES, POLICY, differences, read_evaluation
from lerobot_memobench.envs.settings import DEFAULTS, IMAGE_SETTINGS, MEMORY_CONTROLS, SCENE_HASHES
from lerobot_memobench.errors import MemobenchError, count_of, cut
from lerobot_memobench.evaluation.evidence import EvidenceRates, evidence_of
from lerobot_memobench.evaluation.metrics import Record, Summary, inputs_phrase, notes_on, stand_ins_of, summary_of
from lerobot_memobench.tasks.catalogue import GROUPS
from lerobot_memobench.tasks.task import LIBERO_SUITES, PUBLISHED

# --- extent ---


def _requested(card: Mapping[str, Any]) -> tuple[list[str], range] | None:
    """Return the tasks and episode numbers that a file asks for, None where LeRobot's own commands wrote it."""
    protocol = card["protocol"]
    if not {*EXTENT} <= {*protocol}:
        return None
    seed, base = card[POLICY].get("seed"), protocol.get("seed_base")
    first = seed - base if isinstance(seed, int) and isinstance(base, int) else 0
    return sorted({*protocol["tasks"]}), range(first, first + protocol["episodes"])


def _missing(tasks: Sequence[str], episodes: range, records: Iterable[Record], shard: str | None) -> str | None:
    """Return a sentence on the requested episodes without a record, None without such episodes."""
    logged, total = set(map(key_of, records)), len(tasks) * len(episodes)
    if len(logged) == total:
        return None
    task, episode = next(key for key in itertools.product(tasks, episodes) if key not in logged)
    unrun = len(tasks) - len({name for name, _ in logged})
    return (
        f"missing: {total - len(logged):,} of {count_of(total, 'episode')}"
        f"{f', with all of {count_of(unrun, "task")}' if unrun else ''}, the first is {task}, episode {episode}"
        f"{f', in part {shard} of an evaluation' if shard else ''}; run the same command, or the missing parts, with "
        "resume=true"
    )


# --- evaluations ---

HASH_DIGITS = 8


@dataclass(frozen=True)
class Run:
    """One evaluation.

    Attributes:
        name: unique in a report. method: whose result it is; several runs of one method differ in the replan interval.
        card: content of its file; of the first one where several are joined.
        records: rollouts, each with the facts of its file. protocol: of the file, with the extent and ``policy``.
        notes: warnings for the reader, such as unreadable lines.
        missing: a sentence on the episodes that its file asks for and its log lacks; None without such episodes.
        not_run: task -> episodes that could not be run.
        parts: evaluations of single suites of LIBERO that are joined in it.
    """

    name: str
    method: str
    folder: Path
    card: Mapping[str, Any]
    records: Sequence[Record]
    protocol: Mapping[str, Any]
    notes: Sequence[str] = field(default_factory=tuple)
    missing: str | None = None
    not_run: Mapping[str, int] = field(default_factory=dict)
    parts: Sequence[Run] = ()

    @property
    def evaluations(self) -> Sequence[Run]:
        """The evaluations with a folder of their own: its parts, else itself."""
        return self.parts or (self,)

    @property
    def suites(self) -> tuple[str, ...]:
        """The suites of its rollouts."""
        return tuple(evaluation.protocol.get("suite", PUBLISHED) for evaluation in self.evaluations)

    @cached_property
    def summary(self) -> Summary:
        """Every figure of its rollouts."""
        return summary_of(self.records)

    @cached_property
    def evidence(self) -> EvidenceRates | None:
        """How often choices follow the evidence, None where scenes were not run with each variant."""
        return evidence_of(self.records)

    @property
    def replan_steps(self) -> int | None:
        """The one interval of all rollouts; the policy's own where none was asked for; None where it is unknown."""
        steps = self.protocol.get("replan_steps")
        if steps is None:
            steps = self.protocol[POLICY].get("settings", {}).get("n_action_steps")
        return steps if isinstance(steps, int) else None  # joined evaluations may have several


def read_runs(words: Sequence[str | Path]) -> list[Run]:
    """Read evaluations given as ``FOLDER`` or ``NAME=FOLDER``; a folder may hold one for each suite of LIBERO.

    Raises:
        MemobenchError: a folder holds no rollouts or is given twice, one method has two results at one interval, or
            the suites or the sources of the scenes differ.
    """
    labelled = [_split(word) for word in words]
    if not labelled:
        raise MemobenchError("no evaluation was given; expected folders that evaluations have written")
    names = folder_names([folder for _, folder in labelled])
    runs = []
    for (label, folder), name in zip(labelled, names, strict=True):
        # An evaluation of several suites has a folder of each.
        suites = [] if has_log(folder) else [suite for suite in LIBERO_SUITES if has_log(folder / suite)]
        runs.append(_joined([read_run(folder / suite, name, label or "") for suite in suites or ("",)]))
    first = runs[0].suites[0]
    for run in runs:
        if (suite := run.suites[0]) != first and not {suite, first} <= {*LIBERO_SUITES}:
            raise MemobenchError(
                f"{runs[0].folder} is an evaluation of suite={first} and {run.folder} one of suite={suite}, whose "
                "figures do not compare; report each suite by itself"
            )
    if len({run.suites for run in runs}) > 1:
        groups: dict[Any, list[Run]] = {}
        for run in runs:
            groups.setdefault(run.method or (*_policy(run), run.replan_steps), []).extend(run.evaluations)
        runs = [_joined(group) for group in groups.values()]
    return _with_methods(runs)


def _joined(parts: Sequence[Run]) -> Run:
    """Return evaluations of one policy, each in another suite of LIBERO, as one; raise for several policies."""
    if len(parts) == 1:
        return parts[0]
    parts = sorted(parts, key=lambda part: GROUPS.index(part.suites[0]))
    for a, b in pairwise(parts):  # in the order of suites, equal ones are neighbours
        if a.suites == b.suites or _policy(a) != _policy(b):
            same = f"the suite {a.suites[0]}" if a.suites == b.suites else "other policies"
            raise MemobenchError(
                f"{a.folder} and {b.folder} are of {same}, and an average over suites of LIBERO is of one policy "
                "and each suite once; give the folders of each policy one name: A=FOLDER A=FOLDER B=FOLDER"
            )
        for name in IMAGE_SETTINGS:
            if a.protocol.get(name) != b.protocol.get(name):
                raise MemobenchError(f"{a.folder} and {b.folder} differ in {name}; report each by itself")
    values = {key: [part.protocol.get(key) for part in parts] for part in parts for key in part.protocol}
    protocol = {key: group[0] if group.count(group[0]) == len(parts) else group for key, group in values.items()}
    tasks = sorted(name for part in parts for name in part.protocol["tasks"])
    missing = [f"{part.suites[0]}: {part.missing}" for part in parts if part.missing is not None]
    return replace(
        parts[0],
        name="+".join(dict.fromkeys(part.name for part in parts)),
        folder=parts[0].folder.parent,
        records=[record for part in parts for record in part.records],
        protocol={**protocol, "tasks": tasks, POLICY: parts[0].protocol[POLICY]},
        notes=[f"{part.suites[0]}: {note}" for part in parts for note in part.notes],
        missing="; ".join(missing) or None,
        parts=parts,
    )


def unlike(runs: Sequence[Run]) -> list[str]:
    """Return a sentence for each of several evaluations whose protocol differs from the first one's.

    Replan intervals may differ: they are compared on purpose.
    """
    notes = []
    first = runs[0]
    for run in runs[1:]:
        if settings := differences(first.protocol, run.protocol, extent=True, ignore=("replan_steps", "salt")):
            notes.append(
                f"{first.name} and {run.name} have different protocols ({'; '.join(settings)}; the first value is that "
                f"of {first.name}): do not compare their rates; `memobench compare` compares common episodes"
            )
        notes += other_physics(first, run) + other_hashes(first.protocol, run.protocol) + other_draws(first, run)
    return notes


def other_draws(a: Run, b: Run) -> list[str]:
    """Return a sentence where two evaluations of the sealed test have different salts."""
    salt_a, salt_b = (run.protocol.get("salt") for run in (a, b))
    if salt_a == salt_b:
        return []
    return [
        f"{a.name} has the salt {salt_a or 'none'} and {b.name} {salt_b or 'none'}: their variants and holds are two "
        "draws of the same protocol; comparisons pair the episodes of equal variants"
    ]


def other_hashes(a: Mapping[str, Any], b: Mapping[str, Any]) -> list[str]:
    """Return a sentence where the versions of scene hashes differ between two protocols."""
    of_a, of_b = (protocol.get(SCENE_HASHES) for protocol in (a, b))
    if of_a == of_b:
        return []
    return [f"the versions hash scenes differently ({SCENE_HASHES} {of_a} and {of_b}): hashes are not compared"]


def other_physics(a: Run, b: Run) -> list[str]:
    """Return a sentence where two evaluations ran under different versions of MuJoCo, by their cards."""
    starts = ([start.get("versions", {}) for start in run.card.get("runs", [])] for run in (a, b))
    versions_a, versions_b = ({versions["mujoco"] for versions in group if "mujoco" in versions} for group in starts)
    if not versions_a or not versions_b or versions_a == versions_b:
        return []
    of_a, of_b = (" and ".join(sorted(versions)) for versions in (versions_a, versions_b))
    return [f"{a.name} ran under MuJoCo {of_a} and {b.name} under {of_b}: scenes start and move slightly otherwise"]


def read_run(folder: str | Path, name: str | None = None, method: str = "") -> Run:
    """Return an evaluation with warnings: unreadable lines, episodes that are missing, were not run or were broken
    off, mixed protocols.

    Raises:
        MemobenchError: it has no rollouts, or a line contradicts the settings in its file.
    """
    folder, notes = Path(folder), list[str]()
    return run_of(folder, read_lines(folder, notes), notes, name, method)


def run_of(
    folder: Path, lines: Sequence[Mapping[str, Any]], notes: Sequence[str], name: str | None = None, method: str = ""
) -> Run:
    """Return the evaluation in a folder, given the lines of its log and the notes of reading them; see `read_run`."""
    card, notes = read_evaluation(folder), [*notes]
    records, missing = joined(folder, card, lines), None
    if requested := _requested(card):
        tasks, episodes = requested
        records = [record for record in records if record["task"] in tasks and record["episode"] in episodes]
        missing = _missing(tasks, episodes, records, card.get("shard"))
    if len(records) < len(lines):
        notes.append(f"{count_of(len(lines) - len(records), 'rollout')} beyond those that were asked for left out")
    notes += [*([] if missing is None else [missing]), *notes_on_not_run(records)]
    unrun = {task: len(group) for task, group in not_run(records).items()}
    # A file that requests no episodes has the extent of its log; larger numbers are damage.
    numbers = (line["episode"] + 1 for line in lines if line["episode"] < MOST_EPISODES)
    logged = {"tasks": sorted({line["task"] for line in lines}), "episodes": max(numbers, default=0)}
    protocol = {**logged, **card["protocol"], POLICY: card[POLICY]}
    records = [record for record in records if "not_run" not in record]
    if not records:
        reasons = "".join(f"; {note}" for note in notes)
        raise MemobenchError(f"{folder} holds no rollout that can be read{reasons}; run an evaluation first")
    notes += notes_on(records)
    return Run(name or folder.name, method, folder, card, records, protocol, notes, missing, unrun)


def _split(word: str | Path) -> tuple[str | None, Path]:
    """Take ``NAME=FOLDER`` apart; a folder whose own name holds an equals sign is still one."""
    if isinstance(word, Path) or Path(word).exists():
        return None, Path(word)
    label, equals, folder = word.partition("=")
    if not equals or "/" in label:
        return None, Path(word)
    if not label.strip() or not folder:
        raise MemobenchError(f"found {word!r}; expected a folder, or NAME=FOLDER")
    return label.strip(), Path(folder)


def folder_names(folders: Sequence[str | Path]) -> list[str]:
    """Return the shortest ends of the folders' paths that are distinct."""
    paths = [Path(folder).resolve() for folder in folders]
    if len(set(paths)) < len(paths):
        twice = next(path for path in paths if paths.count(path) > 1)
        raise MemobenchError(f"{twice} is given twice; name each evaluation once")
    depth = 1
    while len({path.parts[-depth:] for path in paths}) < len(paths):
        depth += 1
    return ["/".join(path.parts[-depth:]) for path in paths]


def _with_methods(runs: Sequence[Run]) -> list[Run]:
    """Name methods as given, else by policy, else by folder; name the evaluations of given methods after these."""
    kinds = Counter(kind for kind, _ in {_policy(run) for run in runs if not run.method and run.protocol[POLICY]})
    methods = []
    for run in runs:
        kind, digest = _policy(run)
        policy = kind if kinds[kind] == 1 else f"{kind} {digest[:HASH_DIGITS]}".strip()
        methods.append(run.method or (policy if run.protocol[POLICY] else run.name))
    # Where policies are unknown, or one has several results at the same interval, folders name the methods.
    results = Counter((method, run.replan_steps) for run, method in zip(runs, methods, strict=True))
    repeated = {method for (method, _), count in results.items() if count > 1}
    if ambiguous := {run.method for run in runs if run.method} & repeated:
        raise MemobenchError(
            f"two evaluations named {min(ambiguous)!r} have the same replan interval; give them names of their own"
        )
    methods = [run.name if method in repeated else method for run, method in zip(runs, methods, strict=True)]
    names = [
        run.name if not run.method else method if methods.count(method) == 1 else f"{method} k={run.replan_steps}"
        for run, method in zip(runs, methods, strict=True)
    ]
    return [replace(run, name=name, method=m) for run, name, m in zip(runs, names, methods, strict=True)]


def _policy(run: Run) -> tuple[str, str]:
    """Return type and hash of a run's policy, "" as far as they are unknown."""
    policy = run.protocol[POLICY]
    return str(policy.get("type") or "policy"), str(policy.get("sha256") or "")


def sweeps(runs: Sequence[Run]) -> dict[str, list[Run]]:
    """Return method -> its runs, by replan interval, of the methods that were evaluated at several intervals."""
    methods: dict[str, list[Run]] = {run.method: [] for run in runs}
    for run in sorted(runs, key=lambda run: run.replan_steps or 0):
        if run.replan_steps is not None:
            methods[run.method].append(run)
    return {name: group for name, group in methods.items() if len({run.replan_steps for run in group}) > 1}


# --- the first line of every report ---

OF_SCENES = ("difficulty", "rules", *IMAGE_SETTINGS)
CONTROLLED = ("pause_steps", "speed", *MEMORY_CONTROLS)
PROMPT_IN = {"steps": "prompt in steps (observed)", "reset": "prompt in reset (not observed)"}


def headline(runs: Sequence[Run]) -> str:
    """Return the first line of a report: policy, protocol and the policy's inputs of each evaluation."""
    if len(runs) == 1:
        (run,) = runs
        return f"{policy_name(run)}: {', '.join(protocol_phrases(run))}; {inputs_of(run)}"
    protocols = [", ".join(protocol_phrases(run)) for run in runs]
    alike = len(set(protocols)) == 1
    parts = [
        f"{run.name}: {policy_name(run)}, {inputs_of(run)}{'' if alike else f' ({protocol})'}"
        for run, protocol in zip(runs, protocols, strict=True)
    ]
    return "; ".join([f"{len(runs)} evaluations{f', {protocols[0]}' if alike else ''}", *parts])


def policy_name(run: Run) -> str:
    """Return the policy: its type and, where it is known, its checkpoint."""
    policy = run.protocol[POLICY]
    name = policy.get("type") or next((str(r["policy"]) for r in run.records if r.get("policy")), None)
    if name is None:
        return "policy not recorded"
    checkpoint = (run.card.get("checkpoint") or {}).get("path")
    if checkpoint is not None:
        return f"{name} ({cut(str(checkpoint))})"
    return str(name if "settings" in policy else policy.get("identity") or name)


def protocol_phrases(run: Run) -> list[str]:
    """Return suite, scenes, referent, seeds, episodes per task, replan interval and controls of an evaluation."""
    records, suites, protocol = run.records, ", ".join(run.suites), run.protocol
    own = run.card.get("settings", {}).get("env", {}).get("task_dir")
    unusual = {name: protocol[name] for name in protocol if protocol[name] != getattr(DEFAULTS, name, None)}
    missing, referents = stand_ins_of(records), sorted({str(record.get("referent", "fixed")) for record in records})
    intervals = sorted({steps for record in records if (steps := record.get("replan_steps")) is not None})
    return [
        f"own tasks, suite={suites}" if own else f"{suites} suite{'s' * (len(run.suites) > 1)}",
        *(f"{name} {unusual[name]}" for name in OF_SCENES if name in unusual),
        *[count_of(len(missing), "missing scan")] * bool(missing),
        *[f"referent {', '.join(referents)}"] * (run.suites[0] not in LIBERO_SUITES),
        *_seeds(run),
        extent_phrase(records),
        *["incomplete"] * (run.missing is not None),
        *[f"replan interval {', '.join(map(str, intervals))}"] * bool(intervals),
        *(f"{name}={str(unusual[name]).lower()}" for name in CONTROLLED if name in unusual),
        *[f"salt {protocol.get('salt')}"] * bool(protocol.get("salt")),
        *["each scene with each variant"] * bool(protocol.get("evidence")),
    ]


def _seeds(run: Run) -> list[str]:
    logged = {record["seed"] for record in run.records if record.get("seed") is not None}
    if not logged:
        return []
    first, last = min(logged), max(logged)
    seeds = f"seeds {first} to {last}" if len(logged) > 1 else f"seed {first}"
    name = split_of((first, last))
    return [seeds if name in (None, PAPER) else f"{seeds} ({name})"]


def extent_phrase(records: Sequence[Record]) -> str:
    """Return how many episodes there are of how many tasks, of a single one by its name."""
    counts = Counter(str(record["task"]) for record in records)
    low, high = min(counts.values()), max(counts.values())
    episodes = count_of(high, "episode") if low == high else f"{low} to {high} episodes"
    if len(counts) == 1:
        return f"{episodes} of {next(iter(counts))}"
    return f"{episodes} of each of {len(counts)} tasks"


def inputs_of(run: Run) -> str:
    """Return the policy's inputs and, where there was a demonstration prompt, whether the policy observed it."""
    inputs, prompt_in = f"inputs: {inputs_phrase(run.records)}", run.protocol.get("prompt_in")
    if run.protocol.get("demonstration_prompt") is False:
        return f"{inputs}, no demonstration prompt"
    prompted = any(r.get("prompt_steps") and r.get("prompt_shown", True) is not None for r in run.records)
    return f"{inputs}, {PROMPT_IN[prompt_in]}" if prompted and prompt_in in PROMPT_IN else inputs


# --- agreement of two records of the same episode ---

SCENES = "scene_hash"
OUTCOME = (
    *("seed", "success", "steps", "prompt_steps", "variant", "choice", "checkpoints", "failure", "fault", "not_run"),
    *("stand_ins", SCENES),
)
"""Fields in which two runs of the same episode must agree."""


def disagreement(
    a: Mapping[str, Any], b: Mapping[str, Any], here: str, there: str, ignore: Collection[str] = ()
) -> str | None:
    """Return a phrase for the first difference of two records of the same episode, None where they agree.

    Times, fields to ``ignore``, and fields that one of them lacks, do not count.
    """
    if ("not_run" in a) != ("not_run" in b):
        return f"{_name(a)} was not run {here if 'not_run' in a else there}"
    for name in OUTCOME:
        if name in ignore or name not in a or name not in b or a[name] == b[name]:
            continue
        values = [(name, a[name], b[name])]
        if name == "checkpoints" and len(a[name]) == len(b[name]):
            values = [
                (f"{key} of checkpoint {number}", checkpoint_a.get(key), checkpoint_b.get(key))
                for number, (checkpoint_a, checkpoint_b) in enumerate(zip(a[name], b[name], strict=True), start=1)
                for key in ("operation", "first_step", "ordered_step")
            ]
        for part, value_a, value_b in values:
            if value_a != value_b:
                return f"{_name(a)}: {part} is {value_a} {here} and {value_b} {there}"
    return None


def disagreements(
    a: Sequence[Mapping[str, Any]], b: Sequence[Mapping[str, Any]], here: str, there: str, ignore: Collection[str] = ()
) -> list[str]:
    """Return a phrase for each episode that differs between two logs, or that one of them lacks."""
    records_a, records_b = ({key_of(record): record for record in records} for records in (a, b))
    phrases: list[str | None] = []
    for key in sorted({*records_a, *records_b}):
        if key in records_a and key in records_b:
            phrases.append(disagreement(records_a[key], records_b[key], here, there, ignore))
        elif key in records_a:
            phrases.append(f"{_name(records_a[key])} is {here} and not {there}")
        else:
            phrases.append(f"{_name(records_b[key])} is {there} and not {here}")
    return [phrase for phrase in phrases if phrase is not None]


def _name(record: Mapping[str, Any]) -> str:
    return f"{record['task']}, episode {record['episode']}"
