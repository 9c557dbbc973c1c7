"""Rules of the board that an honest evaluation may break: settings, extent, versions, control, sealed seeds, mark.

`check_evaluation` and `check_control` need the evaluation's own files only.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from importlib import metadata
from typing import Any

from packaging.requirements import Requirement
from packaging.specifiers import SpecifierSet
from packaging.version import InvalidVersion, Version

from lerobot_memobench.board.submission import PAUSES, About
from lerobot_memobench.constants import EVALUATION_EPISODES, EVIDENCE_EPISODES, MEMORY_POLICY, PAPER, SEALED, SPLITS
from lerobot_memobench.datasets.generate import task_hash
from lerobot_memobench.envs.evaluation_file import INPUTS, OF_ONE_EVALUATION, POLICY, differences
from lerobot_memobench.envs.settings import EnvSettings
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.evaluation.records import Run
from lerobot_memobench.rollouts.card import PACKAGES
from lerobot_memobench.rollouts.plan import SCRIPTED
from lerobot_memobench.tasks.catalogue import get_task, task_names
from lerobot_memobench.tasks.task import PUBLISHED, STRICT

FEWEST, MOST = 10, EVALUATION_EPISODES
"""Episodes of each task, without evidence."""
SEEDS = {SPLITS[name].start: name for name in (PAPER, SEALED)}
"""Seed of the first episode -> split of seeds that count."""
MAY_DIFFER = {
    *("suite", "seed_base", "obs_type", "convention", "referent", "demonstration_prompt", "replan_steps", "evidence"),
    *OF_ONE_EVALUATION,
} - {INPUTS}
"""Settings of the protocol that a submission may choose; all others have their defaults."""
LONGEST_PLAN = 200
"""Largest number of steps of input window, delay and executed plan together. With longer ones the holds of strict tasks
have more equal lengths, from which a policy with a clock profits."""
CONTROL_SETTING: Mapping[str, Mapping[str, Any]] = {PAUSES: {"pause_steps": 100}}
REQUIRED = {
    each.name: each.specifier for each in map(Requirement, metadata.requires(PACKAGES[0]) or ()) if not each.marker
}
"""Package -> its versions under which this package runs."""


def check_evaluation(run: Run, *, part: bool = False, control: str = "") -> None:
    """Check an evaluation, or a ``control`` of `CONTROL_SETTING`; the error names the first rule that it breaks.

    Of a ``part``, any tasks of the suite, and any number of their episodes, are enough.
    """
    _check_settings(run, **CONTROL_SETTING.get(control, {}))
    names = run.protocol["tasks"] if part else task_names(suite=run.protocol["suite"])
    _check_extent(run, names, 1 if part else FEWEST)
    _check_versions(run, names)
    if (SEEDS[run.protocol["seed_base"]] == SEALED) != bool(run.protocol["salt"]):
        raise MemobenchError(
            f"{run.folder} has the salt {run.protocol['salt']}; expected a salt with the sealed seeds, and none with "
            "others: evaluate them by `memobench test-sealed`"
        )


def supervised_with_answer(run: Run, about: About) -> bool | None:
    """Return whether texts that name the hidden answer supervised a policy in training, None for a script.

    The configuration of `memobench_mem` on the card holds it; for another policy, the submitter states it.
    """
    policy = run.card[POLICY]
    if policy.get("type") in SCRIPTED:
        return None
    marked = stated = about.supervised_with_answer
    if policy.get("type") == MEMORY_POLICY:
        marked = policy.get("settings", {}).get("supervised_with_answer")
    if isinstance(marked, bool) and stated not in (None, marked):
        raise MemobenchError(
            f"{run.folder}: the policy has supervised_with_answer={marked}, and {stated} is stated; leave the option "
            f"of `memobench submit` out for {MEMORY_POLICY}"
        )
    if not isinstance(marked, bool):
        raise MemobenchError(
            f"{run.folder}: found no statement whether the policy was supervised with the answer; expected the setting "
            f"supervised_with_answer of {MEMORY_POLICY} on the card, as this version writes it, and of another policy "
            "`memobench submit --supervised-with-answer` or `--no-supervised-with-answer`"
        )
    return marked


def check_control(run: Run, control: Run, name: str, *, part: bool = False) -> None:
    """Check an evaluation under a control as `check_evaluation` does, and that policy and settings are the same."""
    check_evaluation(control, part=part, control=name)
    facts, others = _policy_facts(run), _policy_facts(control)
    for key in facts:
        if facts[key] != others[key]:
            raise MemobenchError(f"{control.folder} is of another policy ({key} differs); evaluate the same checkpoint")
    if unlike := differences(run.protocol, control.protocol, ignore={*CONTROL_SETTING[name], "salt"}):
        raise MemobenchError(
            f"{run.folder} and {control.folder} differ in {unlike[0]}; evaluate with the same settings"
        )


def _policy_facts(run: Run) -> dict[str, Any]:
    policy = run.card[POLICY]
    facts = {key: policy.get(key) for key in ("type", "identity", "sha256", "detector_sha256", "settings")}
    # Of equal hashes the place may differ.
    return facts | {"checkpoint": None if facts["sha256"] else run.card.get("checkpoint")}


def _check_settings(run: Run, **control: Any) -> None:
    protocol = run.protocol
    if protocol["suite"] not in (PUBLISHED, STRICT):
        raise MemobenchError(
            f"{run.folder}: found suite={protocol['suite']}; the board is of memory tasks, published or strict"
        )
    try:
        board = EnvSettings(**{key: protocol[key] for key in MAY_DIFFER if key in protocol}, **control)
    except MemobenchError as error:
        raise MemobenchError(f"{run.folder}: {error}") from None
    fixed = {key: value for key, value in board.protocol_block.items() if key not in MAY_DIFFER}
    if missing := sorted({*fixed, *MAY_DIFFER} - {*protocol}):
        raise MemobenchError(
            f"{run.folder}: the card's protocol lacks {', '.join(missing)}; submit a card of `lerobot eval`"
        )
    if unlike := differences(protocol, fixed, ignore=MAY_DIFFER):
        raise MemobenchError(f"{run.folder}: {unlike[0]} on the board; evaluate with the value of the board")
    plan = protocol["window_steps"] + protocol["delay_steps"] + (protocol["replan_steps"] or 1)
    if plan > LONGEST_PLAN:
        raise MemobenchError(
            f"{run.folder}: window_steps, delay_steps and replan_steps are {plan} together; expected at most "
            f"{LONGEST_PLAN}: execute fewer actions of each plan"
        )


def _check_extent(run: Run, names: Sequence[str], fewest: int) -> None:
    """Check that the log holds each episode of each task once, from the first seed of a split on."""
    protocol, seed = run.protocol, run.card[POLICY].get("seed")
    count, base, most = protocol["episodes"], protocol["seed_base"], MOST
    if protocol["evidence"]:  # whole scenes
        fewest, most = max((len(get_task(name).random_variants) for name in names), default=1), EVIDENCE_EPISODES
    if base not in list(SEEDS) or seed != base:
        raise MemobenchError(
            f"{run.folder}: the first episode has the seed {seed}; expected {' or '.join(map(str, SEEDS))}, the first "
            "of the seeds that count"
        )
    if not fewest <= count <= most or sorted(protocol["tasks"]) != sorted(names):
        raise MemobenchError(
            f"{run.folder}: the protocol has {count} episodes of {len({*names}.intersection(protocol['tasks']))} of "
            f"{len(names)} tasks; expected {fewest} to {most} episodes of each"
        )
    requested = set(itertools.product(names, range(count)))
    logged = {(record["task"], record["episode"]) for record in run.records if "not_run" not in record}
    for task, episode in sorted(requested ^ logged)[:1]:
        problem = "is missing in the log" if (task, episode) in requested else "is not part of the protocol"
        raise MemobenchError(
            f"{run.folder}: {task[:80]}, episode {episode}, {problem}; expected {count} rollouts of each of the "
            f"{len(names)} tasks"
        )


def _check_versions(run: Run, names: Sequence[str]) -> None:
    for package in PACKAGES[:3]:  # this one, LeRobot and MuJoCo
        versions = {str(start["versions"].get(package)) for start in run.card["runs"]}
        if len(versions) > 1:
            raise MemobenchError(
                f"{run.folder}: its parts ran under {package} {' and '.join(sorted(versions))}; evaluate again with "
                "one version"
            )
        (version,) = versions
        try:
            Version(version)  # also of this package, which requires none of its own
            fits = REQUIRED.get(package, SpecifierSet()).contains(version, prereleases=True)
        except InvalidVersion:
            fits = False
        if not fits:
            raise MemobenchError(
                f"{run.folder}: the card names {package} {version[:20]}; expected {package}{REQUIRED.get(package, '')}"
            )
    for name in names:
        here, stored = task_hash(get_task(name)), run.card["task_files"].get(name)
        if here != stored:
            raise MemobenchError(
                f"{run.folder}: the files of {name} have the hash {str(stored)[:16]} on the card and {here} in this "
                "version; evaluate with this version"
            )
