"""Figures: the numbers that are drawn, and that every figure can be drawn and saved."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.evaluation.figures import rates, rollouts, style
from lerobot_memobench.evaluation.records import Run, read_runs
from lerobot_memobench.paper import published_rows
from lerobot_memobench.tasks.failures import FAILURES, FAULTS, REFINED_FAILURES
from lerobot_memobench.tasks.task import STRICT_FAILURES
from tests.support import logs

MODULE = "π0.5 + memory module"


@pytest.fixture
def runs(tmp_path: Path) -> list[Run]:
    for k, successes in ((5, 1), (20, 3)):
        logs.evaluation(tmp_path / f"k{k}", successes, replan_steps=k)
    return read_runs([f"mine_$={tmp_path}/k{k}" for k in (5, 20)])


# --- radar ---


def best(table: str) -> dict[str, str]:
    """Metric -> the method with the highest average over its best replan interval."""
    axes = style.AVERAGE_AXES
    found = style.best_over_replan(style.published_entries(table), axes)
    return {metric: max(found, key=lambda whose: found[whose][k] or 0.0)[0] for k, (_, metric) in enumerate(axes)}


def test_the_papers_radar_says_what_its_text_says() -> None:
    """Appendix "Radar Summaries": who is highest on each axis of both radars."""
    assert best("main") == {"SR": MODULE, "MSR": MODULE, "MUR": "MemoryVLA", "MCR": "HiF-VLA"}
    contrastive, semantic = "contrastive alignment", "semantic alignment"
    assert best("alignment") == {"SR": contrastive, "MSR": semantic, "MUR": contrastive, "MCR": contrastive}


def test_axes_are_normalised_by_their_highest() -> None:
    kept, tops, shares = rates.normalised(style.published_entries("main"), style.AVERAGE_AXES)
    assert tops == [31.9, 58.1, 49.9, 32.1]
    assert len(kept) == 4
    assert shares["MemoryVLA", True] == pytest.approx([29.2 / 31.9, 55.1 / 58.1, 1.0, 14.1 / 32.1])
    assert max(value for row in shares.values() for value in row if value is not None) == 1.0


def test_what_does_not_apply_is_a_gap_and_no_zero(runs: list[Run]) -> None:
    """Our two tasks are of two memory types: the paper's other axes do not apply to them."""
    rows = [*style.entries_of(runs), *style.published_entries("main")]
    kept, _, shares = rates.normalised(rows, style.TYPE_AXES)
    ours = dict(zip(kept, shares["mine_$", False], strict=True))
    assert {memory_type for (memory_type, _), share in ours.items() if share is not None} == {"temporal", "spatial"}
    assert ours["object", "SR"] is None
    figure = rates.draw_radar([("both", rows)], style.TYPE_AXES)
    (line,) = [line for line in figure.axes[0].lines if line.get_label().startswith("mine")]
    drawn = np.asarray(line.get_ydata(), dtype=float)
    assert np.isnan(drawn).sum() == sum(share is None for share in [*ours.values(), next(iter(ours.values()))])
    texts = [text.get_text() for text in figure.axes[0].get_legend().get_texts()]
    assert texts[-1] == "a gap: not applicable, or not evaluated"
    zeros = rates.normalised(
        [replace(rows[0], average=dict.fromkeys(("SR", "MSR", "MUR"), 0.0))], style.AVERAGE_AXES[:3]
    )[2]
    assert list(zeros.values()) == [[0.0, 0.0, 0.0]], "a rate of nought is one"


def test_an_evaluation_called_like_a_method_of_the_papers_is_none_of_it(tmp_path: Path) -> None:
    logs.evaluation(tmp_path / "a", 2)
    ours = style.entries_of(read_runs([f"π0.5={tmp_path / 'a'}"]))
    found = style.best_over_replan([*ours, *style.published_entries("main")], style.AVERAGE_AXES)
    assert found["π0.5", False][0] == 50.0
    assert found["π0.5", True][0] == pytest.approx(31.0, abs=3)


def test_the_papers_methods_keep_their_looks(runs: list[Run]) -> None:
    theirs = [entry.identity for entry in style.published_entries()]
    alone = style.looks_of(theirs)
    assert len({(one.colour, one.marker, str(one.dashes)) for one in alone.values()}) == len(alone) == 11
    for beside in ([("mine", False), *theirs], [*theirs[5:], ("mine", False), ("π0.5", False)], theirs[::-1]):
        found = style.looks_of(beside)
        assert all(found[whose] == alone[whose] for whose in beside if whose[1])
    assert style.looks_of([("mine", False)])["mine", False] == style.looks_of([*theirs, ("mine", False)])["mine", False]
    assert not {one.colour for one in style.looks_of([("a", False), ("b", False)]).values()} & {
        alone[entry.identity].colour for entry in style.published_entries("main")
    }


def test_how_much_was_run_is_said_beside_the_papers_rows(runs: list[Run]) -> None:
    told = "(2 of 30 tasks, 8 rollouts;\ninputs: not recorded)"
    ours, theirs = style.entries_of(runs), style.published_entries("main")
    assert style.labels_of([*ours, *theirs])["mine_$", False] == f"mine_$\n{told}"
    assert style.labels_of([*ours, *theirs])["π0", True] == "paper: π0"
    assert style.labels_of(ours) == {("mine_$", False): "mine_$"}
    assert style.labels_of(theirs)["π0", True] == "π0"
    for figure in (rates.draw_replan(runs, paper=True), rates.draw_correlations([*theirs, *ours])):
        assert any("2 of 30 tasks, 8 rollouts" in text.get_text() for text in figure.legends[0].get_texts())
    for figure in (rates.draw_replan(runs), rates.draw_correlations(ours)):
        assert not any("of 30 tasks" in text.get_text() for text in figure.legends[0].get_texts())


def test_inputs_are_told_where_evaluations_differ_in_them(tmp_path: Path) -> None:
    pixels = logs.evaluation(tmp_path / "a", 2, inputs="pixels")
    objects = logs.evaluation(tmp_path / "b", 2, inputs="privileged object state")
    found = style.labels_of(style.entries_of(read_runs([f"a={pixels}", f"b={objects}"])))
    assert found["a", False] == "a\n(2 of 30 tasks, 8 rollouts)"
    assert found["b", False] == "b\n(2 of 30 tasks, 8 rollouts;\ninputs: privileged object state)"


def test_axes_that_apply_to_nobody_are_left_out() -> None:
    kept, _, _ = rates.normalised(style.published_entries("main"), style.TYPE_AXES)
    assert len(kept) == 13  # object has no U, C; procedural no C
    assert ("object", "MUR") not in kept


def test_a_radar_of_two_axes_is_refused(tmp_path: Path) -> None:
    from lerobot_memobench.envs.episode_log import write_episodes

    write_episodes(tmp_path, [logs.rollout("o", "object", "S", [True], True, 0)])
    ours = style.entries_of(read_runs([tmp_path]))
    with pytest.raises(MemobenchError, match="only 2 apply"):
        rates.draw_radar([("", ours)], style.AVERAGE_AXES)


# --- correlations ---


def test_the_papers_points_and_r() -> None:
    rows = style.published_entries("main")
    counts = {metric: len(rates.points(rows, metric)) for metric in ("MSR", "MUR", "MCR")}
    assert counts == {"MSR": 24 * 4, "MUR": 24 * 3, "MCR": 24 * 2}
    for metric in counts:
        pairs = [
            (figures[metric], figures["SR"])
            for row in published_rows("main")
            for figures in row.memory_types.values()
            if figures[metric] is not None
        ]
        x, y = np.array(pairs, dtype=float).T
        by_hand = np.sum((x - x.mean()) * (y - y.mean())) / np.sqrt(
            np.sum((x - x.mean()) ** 2) * np.sum((y - y.mean()) ** 2)
        )
        assert rates.pearson(rates.points(rows, metric)) == pytest.approx(by_hand)


@pytest.mark.parametrize(
    ("found", "r"),
    [
        ([(0, 0, "object"), (1, 2, "object"), (2, 4, "object")], 1.0),
        ([(0, 4, "object"), (1, 2, "object"), (2, 0, "object")], -1.0),
        ([(1, 0, "object"), (1, 2, "object"), (1, 4, "object")], None),
        ([(0, 0, "object"), (1, 1, "object")], None),
    ],
)
def test_pearson(found: Sequence[rates.Point], r: float | None) -> None:
    value = rates.pearson(found)
    assert value is None if r is None else value == pytest.approx(r)


def test_points_per_task(runs: list[Run]) -> None:
    found = rates.points(style.entries_of(runs), "MCR", by_task=True)
    assert found == [(25.0, 25.0, "spatial"), (75.0, 75.0, "spatial")]


# --- bars and curves ---


def test_bars_add_up(runs: list[Run]) -> None:
    found = rollouts.bars(runs)
    assert [bar.heading for bar in found] == ["all rollouts"] * 2 + ["temporal"] * 2 + ["spatial"] * 2
    assert found[0].parts[:3] == (("success", 2, ""), ("storage_failure", 0, ""), ("stale_memory", 3, ""))
    assert {bar.rollouts for bar in found} == {8, 4}
    assert rollouts.paper_bar().rollouts == 150


def test_prefix_panels(runs: list[Run]) -> None:
    one, two = rollouts.panels(runs)
    assert (one.title, one.operations, two.operations) == ("one", "SU", "SUC")
    assert one.curves[0].plain == (100.0, 25.0)
    assert one.curves[1].ordered == (100.0, 75.0)
    assert [panel.title for panel in rollouts.panels(runs, ["one"])] == ["one"]
    with pytest.raises(MemobenchError, match="'three' was not evaluated"):
        rollouts.panels(runs, ["three"])


def test_replan_curves(runs: list[Run]) -> None:
    ours, *theirs = rates.curves(runs, True, "average", "SR")
    assert ours[0] == "mine_$"
    assert ours[1] == [5, 20]
    assert [rate.value for rate in ours[2]] == [0.25, 0.75]
    assert len(theirs) == 6
    assert all(curve[1] == [5, 20, 35, 50] for curve in theirs)
    assert not rates.curves(runs, True, "object", "MCR")
    with pytest.raises(MemobenchError, match="several replan intervals"):
        rates.draw_replan(runs[:1])


# --- drawing ---


def test_every_outcome_has_a_look_of_its_own() -> None:
    assert list(style.OUTCOMES) == ["success", *FAILURES, *REFINED_FAILURES, *STRICT_FAILURES, *FAULTS]
    assert len({look.hatch for look in style.OUTCOMES.values()}) == len(style.OUTCOMES)


def test_methods_look_different_in_colour_and_in_grey() -> None:
    looks = list(style.looks_of((f"method {k}", False) for k in range(11)).values())
    for values in ([x.colour for x in looks], [x.marker for x in looks], [str(x.dashes) for x in looks]):
        assert len(set(values)) == 11
    many = style.looks_of((str(k), False) for k in range(30)).values()
    assert len({(x.colour, x.marker, str(x.dashes)) for x in many}) == 30
    assert not {x.colour for x in looks} & set(style.OPERATION_COLOURS.values())


def test_names_are_set_literally_but_for_the_models() -> None:
    assert style.literal("π0.5 + $x_1$") == r"$\pi_{0.5}$ + \$x_1\$"


@pytest.mark.parametrize("name", ["radar", "correlations", "failures", "prefix", "replan"])
def test_every_figure_of_ours_beside_the_papers(name: str, runs: list[Run], tmp_path: Path) -> None:
    ours, theirs = style.entries_of(runs), style.published_entries("main")
    drawn = {
        "radar": lambda: rates.draw_radar([("both", [*ours, *theirs])], style.AVERAGE_AXES),
        "correlations": lambda: rates.draw_correlations([*ours, *theirs]),
        "failures": lambda: rollouts.draw_failures([*rollouts.bars(runs), rollouts.paper_bar()]),
        "prefix": lambda: rollouts.draw_prefix([*rollouts.panels(runs), rollouts.paper_panel()]),
        "replan": lambda: rates.draw_replan(runs, paper=True),
    }[name]()
    (path,) = style.save(drawn, tmp_path / "out" / f"{name}.png", name)
    from PIL import Image

    with Image.open(path) as image:
        colours = image.convert("RGB").getcolors(1_000_000)
    assert colours is not None
    assert len(colours) > 20
    assert [p.name for p in path.parent.iterdir()] == [path.name]


def test_a_folder_gets_pdf_and_png_and_the_same_figure_the_same_pdf(tmp_path: Path) -> None:
    bars = [rollouts.paper_bar()]
    first = style.save(rollouts.draw_failures(bars), tmp_path / "a", "f")
    again = style.save(rollouts.draw_failures(bars), tmp_path / "b", "f")
    assert [path.name for path in first] == ["f.pdf", "f.png"]
    assert first[0].read_bytes() == again[0].read_bytes()
    with pytest.raises(MemobenchError, match=r"\.gif"):
        style.save(rollouts.draw_failures(bars), tmp_path / "f.gif", "f")


def test_long_titles_are_wrapped_and_not_cut() -> None:
    """Tasks differ at their titles' ends: no bar and no panel loses its own."""
    title = " ".join(["put the first thing into the top drawer"] * 3)
    bars = rollouts.draw_failures([rollouts.Bar(title, "mine", (("success", 1, ""),))])
    panel = rollouts.draw_prefix([rollouts.Panel(title, "SC", (rollouts.Curve("mine", (50.0, 25.0)),))])
    told = bars.axes[0].get_yticklabels()[0].get_text(), panel.axes[0].get_title()
    assert [" ".join(one.split()) for one in told] == [f"{title} mine", title]
    assert {"S: storage", "C: compression"} < {text.get_text() for text in panel.legends[0].get_texts()}


def test_a_figure_tells_how_much_was_run_and_what_was_seen(runs: list[Run]) -> None:
    told = style.caption(runs, paper=True)
    assert told.count("2 tasks, 8 rollouts, inputs: ") == 2
    assert told.endswith("paper: 30 tasks, 1,500 rollouts each, inputs: pixels")
