"""`scripts/memory_film.py`, README's animation: selection of the seed, and frames."""

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
    return runpy.run_path(str(SCRIPTS / "memory_film.py"))


def test_first_seed_with_different_outcomes_is_selected(script: dict[str, Any]) -> None:
    outcomes = {"a": (True, True, True), "b": (True, False, False)}
    rollouts: dict[str, Any] = {
        name: {7 + k: ({"success": success}, []) for k, success in enumerate(values)}
        for name, values in outcomes.items()
    }
    assert script["first_difference"](rollouts) == 8
    with pytest.raises(SystemExit, match="7 to 9"):
        script["first_difference"]({"a": rollouts["a"]})


def test_finished_column_repeats_its_last_frame(script: dict[str, Any], tmp_path: Path) -> None:
    side = script["SIDE"]

    def column(length: int, solved: bool) -> list[Any]:
        images = [np.full((side, side, 3), 20 * length + 40 * k, np.uint8) for k in range(length)]
        return [
            script["Frame"](image, EXECUTION if k else PROMPT, k, (solved and k == length - 1,), not solved, solved)
            for k, image in enumerate(images)
        ]

    pictures = list(script["animation"]({"short": column(2, True), "long": column(4, False)}))
    assert len(pictures) == 4
    assert pictures[0].width == 2 * side + script["MARGIN"]
    first_column = [np.asarray(picture)[script["HEADER"] :, :side] for picture in pictures]
    assert not np.array_equal(first_column[0], first_column[1])
    for later in first_column[2:]:
        np.testing.assert_array_equal(first_column[1], later)
    script["write"](pictures, tmp_path / "animation.webp")
    with Image.open(tmp_path / "animation.webp") as written:
        assert (getattr(written, "n_frames", 1), written.info["loop"]) == (4, 0)
