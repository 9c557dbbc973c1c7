"""The entries for the Hugging Face hub are read by its client, and name settings and missing episodes."""

from __future__ import annotations

from pathlib import Path

import yaml
from huggingface_hub import parse_eval_result_entries

from lerobot_memobench.cli.memobench import main
from lerobot_memobench.evaluation.report import HUB_FILE
from tests.support.board import evaluation, in_card


def test_entries_of_the_hub(tmp_path: Path) -> None:
    folder = evaluation(tmp_path / "one")
    in_card(lambda card: card["protocol"].update(episodes=20))(folder)
    assert main(["export", str(folder), "--dataset", "user/memobench", "--out", str(tmp_path)]) == 0
    entries = parse_eval_result_entries(yaml.safe_load((tmp_path / HUB_FILE).read_text()))
    assert [entry.task_id for entry in entries] == ["strict_sr", "strict_msr", "strict_mur", "strict_mcr"]
    assert (entries[0].dataset_id, entries[0].value) == ("user/memobench", 60.0)
    for part in ("strict suite", "inputs: pixels", "incomplete", "missing: 300 of 600 episodes", "95 % interval"):
        assert part in str(entries[0].notes)
