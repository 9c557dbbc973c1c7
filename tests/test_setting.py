"""A setting of the environment is its field and the code that applies it: help, pages, files and comparisons follow."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[1]
FIELD = '    dummy: int = setting(0, "a setting that nothing applies", least=0)\n\n    def __post_init__'
CODE = """
import json
from pathlib import Path
from lerobot_memobench.cli.lerobot import help_of
from lerobot_memobench.envs.episode_log import read_log, write_episodes
from lerobot_memobench.envs.evaluation_file import Acting, differences, facts_of, write_facts
from lerobot_memobench.evaluation.comparison import ALLOWED
from lerobot_memobench.rollouts.card import card_of
from lerobot_memobench.rollouts.plan import card_settings, plan_line
from tests.support.scripts import load_script

line = ["env=memobench", "policy=memobench_random", "episodes=1", "tasks=1"]
plans = [plan_line([*line, word]) for word in ("dummy=3", "seed=7")]
one, other = (plan.environment.settings.protocol_block for plan in plans)
card = card_of(plans[0])
write_facts(Path("log"), facts_of(plans[0].environment.settings, Acting()))
write_episodes("log", [{"task": "a", "memory_type": "temporal", "episode": 0, "success": True, "checkpoints": []}])
(record,) = read_log("log")
print(json.dumps({
    "help": "dummy=\\n        a setting that nothing applies (default: 0)" in help_of("eval"),
    "reference": [row for row in load_script("docs_reference").environment_fields() if row[0] == "dummy"],
    "card": [card["protocol"]["dummy"], card_settings(card).env["dummy"]],
    "record": record["dummy"],
    "comparison": [*differences(one, other), "dummy" in ALLOWED],
}))
"""


def test_a_new_field_is_all_that_help_files_and_comparisons_need(tmp_path: Path) -> None:
    source = tmp_path / "src"
    shutil.copytree(ROOT / "src", source, ignore=shutil.ignore_patterns("__pycache__", "*.safetensors"))
    file = source / "lerobot_memobench" / "envs" / "settings.py"
    text = file.read_text()
    assert text.count("\n    def __post_init__") == 1
    file.write_text(text.replace("    def __post_init__", FIELD.removeprefix("\n"), 1))
    done = subprocess.run(
        [sys.executable, "-c", CODE],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": f"{source}{os.pathsep}{ROOT}"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout.splitlines()[-1])
    assert found == {
        "help": True,
        "reference": [["dummy", "0", "a setting that nothing applies"]],
        "card": [3, 3],
        "record": 3,
        "comparison": ["dummy: 3 and 0", True],
    }
