"""The oracle memory of the paper: what a perfect memory would say, as text.

It is rendered from the checkpoints that were really completed ("realized checkpoint annotations", section Oracle
Memory Decomposition), at the intermediate level. The dataset's column ``memory``, the environment's prompt and the
policy's training prompt all come from these two functions, so a policy is evaluated on the words it was trained on.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from itertools import pairwise

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


IMPERATIVES = {
    "brought": "bring",
    "came": "come",
    "dropped": "drop",
    "laid": "lay",
    "moved": "move",
    "parked": "park",
    "pulled": "pull",
    "pushed": "push",
    "put": "put",
    "set": "set",
    "shut": "shut",
    "stowed": "stow",
    "switched": "switch",
    "swung": "swing",
    "threw": "throw",
    "took": "take",
}
"""Past tense of the catalogue's checkpoint texts -> the imperative of an instruction."""

_VERB = re.compile(r"(?:^|(?<= and )|(?<= then ))(" + "|".join(IMPERATIVES) + r")\b")
_TIMES = {"once": "first", "twice": "second", "three times": "third"}
_LEFT = (
    (r"switched (.*) on and (?:then )?off again", r"switch \1 off again"),
    (r"swung (.*) open and shut it again", r"shut \1 again"),
    (r"pulled (.*) out and pushed it shut", r"push \1 shut again"),
)
"""What is done in two halves -> its second half."""
_SUMS = (
    (r".*, (?:once|twice|three times) in all, and came to rest", "come to rest"),
    (r"(brought the hand home) after the one time", r"\1"),
    (r"pulled out and shut the top, middle and bottom drawer", "pull out and shut the bottom drawer"),
    (r"pulled out and shut .* and the (\w+) drawer, each once", r"pull out and shut the \1 drawer"),
)
"""Texts that sum up what the checkpoints before them have said already -> what of them is left to do."""


def subtask_texts(task: Task) -> list[str]:
    """Return what is to be done for each checkpoint of a task, as an instruction; the instruction of a task without.

    "switched the stove on" becomes "switch the stove on", and "switched the stove on and then off again" after it
    "switch the stove off again". Verbs that the catalogue does not use stay as they are.
    """
    texts = [checkpoint.language[DEFAULT_LEVEL] for checkpoint in task.checkpoints]
    return [_subtask(text, before) for before, text in pairwise(["", *texts])] or [task.language]


def _subtask(text: str, before: str) -> str:
    """Return a checkpoint's text as an instruction, where the text of the one before it has come true."""
    counted = re.fullmatch(r"(.*), (once|twice|three times) by now", text)
    whole = counted[1] if counted else text
    begun = re.sub(r" for the \w+ time$", "", before)
    if begun and whole.startswith(f"{begun} and "):
        text = _first(_LEFT, whole)
    elif counted:
        text = f"{whole} for the {_TIMES[counted[2]]} time"
    return _VERB.sub(lambda found: IMPERATIVES[found[1]], _first(_SUMS, text))


def _first(patterns: Sequence[tuple[str, str]], text: str) -> str:
    """Return what the first pattern that fits makes of a text."""
    for pattern, left in patterns:
        found = re.fullmatch(pattern, text)
        if found:
            return found.expand(left)
    return text
