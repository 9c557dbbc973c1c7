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
    for _ in range(rng.randint(1, 4)):
        start = rng.randrange(len(text) + 1)
        end = min(len(text), start + rng.choice([0, 1, 1, 2, 5, 20, 200]))
        kind = rng.randrange(5)
        if kind == 0:  # cut
            text = text[:start] + text[end:]
        elif kind == 1:  # put in
            text = text[:start] + rng.choice(PIECES) + text[start:]
        elif kind == 2:  # say twice
            text = text[:end] + text[start:end] + text[end:]
        elif kind == 3:  # exchange two words
            words = text.split(" ")
            i, j = rng.randrange(len(words)), rng.randrange(len(words))
            words[i], words[j] = words[j], words[i]
            text = " ".join(words)
        else:  # break off
            text = (
                text[:start]
                if rng.random() < 0.2
                else text[:start] + text[start : start + 1].swapcase() + text[start + 1 :]
            )
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


def test_mutated_files(write_task: Callable[..., Path]) -> None:
    loaded, refused = check(300, 0, write_task)
    assert loaded > 20
    assert refused > 100


@pytest.mark.slow
def test_mutated_files_many(write_task: Callable[..., Path]) -> None:
    loaded, refused = check(2000, 1, write_task)
    assert loaded > 100
    assert refused > 600
