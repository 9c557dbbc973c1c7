"""`scripts/memory_film.py`, README's moving picture: which episode is shown, and how the film goes on and ends."""

from __future__ import annotations

import runpy
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from lerobot_memobench.protocol import EXECUTION, PROMPT
from tests.support.scripts import SCRIPTS


@pytest.fixture(scope="module")
def script() -> dict[str, Any]:
    """The script's names."""
    return runpy.run_path(str(SCRIPTS / "memory_film.py"))


def test_the_first_seed_that_tells_them_apart_is_shown(script: dict[str, Any]) -> None:
    ends = {"a": (True, True, True), "b": (True, False, False)}
    found: dict[str, Any] = {
        name: {7 + k: ({"success": end}, []) for k, end in enumerate(told)} for name, told in ends.items()
    }
    assert script["first_difference"](found) == 8
    with pytest.raises(SystemExit, match="all end alike on seeds 7 to 9"):
        script["first_difference"]({"a": found["a"]})


def test_a_short_take_waits_and_the_film_begins_anew(script: dict[str, Any], tmp_path: Path) -> None:
    def take(length: int, solved: bool) -> list[Any]:
        last = length - 1
        shade = [np.full((side, side, 3), 20 * length + 40 * k, np.uint8) for k in range(length)]
        return [
            script["Shot"](shade[k], EXECUTION if k else PROMPT, k, (solved and k == last,), not solved, solved)
            for k in range(length)
        ]

    side = script["SIDE"]
    film = list(script["frames"]({"short": take(2, True), "long": take(4, False)}))
    assert len(film) == 4
    assert film[0].width == 2 * side + script["GAP"]
    left = [np.asarray(picture)[script["HEADER"] :, :side] for picture in film]  # below the clock
    assert not np.array_equal(left[0], left[1])
    np.testing.assert_array_equal(left[1], left[3])
    script["write"](film, tmp_path / "film.webp")
    with Image.open(tmp_path / "film.webp") as written:
        assert (getattr(written, "n_frames", 1), written.info["loop"]) == (4, 0)
