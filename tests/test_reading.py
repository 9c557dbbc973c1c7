"""Files are held against a type where they are read; the first place that differs is told in one sentence."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Annotated, Any, NotRequired, TypedDict

import pytest
from pydantic import AfterValidator

from lerobot_memobench.datasets.episodes import from_frames
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.io import Count, Malformed, Name, Number, checked, parsed, read_json, refusing


class Part(TypedDict):
    name: Name
    size: NotRequired[Count | list[Count] | None]


class Whole(TypedDict):
    parts: list[Part]
    share: Number


GOOD: dict[str, Any] = {"parts": [{"name": "a", "size": 1, "other": "kept"}, {"name": "b", "size": [1, 2]}], "share": 1}


def test_what_fits_is_the_value_itself() -> None:
    """Nothing is converted, taken out or put in."""
    assert checked(GOOD, Whole) is GOOD


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"share": "1"}, "found share = '1', expected a number"),
        ({"share": True}, "found share = True, expected a number"),
        ({"share": 1e300}, "found share = 1e+300, expected at most 9007199254740992"),
        ({"share": 10**400}, "found share = 1000"),
        ({"parts": {}}, "found parts = {}, expected a list"),
        ({"parts": [GOOD["parts"][0], 3]}, "found parts[1] = 3, expected an object"),
        ({"parts": [{"size": 1}]}, "found no name in parts[0]"),
        ({"parts": [{"name": "a", "size": "x" * 500}]}, "xxx…, expected an integer or a list"),
        ({"parts": [{"name": "a", "size": True}]}, "found parts[0].size = True, expected an integer or a list"),
        ({"parts": [{"name": ""}]}, "found parts[0].name = ''"),
    ],
)
def test_the_first_place_that_differs_is_told(change: dict[str, Any], words: str) -> None:
    with pytest.raises(Malformed) as error:
        checked({**GOOD, **change}, Whole)
    assert words in str(error.value)
    assert len(str(error.value)) < 300


@pytest.mark.parametrize(
    "content",
    [b"", b"{", b'"\xff"', b'"\\ud800"', b"NaN", b"[" * 5_000 + b"]" * 5_000, b"1" * 5_000, b"{} {}", b"\x00"],
)
def test_what_is_no_json_is_told(content: bytes) -> None:
    with pytest.raises(Malformed, match="it is not JSON"):
        parsed(content)


def test_json_says_what_it_says() -> None:
    numbers = [0.1 + 0.2, 1e-320, 1 / 3, 2**70, -0.0, 5]
    assert parsed(json.dumps(numbers)) == numbers
    assert parsed(b'\xef\xbb\xbf{"a": 1, "a": 2}') == {"a": 2}
    assert parsed(b"[Infinity]", nan=True) == [float("inf")]


def test_no_library_speaks_in_a_sentence() -> None:
    def ours(value: str) -> str:
        raise MemobenchError("the seed 7 is an evaluation's")

    with pytest.raises(Malformed) as caught:
        checked({"a": "x"}, dict[str, Annotated[str, AfterValidator(ours)]])
    assert str(caught.value) == "found a = 'x': the seed 7 is an evaluation's"
    with pytest.raises(MemobenchError) as found:
        from_frames('{"task_name": 3}', "a dataset")
    assert "(found task_name = 3, expected text)" in str(found.value)


def test_the_file_and_what_to_do_are_told(tmp_path: Path) -> None:
    path = tmp_path / "it.json"
    with pytest.raises(FileNotFoundError):
        read_json(path, Whole, "look elsewhere")
    path.write_text("[]")
    with pytest.raises(MemobenchError, match=r"it\.json: found \[\], expected an object; look elsewhere$"):
        read_json(path, Whole, "look elsewhere")
    path.unlink()
    path.mkdir()
    with pytest.raises(MemobenchError, match=r"it\.json cannot be read \(Is a directory\); look elsewhere$"):
        read_json(path, Whole, "look elsewhere")


def test_commands_that_read_no_file_do_not_wait_for_the_library() -> None:
    code = (
        "import sys, lerobot_memobench.cli.memobench, lerobot_memobench.envs.episode_log;"
        "sys.exit('pydantic' in sys.modules)"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


@pytest.mark.parametrize("error", [KeyError("a"), OSError(5, "bad\n\ndisk"), RecursionError("x" * 5_000)])
def test_whatever_a_library_raises_is_a_line(error: Exception) -> None:
    with pytest.raises(MemobenchError) as told, refusing(lambda why: MemobenchError(f"it is damaged ({why})")):
        raise error
    assert str(told.value).startswith(f"it is damaged ({type(error).__name__}: ")
    assert "\n" not in str(told.value)
    assert len(str(told.value)) < 300


@pytest.mark.parametrize("error", [MemobenchError("as it was"), KeyboardInterrupt("as it was")])
def test_what_is_told_already_and_what_is_no_damage_passes(error: BaseException) -> None:
    with pytest.raises(type(error), match=r"^as it was$"), refusing(lambda why: MemobenchError("another")):
        raise error
