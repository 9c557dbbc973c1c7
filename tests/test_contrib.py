"""What is ready to be sent to LeRobot agrees with the package: names, versions, command lines, metrics."""

from __future__ import annotations

import re
import shlex
import tomllib
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import yaml
from huggingface_hub import hf_hub_download
from lerobot.envs import factory
from lerobot.envs import utils as env_utils

from lerobot_memobench.envs.configuration_memobench import MemobenchEnvConfig
from lerobot_memobench.envs.observations import policy_features, policy_names
from lerobot_memobench.evaluation.metrics import METRICS
from lerobot_memobench.sim.robot import ROBOSUITE
from lerobot_memobench.tasks.catalogue import load_task, task_names
from tests.support import hub_server
from tests.test_docs import check, commands

ROOT = Path(__file__).parents[1]
OURS = ROOT / "contrib" / "lerobot"
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())
DISTRIBUTION, VERSION = PROJECT["project"]["name"], PROJECT["project"]["version"]
PAGE, PATCH = ((OURS / name).read_text() for name in ("memobench.mdx", "lerobot.patch"))


# --- what goes where ---


def test_every_file_is_told_where_it_goes() -> None:
    told = set(re.findall(r"^\| `([^`]+?)/?` \|", (OURS / "README.md").read_text(), re.MULTILINE))
    assert told == {path.name for path in OURS.iterdir()} - {"README.md"}
    assert len((OURS / "README.md").read_text().splitlines()) <= 25


def test_all_name_the_distribution_and_its_version() -> None:
    pinned = f"{DISTRIBUTION}=={VERSION}"
    added = re.findall(r'^\+memobench = .*"(lerobot_policy\w+==[\d.]+); ', PATCH, re.MULTILINE)
    dockerfile = (OURS / "Dockerfile.benchmark.memobench").read_text()
    assert added == [pinned]
    assert (OURS / "envhub" / "requirements.txt").read_text().split() == [pinned]
    assert f"ARG MEMOBENCH_VERSION={VERSION}\n" in dockerfile
    assert f'"{DISTRIBUTION}==${{MEMOBENCH_VERSION}}"' in dockerfile


def test_the_arm_is_installed_as_our_users_install_it() -> None:
    line = f"install --no-deps robosuite=={ROBOSUITE}"
    assert line in (ROOT / "docs" / "start" / "install.md").read_text()
    assert f"pip {line}" in PAGE
    assert (
        f"pip {line.replace('install', 'install --no-cache')}" in (OURS / "Dockerfile.benchmark.memobench").read_text()
    )


# --- commands ---


def smoke() -> dict[str, Any]:
    (job,) = yaml.safe_load((OURS / "benchmark_tests.memobench.yml").read_text()).values()
    return job  # type: ignore[no-any-return]


def smoke_commands() -> Iterator[list[str]]:
    """Yield the words of each command that the smoke job runs."""
    job = smoke()
    for step in job["steps"]:
        text = step.get("run", "")
        inside = re.search(r'bash -ec "\n(.*)"\n', text, re.DOTALL)
        script = text if inside is None else inside[1].replace(r"\"", '"').replace(r"\$", "$")
        for name, value in job["env"].items():
            script = script.replace(f"${{{name}}}", value).replace(f"${name}", value)
        for line in re.sub(r"\\\n\s*", " ", script).splitlines():
            yield shlex.split(line)


def test_the_pages_commands_are_understood() -> None:
    found = [*commands(OURS / "memobench.mdx")]
    assert {words[0] for words in found} == {"pip", "memobench", "lerobot-eval", "lerobot-train"}
    for words in found:
        check(words)


def test_the_smoke_jobs_commands_are_understood() -> None:
    found = [words for words in smoke_commands() if words and words[0] in ("lerobot-eval", "memobench")]
    assert [words[0] for words in found] == ["lerobot-eval", "memobench"]
    for words in found:
        check([word for word in words if not word.startswith("--policy.device")])
    flags = dict(word.removeprefix("--").partition("=")[::2] for word in found[0][1:])
    assert flags["policy.type"] == "memobench_expert"
    assert flags["env.expert_action"] == "true", "plain lerobot-eval does not set it"
    assert flags["eval.n_episodes"] == "1"
    assert flags["output_dir"] == found[1][-1]


def test_descriptions_are_keyed_as_lerobots_videos() -> None:
    """By the function that the patch adds to their script."""
    added = "\n".join(line[1:] for line in PATCH.splitlines() if line.startswith("+"))
    (function,) = re.findall(r"^def _memobench_descriptions.*?\n    return [^\n]*\n", added, re.DOTALL | re.MULTILINE)
    scope: dict[str, Any] = {}
    exec(compile(function, "patch", "exec"), scope)
    task = smoke()["env"]["MEMOBENCH_TASK"]
    ((suite, number, folder),) = MemobenchEnvConfig(tasks=task).selected()
    assert scope["_memobench_descriptions"](task) == {f"{suite}_{number}": load_task(folder).language}


# --- what the page says ---


def rows(heading: str) -> list[list[str]]:
    """Return the rows of the first table behind some words of the page, without its head."""
    table = re.search(r"(?:^\|.*\n)+", PAGE[PAGE.index(heading) :], re.MULTILINE)
    assert table is not None
    return [[cell.strip().strip("`") for cell in row.split("|")[1:-1]] for row in table[0].splitlines()[2:]]


def test_suites_and_metrics_are_ours() -> None:
    chosen = [suite for suite, *_ in MemobenchEnvConfig().selected()]
    assert {suite: int(count) for suite, count, *_ in rows("## Available tasks")} == {
        suite: chosen.count(suite) for suite in dict.fromkeys(chosen)
    }
    assert [name for name, _ in rows("`memobench report` adds")] == list(METRICS)


def test_inputs_are_ours() -> None:
    told = {key: tuple(int(n) for n in re.findall(r"\d+", shape)) for key, shape, _ in rows("**Observations:**")}
    names = policy_names("both")
    ours = {names[key]: tuple(one.shape) for key, one in policy_features("both").items() if key != "action"}
    assert told == ours | {"observation.phase": (1,), "observation.step": (1,)}


def test_tasks_that_are_named_exist() -> None:
    named = {
        word for text in (PAGE, yaml.safe_dump(smoke())) for word in re.findall(r"\b[a-z]+(?:_[a-z]+){4,}\b", text)
    }
    assert named
    assert named <= set(task_names())


# --- EnvHub ---


@pytest.fixture
def on_a_hub(monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    """A hub on this machine that holds the repository."""
    hub = hub_server.Hub()
    hub.repos["somebody/memobench"] = {path.name: path.read_bytes() for path in (OURS / "envhub").iterdir()}
    hub.large["somebody/memobench"], hub.tags["somebody/memobench"] = set(), {}
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_OFFLINE", False)
    monkeypatch.setattr(env_utils, "hf_hub_download", partial(hf_hub_download, endpoint=hub.address))
    yield "somebody/memobench"
    hub.shutdown()
    hub.server_close()


def test_lerobots_hub_loader_makes_the_environments(
    on_a_hub: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    found = factory.make_env(on_a_hub, 2, trust_remote_code=True, hub_cache_dir=str(tmp_path / "cache"))
    assert {suite: len(tasks) for suite, tasks in found.items()} == {
        **{"temporal": 10, "spatial": 10, "object": 5, "procedural": 5}
    }
    env = found["temporal"][6]
    assert env.num_envs == 2
    assert "stove" in env.call("task_description")[0]
    module = env_utils._load_module_from_path(str(OURS / "envhub" / "env.py"))
    of_class = type("Cfg", (), {"task": "object"})()
    for cfg in (SimpleNamespace(task="object", fps=30, hub_path="x"), MemobenchEnvConfig(tasks="object"), of_class):
        assert {suite: [*tasks] for suite, tasks in module.make_env(1, cfg=cfg).items()} == {"object": [*range(20, 25)]}
