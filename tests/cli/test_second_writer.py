"""A second writer is refused, and changes no byte of the folder that the first one holds."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from lerobot_memobench.cli.lerobot import main as lerobot
from lerobot_memobench.cli.memobench import main as memobench
from lerobot_memobench.envs.episode_log import EpisodeLog
from lerobot_memobench.evaluation.html.write import UNFINISHED
from lerobot_memobench.jobs.processes import locked, taking_turns
from lerobot_memobench.run.card import new_card, write_card
from lerobot_memobench.run.machine import run_facts
from tests.support import logs, synthetic_dataset

STOVE = "turn_on_the_stove_and_turn_it_off"
EVALUATION = ["policy=memobench_random", f"tasks={STOVE}", "episodes=2", "policy.device=cpu", "output_dir=out"]
PARTS = ["eval", "env=memobench", *EVALUATION, "shards=2", "batch_size=1"]


#: Command -> its exit status, where its lock is.
COMMANDS: dict[str, tuple[Callable[[], int], int, str]] = {
    "evaluation": (lambda: lerobot(["eval", "env=memobench", *EVALUATION]), 2, "out"),
    "evaluation that goes on": (lambda: lerobot(["eval", "env=memobench", *EVALUATION, "resume=true"]), 2, "out"),
    "evaluation into a log elsewhere": (
        lambda: lerobot(["eval", "env=memobench", *EVALUATION, "env.log_dir=other"]),
        2,
        "out",
    ),
    "parts of an evaluation": (lambda: lerobot(PARTS), 2, "out"),
    "sealed test": (lambda: memobench(["test-sealed", *EVALUATION]), 2, "out"),
    "merge": (lambda: memobench(["merge", "out", "logged"]), 2, "out"),
    "report": (lambda: memobench(["report", "logged"]), 0, "logged"),
    "html": (lambda: memobench(["report", "logged", "--html", "html"]), 2, "html"),
    "generation": (
        lambda: memobench(["generate", "--tasks", STOVE, "--episodes", "1", "--out", "ds"]),
        2,
        "ds/.staging",
    ),
    "conversion": (lambda: memobench(["convert", "files", "--out", "ds"]), 2, "ds/.staging"),
    "training": (
        lambda: lerobot(["train", "policy=memobench_mem", "policy.device=cpu", "dataset=data", "output_dir=run"]),
        2,
        ".run.lock",
    ),
}


def files(folder: Path) -> dict[Path, bytes | None]:
    """Everything in a folder, files with their bytes."""
    return {path: path.read_bytes() if path.is_file() else None for path in folder.rglob("*")}


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return synthetic_dataset.make_dataset(tmp_path_factory.mktemp("data") / "data")


@pytest.mark.parametrize("command", COMMANDS)
def test_a_second_writer_changes_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Any, dataset: Path, command: str
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    for name in (
        "out/notes.json",
        "out/.1-a.part.evaluation.json",
        "run/model",
        "files/a.hdf5",
    ):
        Path(name).parent.mkdir(exist_ok=True)
        Path(name).write_text("of the first run")
    parts: dict[str, Any] = {"protocol": {"tasks": [STOVE], "episodes": 2}, "policy": {}, "checkpoint": None}
    started = [run_facts(["lerobot", "eval"], 1)]
    write_card(Path("out"), new_card(**parts, trained_on=None, task_files={}, settings={}, runs=started))
    for name in ("ds/.staging/episodes/.tmp-000000", "html/videos/run", "data"):
        Path(name).mkdir(parents=True)
    Path("html/index.html").write_text(UNFINISHED)
    Path("html/videos/run/a.mp4").write_text("of the first run")
    Path("ds/.staging/request.json").write_text("{}")
    for path in dataset.iterdir():
        Path("data", path.name).symlink_to(path)
    Path(".run.lock").touch()
    EpisodeLog("logged").append(logs.record(STOVE))
    run, status, place = COMMANDS[command]

    lock = taking_turns(Path(place)) if place.endswith("a.lock") else locked(Path(place), Path("out"))
    with lock:
        before = files(tmp_path)
        assert run() == status
        after = files(tmp_path)
    if command == "html":  # the report itself is written into the evaluation, which nobody holds
        after = {path: content for path, content in after.items() if path in before}
    assert after == before
    assert "another run is writing" in capsys.readouterr().err
