"""The first line of every report: policy, protocol, and inputs of the policy."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

from lerobot_memobench.constants import PAPER, SPLITS
from lerobot_memobench.envs.evaluation_file import POLICY
from lerobot_memobench.envs.settings import DEFAULTS, IMAGE_SETTINGS, MEMORY_CONTROLS
from lerobot_memobench.errors import count_of, cut
from lerobot_memobench.evaluation.metrics import Record, inputs_phrase, stand_ins_of
from lerobot_memobench.evaluation.records import Run
from lerobot_memobench.tasks.task import LIBERO_SUITES

OF_SCENES = ("difficulty", "rules", *IMAGE_SETTINGS)
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
    name = next((name for name, split in SPLITS.items() if first in split and last in split), PAPER)
    return [seeds if name == PAPER else f"{seeds} ({name})"]


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
