"""The commands convert, validate and push, as they print and end; what they call is tested elsewhere."""

from __future__ import annotations

from pathlib import Path

import pytest
import typer
from typer.testing import CliRunner

from lerobot_memobench.cli import data
from lerobot_memobench.datasets import convert as convert_module
from lerobot_memobench.datasets import push as push_module
from lerobot_memobench.datasets import validate as validate_module
from lerobot_memobench.datasets.convert import ConversionSummary
from lerobot_memobench.datasets.hdf5.reading import Problem
from lerobot_memobench.datasets.validate import Verdict
from lerobot_memobench.jobs.processes import Advance


@pytest.fixture
def call():
    app = typer.Typer()
    for command in (data.convert, data.validate, data.push):
        app.command()(command)

    def run(*words: str):
        return CliRunner().invoke(app, list(words), standalone_mode=False)

    return run


def test_convert(call, monkeypatch):
    asked = {}

    def run(source, out, *, progress, **settings):
        asked.update(settings, source=source, out=out)
        progress(Advance(1, 2, "a_demo.hdf5", 0, None))
        return ConversionSummary(Path("ds"), 1, (Problem("b.hdf5", "data/demo_1", "the array 'states' is missing"),))

    monkeypatch.setattr(convert_module, "convert", run)
    result = call("convert", "src", "--out", "ds", "--upside-down", "--repo-id", "a/b")
    assert callable(asked.pop("tell"))
    assert asked == {
        "source": Path("src"),
        "out": Path("ds"),
        "upside_down": True,
        "workers": 1,
        "repo_id": "a/b",
    }
    assert "1/2 a_demo.hdf5, demo_0" in result.output
    assert "left out: b.hdf5, data/demo_1: the array 'states' is missing" in result.output
    assert "dataset of 1 episode: ds" in result.output
    assert result.return_value == 1


def test_validate(call, monkeypatch):
    verdicts = [Verdict("episode 0", None), Verdict("episode 1", "success: recorded [False], replayed True")]

    def run(folder, *, workers, progress):
        for number, verdict in enumerate(verdicts):
            progress(number + 1, 2, verdict)
        return verdicts

    monkeypatch.setattr(validate_module, "validate", run)
    result = call("validate", "ds", "--workers", "2")
    assert "episode 1: success: recorded [False], replayed True" in result.output
    assert "1 of 2 episodes agree" in result.output
    assert result.return_value == 1
    verdicts.pop()
    assert call("validate", "ds").return_value == 0


def test_push(call, monkeypatch):
    asked = {}
    monkeypatch.setattr(push_module, "push", lambda *words, **more: asked.update(more, words=words) or "https://x/y")
    result = call("push", "ds", "--repo-id", "a/b", "--private")
    assert callable(asked.pop("tell"))
    assert asked == {"words": (Path("ds"), "a/b"), "private": True}
    assert (result.return_value, result.output.strip()) == (0, "dataset: https://x/y")
