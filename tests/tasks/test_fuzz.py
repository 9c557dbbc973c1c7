"""Mutated task files either load or raise MemobenchError with one sentence; nothing else comes out."""

from __future__ import annotations

import random
from collections.abc import Callable
from pathlib import Path

import pytest

from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.tasks.catalogue import get_task, load_task, task_names
from lerobot_memobench.tasks.progress import Progress

PIECES = [
    *'()[]{}",:;- \n\t\x00é😀',
    *("0", "-1", "nan", "1e999", "(And)", "(Not", ":goal", "- -", "null", "true", "[]", "{}"),
]


def mutate(text: str, rng: random.Random) -> str:
    """Return a text with one to four random edits."""
    for _ in range(rng.randint(1, 4)):
        start = rng.randrange(len(text) + 1)
        end = min(len(text), start + rng.choice([0, 1, 1, 2, 5, 20, 200]))
        before, part, after = text[:start], text[start:end], text[end:]
        edits = (before + after, before + rng.choice(PIECES) + part + after, before + 2 * part + after,
                 before + part.swapcase() + after, before if rng.random() < 0.2 else text)  # fmt: skip
        text = rng.choice(edits)
        words = text.split(" ")
        i, j = rng.randrange(len(words)), rng.randrange(len(words))
        if rng.random() < 0.2:
            words[i], words[j] = words[j], words[i]
        text = " ".join(words)
    return text


def use(folder: Path) -> str | None:
    """Load a folder and evaluate its variants; return the message if it is refused."""
    try:
        task = load_task(folder)
        for k in range(task.num_variants):
            Progress(task.variant(k)).step(lambda atom: True)
    except MemobenchError as error:
        return str(error)
    return None


def check(count: int, seed: int, write_task: Callable[..., Path]) -> tuple[int, int]:
    rng = random.Random(seed)
    names = task_names()
    loaded = refused = 0
    for _ in range(count):
        task = get_task(rng.choice(names))
        bddl = task.bddl_text
        metadata = (task.folder / "task_config.meta.json").read_text()
        if rng.random() < 0.5:
            bddl = mutate(bddl, rng)
        else:
            metadata = mutate(metadata, rng)
        folder = write_task(bddl, metadata)
        message = use(folder)
        loaded, refused = loaded + (message is None), refused + (message is not None)
        if message is not None:
            assert "\n" not in message
            assert str(folder) in message
    return loaded, refused


@pytest.mark.parametrize(("count", "seed"), [(200, 0), pytest.param(2000, 1, marks=pytest.mark.slow)])
def test_mutated_files(count: int, seed: int, write_task: Callable[..., Path]) -> None:
    loaded, refused = check(count, seed, write_task)
    assert loaded > count / 20
    assert refused > count / 4
