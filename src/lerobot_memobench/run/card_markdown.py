"""The result card as a page for people."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from lerobot_memobench.envs.episode_log import EXTENT, SETTINGS
from lerobot_memobench.evaluation.records.protocol import CARD_FILE


def markdown(card: Mapping[str, Any]) -> str:
    """Return the card as Markdown."""
    lines = ["# Result card", "", *_protocol(card), "", *_policy(card)]
    for number, run in enumerate(card["runs"], start=1):
        lines += ["", *_run(number, run)]
    lines += ["", f"`memobench rerun {CARD_FILE}` repeats the evaluation and compares every episode.", ""]
    return "\n".join(lines)


def _protocol(card: Mapping[str, Any]) -> list[str]:
    protocol = card["protocol"]
    tasks = protocol.get("tasks", [])
    settings = {name: protocol[name] for name in SETTINGS if name in protocol}
    others = {key: value for key, value in protocol.items() if key not in (*SETTINGS, *EXTENT)}
    return [
        *("| protocol | |", "|---|---|"),
        f"| tasks | {len(tasks)}: {', '.join(tasks)} |",
        f"| episodes of each | {protocol.get('episodes')} |",
        *(f"| {name.replace('_', ' ')} | {value} |" for name, value in {**settings, **others}.items()),
        f"| episodes in the log | {len(card['episodes'])} |",
    ]


def _policy(card: Mapping[str, Any]) -> list[str]:
    policy = card["policy"]
    lines = ["| policy | |", "|---|---|"]
    lines += [f"| type | {policy.get('type', 'not known')} |", f"| seed | {policy.get('seed')} |"]
    if card["checkpoint"]:
        lines += [f"| checkpoint | {card['checkpoint']['path']} |"]
        lines += [f"| its sha256 | {policy.get('sha256', 'not known')} |"]
    if "eyes_sha256" in policy:
        lines += [f"| sha256 of its eyes | {policy['eyes_sha256']} |"]
    return lines + [f"| trained on: {key} | {value} |" for key, value in (card["trained_on"] or {}).items()]


def _run(number: int, run: Mapping[str, Any]) -> list[str]:
    times = run.get("times", 1)
    lines = [f"## Run {number}" + (f" (started {times} times)" if times > 1 else ""), ""]
    lines += ["```", " ".join(run["command"]), "```", "", "| | |", "|---|---|"]
    lines += [f"| {name} | {version} |" for name, version in run["versions"].items()]
    lines += [f"| commit | {run['git_commit']} |", f"| batch size | {run['batch_size']} |"]
    lines += [f"| {name} | {value} |" for name, value in run["machine"].items()]
    return lines + [f"| {name} | {value} |" for name, value in run["gl"].items()]
