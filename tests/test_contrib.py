"""`contrib/lerobot`: names, versions, commands, metrics and features agree with the package."""

from __future__ import annotations

import re
import shlex
import tomllib
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import pytest
import yaml
from huggingface_hub import hf_hub_download
from lerobot.envs import factory
from lerobot.envs import utils as env_utils

from lerobot_memobench.envs.lerobot import MemobenchEnvConfig
from tests.support import hub_server
from tests.test_docs import check, commands

ROOT = Path(__file__).parents[1]
CONTRIB = ROOT / "contrib" / "lerobot"
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
PAGE, PATCH, DOCKERFILE = (
    (CONTRIB / name).read_text() for name in ("memobench.mdx", "lerobot.patch", "Dockerfile.benchmark.memobench")
)
(JOB,) = yaml.safe_load((CONTRIB / "benchmark_tests.memobench.yml").read_text()).values()


def test_versions_agree_with_the_package() -> None:
    name, version = PROJECT["name"], PROJECT["version"]
    added = re.findall(r'^\+memobench = .*"(lerobot_policy\w+==[\d.]+); ', PATCH, re.MULTILINE)
    assert added == (CONTRIB / "envhub" / "requirements.txt").read_text().split() == [f"{name}=={version}"]
    assert f"ARG MEMOBENCH_VERSION={version}\n" in DOCKERFILE
    assert f'"{name}==${{MEMOBENCH_VERSION}}"' in DOCKERFILE


# --- commands ---


def job_commands() -> Iterator[list[str]]:
    """Yield the words of each command of the smoke job."""
    for step in JOB["steps"]:
        text = step.get("run", "")
        inside = re.search(r'bash -ec "\n(.*)"\n', text, re.DOTALL)
        script = text if inside is None else inside[1].replace(r"\"", '"').replace(r"\$", "$")
        for name, value in JOB["env"].items():
            script = script.replace(f"${{{name}}}", value).replace(f"${name}", value)
        for line in re.sub(r"\\\n\s*", " ", script).splitlines():
            yield shlex.split(line)


def test_commands_of_the_page_are_valid() -> None:
    found = [*commands(CONTRIB / "memobench.mdx")]
    assert {words[0] for words in found} == {"pip", "memobench", "lerobot-eval", "lerobot-train"}
    for words in found:
        check(words)


def test_commands_of_the_smoke_job_are_valid() -> None:
    evaluation, report = (words for words in job_commands() if words and words[0] in ("lerobot-eval", "memobench"))
    for words in (evaluation, report):
        check([word for word in words if not word.startswith("--policy.device")])
    flags = dict(word.removeprefix("--").partition("=")[::2] for word in evaluation[1:])
    assert flags["policy.type"] == "memobench_expert"
    assert flags["env.expert_action"] == "true", "plain lerobot-eval does not set it"
    assert flags["eval.n_episodes"] == "1"
    assert flags["output_dir"] == report[-1]


# --- EnvHub ---


@pytest.fixture
def hub_repository(monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    """Serve `contrib/lerobot/envhub` as a repository of a local hub."""
    hub = hub_server.Hub()
    hub.repos["somebody/memobench"] = {path.name: path.read_bytes() for path in (CONTRIB / "envhub").iterdir()}
    hub.large["somebody/memobench"], hub.tags["somebody/memobench"] = set(), {}
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_OFFLINE", False)
    monkeypatch.setattr(env_utils, "hf_hub_download", partial(hf_hub_download, endpoint=hub.address))
    yield "somebody/memobench"
    hub.shutdown()
    hub.server_close()


def test_lerobots_hub_loader_creates_the_environments(
    hub_repository: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    envs = factory.make_env(hub_repository, 2, trust_remote_code=True, hub_cache_dir=str(tmp_path / "cache"))
    assert {suite: len(tasks) for suite, tasks in envs.items()} == {
        **{"temporal": 10, "spatial": 10, "object": 5, "procedural": 5}
    }
    env = envs["temporal"][6]
    assert env.num_envs == 2
    assert "stove" in env.call("task_description")[0]
    module = env_utils._load_module_from_path(str(CONTRIB / "envhub" / "env.py"))
    class_config = type("Cfg", (), {"task": "object"})()
    for cfg in (SimpleNamespace(task="object", fps=30, hub_path="x"), MemobenchEnvConfig(tasks="object"), class_config):
        assert {suite: [*tasks] for suite, tasks in module.make_env(1, cfg=cfg).items()} == {"object": [*range(20, 25)]}
