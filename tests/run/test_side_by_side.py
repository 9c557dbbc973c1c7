"""Several films as one: as long as the longest, each with its name and its end."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from lerobot_memobench.envs.video import LAST_FRAMES, Film
from lerobot_memobench.run.contact_sheet import read_video
from lerobot_memobench.run.side_by_side import FAILED, SOLVED, STRIP_WIDTH, TITLE, joined, side_by_side, strip

HEIGHT, WIDTH = 32, 64


@pytest.fixture
def films(tmp_path: Path) -> dict[str, tuple[Path, bool]]:
    """A grey film of five frames that is solved, and a bright one of nine that is not."""
    found = {}
    for name, shade, length, solved in (("with", 60, 5, True), ("without", 200, 9, False)):
        film = Film(tmp_path / f"{name}.mp4")
        for _ in range(length):
            film.add(np.full((HEIGHT, WIDTH, 3), shade, np.uint8))
        path = film.finish()
        assert path is not None
        found[name] = (path, solved)
    return found


def coloured(picture: np.ndarray, colour: tuple[int, int, int]) -> bool:
    return bool((picture == colour).all(axis=-1).any())


def test_films_stand_side_by_side_and_say_how_they_ended(films: dict[str, tuple[Path, bool]], tmp_path: Path) -> None:
    frames = list(joined(films))
    assert len(frames) == 9 + LAST_FRAMES
    assert frames[0].shape == (TITLE + HEIGHT, 2 * WIDTH, 3)
    left, right = frames[0][TITLE:, :WIDTH], frames[0][TITLE:, WIDTH:]
    assert abs(float(left.mean()) - 60) < 4
    assert abs(float(right.mean()) - 200) < 4
    ends = [[coloured(frame[:TITLE], colour) for frame in frames] for colour in (SOLVED, FAILED)]
    assert [end.index(True) for end in ends] == [5 + LAST_FRAMES - 1, 9 + LAST_FRAMES - 1]
    written = read_video(side_by_side(films, tmp_path / "both.mp4"))
    assert len(written) == len(frames) + LAST_FRAMES


def test_a_film_that_cannot_be_read_leaves_nothing(films: dict[str, tuple[Path, bool]], tmp_path: Path) -> None:
    out = tmp_path / "new" / "both.mp4"
    broken = tmp_path / "broken.mp4"
    broken.write_bytes(b"no film")
    with pytest.raises(Exception, match="Invalid data"):
        side_by_side({**films, "broken": (broken, False)}, out)
    assert not out.exists()


def test_a_strip_has_a_row_per_film(films: dict[str, tuple[Path, bool]]) -> None:
    picture = np.asarray(strip(films))
    assert picture.shape == (2 * (TITLE + STRIP_WIDTH * HEIGHT // WIDTH), 6 * STRIP_WIDTH, 3)
    half = len(picture) // 2
    assert coloured(picture[:TITLE], SOLVED)
    assert coloured(picture[half : half + TITLE], FAILED)
