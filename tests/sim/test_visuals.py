"""Cached meshes and textures: damaged files, and the command that writes all."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest

from lerobot_memobench.cli.memobench import main
from lerobot_memobench.sim.scene import get_scene, scene_spec
from lerobot_memobench.sim.visuals import drawing_model
from lerobot_memobench.tasks.catalogue import get_task, task_names
from tests.sim.conftest import BOWLS


def cached(home: Path) -> dict[Path, bytes]:
    return {path: path.read_bytes() for path in home.rglob("*.safetensors")}


def test_damaged_files_are_written_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    task = get_task(BOWLS)  # with a thinned bowl, whose library is not safe in threads
    _, expected = get_scene(task).drawing()
    drawn = [drawing_model(scene_spec(task, visuals=True))[1]]
    files = cached(tmp_path)
    assert len(files) > 60
    for k, path in enumerate(sorted(files)):
        match k % 4:
            case 0:
                os.truncate(path, path.stat().st_size // 2)
            case 1:
                path.write_bytes(b"")
            case 2:
                path.write_bytes(b"x" * path.stat().st_size)
            case 3:
                path.unlink()
    drawn += [drawing_model(scene_spec(task, visuals=True))[1]]
    assert cached(tmp_path) == files
    for draw_list in drawn:
        np.testing.assert_array_equal(draw_list.points, expected.points)
        np.testing.assert_array_equal(draw_list.origin, expected.origin)
        np.testing.assert_array_equal(draw_list.triangles, expected.triangles)
        np.testing.assert_array_equal(draw_list.texels, expected.texels)


def test_prepared_tasks_find_their_meshes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    names = task_names()[:2]
    assert main(["prepare", "--tasks", ",".join(names), "--workers", "1"]) == 0
    output = capsys.readouterr()
    assert all(name in output.out + output.err for name in names)
    files = cached(tmp_path)
    assert files
    for name in names:
        drawing_model(scene_spec(get_task(name), visuals=True))
    assert cached(tmp_path).keys() == files.keys()
    assert main(["prepare", "--tasks", "no_such_task"]) == 2
