"""What needs no training: chance, the commonest subgoal, the frozen tower's tokens, and random weights."""

from __future__ import annotations

from typing import Any

import torch

from lerobot_memobench.policies.memobench_mem.modeling_memobench_mem import MemobenchMemPolicy
from lerobot_memobench.studies.alignment.measures import Measures
from lerobot_memobench.studies.alignment.questions import Questions


@torch.no_grad()
def measure_baselines(measures: Measures, untrained: MemobenchMemPolicy) -> dict[str, Any]:
    """Return the scores of every baseline; ``untrained`` is a policy with random weights."""
    questions = measures.questions
    found = guesses(questions)
    fit, test = measures.tower(questions.fit), measures.tower(questions.test)
    for name, of_fit, of_test in zip(("tower_history", "tower_last_frame"), fit, test, strict=True):
        found[name] = measures.readout(of_fit, of_test)
    before, after = measures.vectors(untrained, questions.fit), measures.vectors(untrained, questions.test)
    for name in ("memory", "last_frame"):
        found[f"untrained_{name}"] = measures.readout(before[name], after[name])
    return found


def guesses(questions: Questions) -> dict[str, Any]:
    """Return what is right without looking: at random, and by the commonest subgoal of the training episodes."""
    test, count = questions.test, len(questions.candidates)
    common = torch.bincount(questions.fit.labels, minlength=count)
    in_task = torch.where(test.allowed, common, -1)
    return {
        "chance": {"all": 1.0 / count, "own_task": float((1.0 / test.allowed.sum(dim=1)).mean())},
        "commonest": {
            "all": float((test.labels == common.argmax()).double().mean()),
            "own_task": float((test.labels == in_task.argmax(dim=1)).double().mean()),
        },
    }
