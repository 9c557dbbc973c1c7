"""The first line of every report: policy, protocol, and inputs of the policy."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from lerobot_memobench.envs.episode_log import OMITTED, POLICY
from lerobot_memobench.envs.settings import MEMORY_CONTROLS, PICTURES
from lerobot_memobench.evaluation.metrics import Record, policy_inputs, stand_ins_of
from lerobot_memobench.evaluation.records import Run, of_all
from lerobot_memobench.io import count_of, cut
from lerobot_memobench.protocol import PAPER, SPLITS
from lerobot_memobench.sim.scene_hash import FORMER, WORLD
from lerobot_memobench.tasks.task import LIBERO_SUITES

CONTROLLED = ("pause_steps", "speed", *MEMORY_CONTROLS)
PROMPT_IN = {"steps": "prompt in steps (observed)", "reset": "prompt in reset (not observed)"}


def headline(runs: Sequence[Run]) -> str:
    """Return the first line of a report of one or several evaluations."""
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
    if checkpoint is None:
        identity = str(policy.get("identity") or name)
        return identity if identity.startswith(str(name)) else str(name)
    return f"{name} ({cut(str(checkpoint))})"


def protocol_phrases(run: Run) -> list[str]:
    """Return suite, scenes, referent, seeds, episodes per task, replan interval and controls of an evaluation."""
    records, suites = run.records, ", ".join(run.suites)
    return [
        f"own tasks, suite={suites}"
        if run.card.get("settings", {}).get("env", {}).get("task_dir")
        else f"{suites} suite{'s' * (len(run.suites) > 1)}",
        *(["scenes that version 0.2 modelled in code"] if of_all(records, WORLD) == FORMER else []),
        *(
            f"{key} {value}"
            for key in ("difficulty", "protocol", *PICTURES)
            if (value := of_all(records, key)) != OMITTED[key]
        ),
        *([count_of(len(missing), "missing scan")] if (missing := stand_ins_of(records)) else []),
        *([] if run.suites[0] in LIBERO_SUITES else [_referent(records)]),
        *_seeds(run),
        extent_phrase(records),
        *([] if run.missing is None else ["incomplete"]),
        *_replan(records),
        *(
            f"{name}={str(run.protocol[name]).lower()}"
            for name in CONTROLLED
            if run.protocol.get(name, OMITTED[name]) != OMITTED[name]
        ),
        *([f"salt {salt}"] if (salt := run.protocol.get("salt")) else []),
        *(["each scene with each variant"] if run.protocol.get("evidence") else []),
    ]


def _referent(records: Sequence[Record]) -> str:
    return f"referent {', '.join(sorted({str(record.get('referent', 'fixed')) for record in records}))}"


def _seeds(run: Run) -> list[str]:
    """Return the seeds, and the split that they are of where it is not the paper's."""
    found = sorted({record["seed"] for record in run.records if record.get("seed") is not None})
    if not found:
        return []
    seeds = f"seeds {found[0]} to {found[-1]}" if len(found) > 1 else f"seed {found[0]}"
    name = next((name for name, split in SPLITS.items() if found[0] in split and found[-1] in split), PAPER)
    return [seeds if name == PAPER else f"{seeds} ({name})"]


def extent_phrase(records: Sequence[Record]) -> str:
    """Return how many episodes there are of how many tasks, of a single one by its name."""
    counts: dict[str, int] = {}
    for record in records:
        counts[record["task"]] = counts.get(record["task"], 0) + 1
    low, high = min(counts.values()), max(counts.values())
    episodes = count_of(high, "episode") if low == high else f"{low} to {high} episodes"
    if len(counts) == 1:
        return f"{episodes} of {next(iter(counts))}"
    return f"{episodes} of each of {len(counts)} tasks"


def _replan(records: Sequence[Record]) -> list[str]:
    found = sorted({record["replan_steps"] for record in records if record.get("replan_steps") is not None})
    return [f"replan interval {', '.join(map(str, found))}"] if found else []


def inputs_of(run: Run) -> str:
    """Return the policy's inputs and, where there was a demonstration prompt, whether the policy observed it."""
    return ", ".join([f"inputs: {policy_inputs(run.records)}", *_prompt(run.records, run.protocol)])


def _prompt(records: Sequence[Record], protocol: Mapping[str, Any]) -> list[str]:
    if protocol.get("demonstration_prompt") is False:
        return ["no demonstration prompt"]
    if not any(record.get("prompt_steps") and record.get("prompt_shown", True) is not None for record in records):
        return []
    prompt_in = protocol.get("prompt_in")
    return [PROMPT_IN[prompt_in]] if prompt_in in PROMPT_IN else []
