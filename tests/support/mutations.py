"""Damage to files, drawn from a seed: bytes, values and the file itself; and what a command may answer to it.

A file that somebody edited, cut off, copied wrongly or wrote with another tool ends in a result or in one sentence.
"""

from __future__ import annotations

import copy
import json
import random
import shutil
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

from lerobot_memobench.errors import MemobenchError

PIECES = (
    *(piece.encode() for piece in '()[]{}",:;-$%&#_^~\\/ \n\t\x00é😀'),
    *(b"0", b"-1", b"NaN", b"1e999", b"null", b"true", b"[]", b"{}"),
    *(b"\xff\xfe", b"\xef\xbb\xbf", b"\\ud800", b"9" * 400),
)

VALUES: tuple[Any, ...] = (
    *(None, True, False, 0, 1, -1, 7, 2**31, 2**53, 2**64, 10**400, 0.5, -0.0, 1e308, float("nan"), float("inf")),
    *("", "0", "S", "fixed", "temporal", "a b", "../../outside", "/tmp/outside", "..", ".", "\x00", "\n\n", "é😀"),
    *("a" * 5_000, "[/b] [red]", "$x^{$", "<script>", r"\textbf{", "{0}", "%s", "\ud800", "--flag", "a=b"),
    *([], {}, [[]], [None], [0], ["a"], {"a": 1}, {"": None}, [1, "a", None, [], {}]),
)

LONGEST_SENTENCE = 4_000
"""Characters; some messages repeat names of up to 255, and paths."""


def nested(depth: int) -> list[Any]:
    value: list[Any] = []
    for _ in range(depth):
        value = [value]
    return value


# --- values ---


def places(value: Any, path: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """Yield the path to a JSON value and to every value in it."""
    yield path
    if isinstance(value, dict | list):
        for key, item in value.items() if isinstance(value, dict) else enumerate(value):
            yield from places(item, (*path, key))


def mutated_value(value: Any, rng: random.Random) -> Any:
    """Return a JSON value with one of its parts exchanged, taken out, put in, named otherwise or said twice."""
    value = copy.deepcopy(value)
    path = rng.choice(list(places(value)))
    if not path:
        return rng.choice(VALUES) if rng.random() < 0.2 else _altered(value, rng)
    *way, last = path
    parent = value
    for key in way:
        parent = parent[key]
    kind = rng.randrange(8)
    if kind < 4:
        parent[last] = copy.deepcopy(rng.choice(VALUES)) if kind else nested(rng.choice((3, 150, 400)))
    elif kind == 4:
        del parent[last]
    elif kind == 5:
        parent[last] = _altered(parent[last], rng)
    elif isinstance(parent, list):
        parent.insert(last, copy.deepcopy(rng.choice([*parent, *VALUES])))
    elif kind == 6:
        parent[rng.choice(["", "a", last + last, last.upper(), "../x", *parent])] = parent.pop(last)
    else:
        parent[last] = copy.deepcopy(rng.choice(list(parent.values())))
    return value


def _altered(value: Any, rng: random.Random) -> Any:
    """Return what is nearly the value: the same in another type, or another number."""
    if isinstance(value, bool):
        return rng.choice([int(value), not value, str(value)])
    if isinstance(value, int | float):
        return rng.choice([str(value), float(value), -value, value + 1, value * 10**6, [value]])
    if isinstance(value, str):
        return rng.choice([[value], {"a": value}, value[:-1], value + "/", value * 100, None, len(value)])
    if isinstance(value, list):
        return rng.choice([dict(enumerate(value)), value * 2, value[:-1], value[::-1], [value]])
    if isinstance(value, dict):
        return rng.choice([list(value.values()), {**value, "another": rng.choice(VALUES)}, [value], {}])
    return rng.choice(VALUES)


# --- bytes ---


def mutated_bytes(content: bytes, rng: random.Random) -> bytes:
    """Return content that was cut, broken off, put together wrongly, or hit by single bytes."""
    for _ in range(rng.randint(1, 4)):
        start = rng.randrange(len(content) + 1)
        end = min(len(content), start + rng.choice([0, 1, 1, 2, 5, 20, 200]))
        kind = rng.randrange(6)
        if kind == 0:
            content = content[:start] + content[end:]
        elif kind == 1:
            content = content[:start] + rng.choice(PIECES) + content[start:]
        elif kind == 2:
            content = content[:end] + content[start:end] + content[end:]
        elif kind == 3:
            content = content[:start] + bytes(rng.randrange(256) for _ in range(end - start)) + content[end:]
        elif kind == 4:
            digits = [k for k in range(len(content)) if content[k : k + 1].isdigit()]
            at = rng.choice(digits) if digits else 0
            content = content[:at] + rng.choice([b"", b"-1", b"99999", b'"a"', b"1.5"]) + content[at + 1 :]
        elif rng.random() < 0.3:
            content = content[:start]
    return content


def mutated_json(content: bytes, rng: random.Random) -> bytes:
    """Return the text of a JSON file, or of one with a value a line, after a mutation of its values or its bytes."""
    if rng.random() < 0.3:
        return mutated_bytes(content, rng)
    try:
        return json.dumps(mutated_value(json.loads(content), rng), indent=rng.choice([None, 1])).encode()
    except ValueError:
        lines = content.splitlines()
        k = rng.randrange(len(lines))
        lines[k] = json.dumps(mutated_value(json.loads(lines[k]), rng)).encode()
        return b"\n".join(lines) + b"\n"


# --- files ---


def damage(path: Path, rng: random.Random, mutate: Callable[[bytes, random.Random], bytes] = mutated_json) -> None:
    """Mutate a file's content; now and then it is empty, gone, or a folder."""
    kind = rng.random()
    if kind < 0.01:
        path.write_bytes(b"")
    elif kind < 0.02:
        path.unlink()
    elif kind < 0.03:
        path.unlink()
        path.mkdir()
    else:
        path.write_bytes(mutate(path.read_bytes(), rng))


def ends_well(
    seeds: Sequence[int],
    prepare: Callable[[random.Random], None],
    command: Callable[[random.Random], object],
    whole: Path,
    inside: Sequence[str],
) -> Counter[str]:
    """Run a command on one damaged state after the other; return how often it gave a result and how often it refused.

    Args:
        prepare: makes the state anew and damages it. command: may raise nothing but a `MemobenchError`.
        whole: folder below which only the entries ``inside`` may be there afterwards.

    Raises:
        AssertionError: anything else came out, named with the seed that brings it about.
    """
    found: Counter[str] = Counter()
    for seed in seeds:
        rng = random.Random(seed)
        prepare(rng)
        said = ""
        try:
            command(rng)
        except MemobenchError as error:
            said = str(error)
        except Exception as error:
            raise AssertionError(f"seed {seed}: {type(error).__name__}: {error}") from error
        found["refused" if said else "result"] += 1
        assert len(said) < LONGEST_SENTENCE, f"seed {seed}: a message of {len(said)} characters: {said[:300]}"
        strangers = {path.name for path in whole.iterdir()} - set(inside)
        assert not strangers, f"seed {seed}: {strangers} were written elsewhere"
    return found


def fresh_copy(source: Path, target: Path) -> None:
    """Put a folder as it was in the place of what a command made of it; it stays itself, as a process's own must."""
    for path in target.iterdir():
        shutil.rmtree(path) if path.is_dir() and not path.is_symlink() else path.unlink()
    shutil.copytree(source, target, dirs_exist_ok=True)
