"""Render the paper's oracle memory as text.

The text lists the completed checkpoints ("realized checkpoint annotations", section Oracle Memory Decomposition) at the
intermediate level. The dataset column ``memory``, the environment's prompt and the policy's training prompt use the
same two functions, so that training and evaluation texts are equal.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from itertools import pairwise

from lerobot_memobench.tasks.task import DEFAULT_LEVEL, Task

SEPARATOR = "; "
MARK = " Memory: "  # separator between instruction and memory text in a prompt
NOTHING_YET = "nothing yet"


def memory_text(task: Task, completed: int) -> str:
    """Return the joined texts of the first ``completed`` checkpoints; empty for 0."""
    return SEPARATOR.join(checkpoint.language[DEFAULT_LEVEL] for checkpoint in task.checkpoints[:completed])


def with_memory(instruction: str, memory: str) -> str:
    """Return an instruction followed by a memory text, the prompt of the oracle control."""
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
"""Past tense in the catalogue's checkpoint texts -> imperative."""

_VERB = re.compile(r"(?:^|(?<= and )|(?<= then ))(" + "|".join(IMPERATIVES) + r")\b")
_TIMES = {"once": "first", "twice": "second", "three times": "third"}
_LEFT = (
    (r"switched (.*) on and (?:then )?off again", r"switch \1 off again"),
    (r"swung (.*) open and shut it again", r"shut \1 again"),
    (r"pulled (.*) out and pushed it shut", r"push \1 shut again"),
)
"""Text of a two-part event -> instruction for its second part."""
_SUMS = (
    (r".*, (?:once|twice|three times) in all, and came to rest", "come to rest"),
    (r"(brought the hand home) after the one time", r"\1"),
    (r"pulled out and shut the top, middle and bottom drawer", "pull out and shut the bottom drawer"),
    (r"pulled out and shut .* and the (\w+) drawer, each once", r"pull out and shut the \1 drawer"),
)
"""Text that summarises earlier checkpoints -> instruction for the remaining part."""


def subtask_texts(task: Task) -> list[str]:
    """Return one instruction per checkpoint; the task's instruction if it has no checkpoints.

    "switched the stove on" becomes "switch the stove on"; the following "switched the stove on and then off again"
    becomes "switch the stove off again". Verbs missing from `IMPERATIVES` are unchanged.
    """
    texts = [checkpoint.language[DEFAULT_LEVEL] for checkpoint in task.checkpoints]
    return [_subtask(text, before) for before, text in pairwise(["", *texts])] or [task.language]


def _subtask(text: str, before: str) -> str:
    """Return a checkpoint's text as an instruction, given the text of the completed checkpoint before it."""
    counted = re.fullmatch(r"(.*), (once|twice|three times) by now", text)
    whole = counted[1] if counted else text
    begun = re.sub(r" for the \w+ time$", "", before)
    if begun and whole.startswith(f"{begun} and "):
        text = _expand_first_match(_LEFT, whole)
    elif counted:
        text = f"{whole} for the {_TIMES[counted[2]]} time"
    return _VERB.sub(lambda match: IMPERATIVES[match[1]], _expand_first_match(_SUMS, text))


def _expand_first_match(patterns: Sequence[tuple[str, str]], text: str) -> str:
    for pattern, template in patterns:
        match = re.fullmatch(pattern, text)
        if match:
            return match.expand(template)
    return text
