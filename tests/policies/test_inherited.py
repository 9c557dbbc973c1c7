"""Recipe x checkpoint x memory: a memory has its own stride, fusion and settings, unless the command line sets them."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import pytest
from lerobot.configs import parser
from lerobot.configs.train import TrainPipelineConfig
from lerobot.utils.import_utils import register_third_party_plugins

from lerobot_memobench.policies.memobench_mem.configuration_memobench_mem import MemobenchMemConfig
from lerobot_memobench.policies.memobench_mem.inherited import OWN_DEFAULTS
from lerobot_memobench.policies.memobench_mem.memory import NONE, OURS
from lerobot_memobench.run.arguments import read_arguments, recipe_file, resolve_recipe, split_arguments
from lerobot_memobench.run.training import with_own_memory

MEMORIES = [NONE, *OURS]
SMALL = {"size": "small", "perception": "objects"}
BEGUN: dict[str, dict[str, Any]] = {
    "bank": {"memory": "bank", "memory_phase": True},
    "subgoal": {"memory": "subgoal", "memory_frames": 16, "memory_stride": 4},
    "fast_weights": {"memory": "fast_weights", "memory_settings": {"gradient_frames": 3, "time_codes": False}},
    "none": {"memory": "none"},
}
"""Checkpoints, each with settings that another memory does not take."""
RECIPE = """
policy:
  type: memobench_mem
  size: small
  perception: objects
  memory: keyframes
  memory_stride: 5
"""
BASES = ["train_paper", "recipe", *BEGUN]


@pytest.fixture(scope="module")
def bases(tmp_path_factory: pytest.TempPathFactory) -> dict[str, tuple[str, str]]:
    """Return name -> option of LeRobot and path, of recipes and checkpoints."""
    register_third_party_plugins()
    folder = tmp_path_factory.mktemp("bases")
    (folder / "recipe.yaml").write_text(RECIPE)
    found = {name: ("config_path", recipe_file(name)) for name in ("train_paper",)}
    found["recipe"] = ("config_path", folder / "recipe.yaml")
    for name, fields in BEGUN.items():
        MemobenchMemConfig(device="cpu", push_to_hub=False, **SMALL, **fields).save_pretrained(folder / name)
        found[name] = ("policy.path", folder / name)
    return {name: (option, str(path)) for name, (option, path) in found.items()}


def _by_lerobot(line: list[str], folder: Path, monkeypatch: pytest.MonkeyPatch) -> Any:
    """Return the policy's configuration that LeRobot makes of its own command line."""
    monkeypatch.setattr(sys, "argv", ["lerobot-train", *line, f"--output_dir={folder / 'run'}"])

    def main(cfg: Any) -> TrainPipelineConfig:
        cfg.validate()
        return cfg  # type: ignore[no-any-return]

    main.__annotations__["cfg"] = TrainPipelineConfig  # LeRobot takes no names for types
    return parser.wrap()(main)().policy  # type: ignore[call-arg]


@pytest.mark.parametrize(
    ("base", "memory"),
    [
        pytest.param(base, memory, marks=pytest.mark.slow if (row + column) % 3 else ())
        for row, base in enumerate(BASES)
        for column, memory in enumerate(MEMORIES)
    ],
)
def test_a_memory_has_its_own_settings(
    bases: dict[str, tuple[str, str]], base: str, memory: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    option, path = bases[base]
    line = [f"--{option}={path}", f"--policy.memory={memory}", "--policy.device=cpu", "--dataset.repo_id=local/x"]
    line.append("--policy.push_to_hub=false")
    sizes = {"size": "pi05", "perception": "pixels"} if base == "train_paper" else SMALL
    same = memory == {"train_paper": "frames", "recipe": "keyframes"}.get(base, base)
    held = {"recipe": {"memory_stride": 5}}.get(base, BEGUN.get(base, {})) if same else {}
    expected = MemobenchMemConfig(device="cpu", **{"memory": memory, **sizes, **held})
    kept = ("memory", *OWN_DEFAULTS)
    theirs = _by_lerobot(line, tmp_path, monkeypatch)
    assert {name: getattr(theirs, name) for name in kept} == {name: getattr(expected, name) for name in kept}
    # `lerobot train` hands LeRobot a line that says so ...
    ours = with_own_memory(read_arguments("train", resolve_recipe(split_arguments(line))))
    theirs = _by_lerobot([*ours.flags], tmp_path, monkeypatch)
    assert {name: getattr(theirs, name) for name in kept} == {name: getattr(expected, name) for name in kept}


@pytest.mark.parametrize("base", ["recipe", "bank"])
def test_what_the_line_sets_holds(
    bases: dict[str, tuple[str, str]], base: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    option, path = bases[base]
    line = [f"--{option}={path}", "--policy.memory=recurrent", "--policy.device=cpu", "--dataset.repo_id=local/x"]
    asked = ["--policy.memory_stride=24", "--policy.memory_fusion", "context", "--policy.push_to_hub=false"]
    found = _by_lerobot([*line, *asked], tmp_path, monkeypatch)
    assert (found.memory_stride, found.memory_fusion, found.memory_phase) == (24, "context", False)
