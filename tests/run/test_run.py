"""An evaluation refuses what it cannot run; its folder is made for a run and left clean behind it."""

from __future__ import annotations

from pathlib import Path

import pytest

import lerobot_memobench.registration  # noqa: F401
from lerobot_memobench.run.run import made


def test_of_a_new_folder_nothing_empty_stays(tmp_path: Path) -> None:
    new = tmp_path / "outputs" / "run"
    with pytest.raises(FileExistsError), made(new):
        [(new / "videos" / name).mkdir(parents=True) for name in ("task_0", "task_0")]
    assert not new.exists()
    with made(new):
        (new / "videos").mkdir()
        (new / "eval_info.json").touch()
    assert [path.name for path in new.iterdir()] == ["eval_info.json"]


def test_a_folder_that_was_there_stays_as_it_was(tmp_path: Path) -> None:
    (tmp_path / "somebodys").mkdir()
    with made(tmp_path):
        pass
    assert (tmp_path / "somebodys").is_dir()
