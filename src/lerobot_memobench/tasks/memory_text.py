"""The oracle memory of the paper: what a perfect memory would say, as text.

It is rendered from the checkpoints that were really completed ("realized checkpoint annotations", section Oracle
Memory Decomposition), at the intermediate level. The dataset's column ``memory``, the environment's prompt and the
policy's training prompt all come from these two functions, so a policy is evaluated on the words it was trained on.
"""

from __future__ import annotations

from lerobot_memobench.tasks.task import DEFAULT_LEVEL, Task

SEPARATOR = "; "
MARK = " Memory: "
"""What stands between the instruction and the memory in a prompt."""
NOTHING_YET = "nothing yet"


def memory_text(task: Task, completed: int) -> str:
    """Return the texts of the first ``completed`` checkpoints of a task, joined; empty for none."""
    return SEPARATOR.join(checkpoint.language[DEFAULT_LEVEL] for checkpoint in task.checkpoints[:completed])


def with_memory(instruction: str, memory: str) -> str:
    """Return an instruction with a memory text behind it, as the oracle control prompts a policy."""
    return f"{instruction}{MARK}{memory or NOTHING_YET}"
