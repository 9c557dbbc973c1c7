"""Environments with the threads of our rule, and with the libraries' own, to measure the rule."""

from __future__ import annotations

import os

from lerobot_memobench.jobs.threads import CHOSEN_HERE, ONE_EACH, PROCESSES, SPINNING, TORCH, cores, physical_cores


def by_the_libraries() -> dict[str, str]:
    """Return this process's environment with the libraries' own threads: one on every
    core.
    """
    threads = dict.fromkeys(ONE_EACH, str(cores())) | {TORCH: str(physical_cores())}
    return {key: value for key, value in os.environ.items() if key != CHOSEN_HERE} | SPINNING | threads


def by_the_rule() -> dict[str, str]:
    """Return this process's environment by the rule for one that acts, without a user's own values."""
    chosen = {**ONE_EACH, **SPINNING, TORCH: "1"}
    kept = {key: value for key, value in os.environ.items() if key not in (PROCESSES, "OMP_WAIT_POLICY")}
    return {**kept, **chosen, CHOSEN_HERE: ",".join(chosen)}
