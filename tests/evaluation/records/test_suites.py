"""Evaluations of two suites are never one report: every reader refuses them in a sentence."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from lerobot_memobench.envs.episode_log import PROTOCOL_FILE, check_protocol
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.evaluation.comparison.differences import compare
from lerobot_memobench.evaluation.documents.evaluation_tables import failures
from lerobot_memobench.evaluation.documents.html.write import write_html
from lerobot_memobench.evaluation.documents.report import build
from lerobot_memobench.evaluation.metrics.failures import failure_counts
from lerobot_memobench.evaluation.metrics.summary import summarise
from lerobot_memobench.evaluation.records.protocol import read_protocol
from lerobot_memobench.evaluation.records.runs import read_runs
from lerobot_memobench.run.merging import merge
from lerobot_memobench.tasks.failures import FAILURES
from tests.support.logs import evaluation, rollout


@pytest.fixture
def strict(tmp_path: Path) -> Path:
    """An evaluation of the strict suite whose failures are miscounts."""
    return evaluation(tmp_path / "strict", suite="strict")


@pytest.fixture
def published(tmp_path: Path) -> Path:
    """One of the time when there was no other suite."""
    return evaluation(tmp_path / "published")


REFUSED = "report each suite by itself"


def test_reports_of_two_suites_are_refused(strict: Path, published: Path, tmp_path: Path) -> None:
    with pytest.raises(MemobenchError, match=REFUSED):
        read_runs([published, strict])
    with pytest.raises(MemobenchError, match=REFUSED):
        write_html([strict, published], tmp_path / "page")
    with pytest.raises(MemobenchError, match="suite: published and strict"):
        compare(*read_runs([published]), *read_runs([strict]))
    with pytest.raises(MemobenchError, match="found --allow 'suite'"):
        compare(*read_runs([published]), *read_runs([strict]), allow=["suite"])
    assert len(read_runs([strict])) == 1


def test_one_log_of_two_suites_is_refused(tmp_path: Path) -> None:
    folder = tmp_path / "mixed"
    records = [rollout("one", "temporal", "S", [True], True, k, suite=["published", "strict"][k]) for k in range(2)]
    folder.mkdir()
    (folder / "episodes.jsonl").write_text("".join(json.dumps(record) + "\n" for record in records))
    with pytest.raises(MemobenchError, match="of the suites published and strict"):
        read_runs([folder])


def test_the_papers_figures_stand_beside_the_published_suite_only(strict: Path, published: Path) -> None:
    assert build(read_runs([published]), paper=True).sections
    with pytest.raises(MemobenchError, match="leave out --with paper"):
        build(read_runs([strict]), paper=True)


def test_merging_two_suites_is_refused(strict: Path, published: Path, tmp_path: Path) -> None:
    with pytest.raises(MemobenchError, match=r"\(suite: published and strict\); they are not one evaluation"):
        merge(tmp_path / "joined", [published, strict])


def test_an_earlier_folder_goes_on_as_published_and_not_as_strict(tmp_path: Path) -> None:
    (tmp_path / PROTOCOL_FILE).write_text('{"horizon": 1200}')
    assert check_protocol(tmp_path, {"horizon": 1200, "suite": "published"})
    with pytest.raises(MemobenchError, match="suite: published and strict"):
        check_protocol(tmp_path, {"horizon": 1200, "suite": "strict"})
    empty = tmp_path / "empty"
    empty.mkdir()
    assert not check_protocol(empty, {"suite": "strict"})


def test_a_log_tells_its_suite(strict: Path, published: Path) -> None:
    assert read_protocol(strict)["suite"] == "strict"
    assert "suite" not in read_protocol(published)


def test_failures_of_strict_tasks_join_the_published_rows() -> None:
    def failed(failure: str, episode: int) -> dict[str, object]:
        return rollout("one", "temporal", "SU", [True, False], False, episode, failure=failure)

    plain = [failed("stale_memory", 0)]
    assert list(failure_counts(plain)) == list(FAILURES)
    counted = failure_counts([*plain, failed("miscount", 1), failed("miscount", 2), failed("wrong_place", 3)])
    assert counted == {**failure_counts(plain), "miscount": 2, "wrong_place": 1}
    published = [row[0] for row in failures(summarise(plain)).rows]
    table = failures(summarise([*plain, failed("miscount", 1)]))
    assert [row[0] for row in table.rows] == [*published, "miscount"]
    assert "Miscount: the event was done too seldom or too often." in str(table.note)
    assert "Miscount" not in str(failures(summarise(plain)).note)
