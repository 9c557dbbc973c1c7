"""The study, on pictures drawn by hand and compared as an eye does; a few real tasks without memory and with."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.sim.simulation import Simulation
from lerobot_memobench.tasks.catalogue import get_task
from lerobot_memobench.tasks.task import Task
from research.necessity.__main__ import main
from research.necessity.demonstrations import Demonstration, Frame, Picture, difference, pairwise_table, unmatched
from research.necessity.exploration import Laboratory, search
from research.necessity.report import markdown, rows, verdict, write
from research.necessity.scene import PIXEL_EXACT
from research.necessity.settings import Settings, variants_of
from research.necessity.study import Result, Study, pictures_path


def scene(**changes: Any) -> Picture:
    """A grey wall with a red square of 10 pixels, moved by (dy, dx), or gone."""
    picture = np.full((64, 64, 3), 128, dtype=np.uint8)
    if not changes.get("gone"):
        y, x = 20 + changes.get("dy", 0), 30 + changes.get("dx", 0)
        picture[y : y + 10, x : x + 10] = changes.get("colour", (200, 30, 30))
    return picture


# --- pictures ---


def test_equal_pictures_have_nothing_unmatched() -> None:
    assert unmatched(scene(), scene()) == 0.0
    assert unmatched(scene(), scene(colour=(200, 40, 40))) == 0.0, "a shade is no difference"


@pytest.mark.parametrize("shift", [{"dy": 2}, {"dx": -2}, {"dy": 1, "dx": 2}])
def test_what_moved_by_two_pixels_looks_the_same(shift: dict[str, int]) -> None:
    assert unmatched(scene(), scene(**shift)) == 0.0


def test_what_moved_further_or_went_does_not() -> None:
    # Of a square moved by 6: 4 rows of red have no red near them, and of the wall now covered 4 rows of 6 no wall.
    assert unmatched(scene(), scene(dy=6)) * 64 * 64 == 4 * 10 + 4 * 6
    # Of one that is gone: all its red; the wall behind it counts in the other direction, where it is less.
    assert unmatched(scene(), scene(gone=True)) * 64 * 64 == 100
    assert unmatched(scene(gone=True), scene()) == unmatched(scene(), scene(gone=True))


def test_differences_are_of_the_camera_that_differs_most() -> None:
    frames = [(scene(), scene()), (scene(), scene(gone=True)), (scene(gone=True), scene(dy=6))]
    table = pairwise_table(frames, difference)
    assert table[0, 1] == pytest.approx(100 / 4096)
    assert table[0, 2] == pytest.approx(100 / 4096)
    assert np.array_equal(table, table.T)
    assert not table.diagonal().any()


def as_numpy_says(a: Picture, b: Picture, shift: int, colour: int) -> float:
    """`unmatched`, written without a thought of speed."""
    worst = 0
    for here, there in ((a.astype(int), b.astype(int)), (b.astype(int), a.astype(int))):
        padded = np.pad(there, ((shift, shift), (shift, shift), (0, 0)), mode="edge")
        height, width, _ = here.shape
        near = [
            np.abs(padded[dy : dy + height, dx : dx + width] - here).max(axis=-1) <= colour
            for dy in range(2 * shift + 1)
            for dx in range(2 * shift + 1)
        ]
        worst = max(worst, int((~np.any(near, axis=0)).sum()))
    return worst / a.shape[0] / a.shape[1]


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize(("shift", "colour"), [(0, 24), (1, 60), (2, 24)])
def test_pictures_are_compared_pixel_by_pixel_as_numpy_would(seed: int, shift: int, colour: int) -> None:
    rng = np.random.default_rng(seed)
    a = rng.integers(0, 256, (30, 20, 3), dtype=np.uint8)
    b = np.where(rng.random((30, 20, 1)) < 0.5, a, np.roll(a, 1, axis=seed % 2)).astype(np.uint8)
    b[:5, :5] = rng.integers(0, 256, (5, 5, 3))
    found = unmatched(a, b, shift, colour)
    assert found == as_numpy_says(a, b, shift, colour)
    assert found > 0


# --- the study ---

STRICT_STOVE = "turn_the_stove_on_and_off_a_given_number_of_times"
PAN = "turn_on_the_stove_and_turn_it_off_then_put_the_frying_pan_on_it"
STACK = "stack_the_bowls_one_by_one_in_the_exact_sequence_shown_in_the_video"
MILK = "put_the_milk_from_the_highlighted_location_in_the_prompt_video_on_the_plate"


def study(task: Task, referent: str, settings: Settings, out: Path) -> Result:
    return Study(task, referent, settings, out).result()


def demonstration(*frames: tuple[str, Picture, float], success: bool = True) -> Demonstration:
    """Decisions with the picture at home, and where the hand was."""
    return Demonstration(
        tuple(
            Frame(answer, 10 * k, (picture,), (picture,), np.full(8, hand, dtype=np.float32))
            for k, (answer, picture, hand) in enumerate(frames)
        ),
        success,
        100,
    )


def by_hand(monkeypatch: pytest.MonkeyPatch, shown: dict[int, Demonstration]) -> None:
    monkeypatch.setattr(
        "research.necessity.study.follow",
        lambda task, sim, seed, horizon: shown[task.variant_index],
    )
    monkeypatch.setattr("lerobot_memobench.sim.simulation.Simulation", lambda task: None)


def test_a_picture_met_twice_in_an_episode_is_found(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    by_hand(
        monkeypatch, {0: demonstration(("on", scene(), 0.0), ("off", scene(gone=True), 0.1), ("pan", scene(dy=1), 0.2))}
    )
    result = study(get_task(PAN), "fixed", Settings(episodes=2, budget=0), tmp_path)
    assert result["in_order"] == {
        "chance": 0.25,
        "deterministic": 0.0,
        "stochastic": pytest.approx(0.25),
        "pixel_exact": 1.0,  # a pixel of difference, if it could be used
        "as_it_happens": 1.0,  # the hand is elsewhere
        "with_step": 1.0,
    }
    assert result["aliased"] == {"at_home": 1, "pixel_exact": 0, "as_it_happens": 0, "with_step": 0}
    assert result["expert"] == {"n": 2, "success": 2}
    assert [result["examples"][0][side]["answer"] for side in "ab"] == ["on", "pan"]
    assert verdict(result) == "no", "observations with the hand decide"
    files = write(tmp_path, [result])
    assert [path.name for path in files] == ["necessity.json", "necessity.md", "aliased_pairs.png"]
    assert "| 25.0 / 0.0 / 25.0 / 100.0 |" in files[1].read_text()


@pytest.mark.parametrize(("task", "expected"), [(PAN, "clock"), (STRICT_STOVE, "open")])
def test_a_step_counter_decides_where_no_hold_blurs_it(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, task: str, expected: str
) -> None:
    """The same picture with the hand at the same place asks for two answers, at steps 0 and 20."""
    shown = demonstration(("on", scene(), 0.0), ("off", scene(gone=True), 0.1), ("pan", scene(), 0.0))
    by_hand(monkeypatch, dict.fromkeys(range(3), shown))
    result = study(get_task(task), "drawn" if task == STRICT_STOVE else "fixed", Settings(1, budget=0), tmp_path)
    assert result["in_order"]["as_it_happens"] == 0.0
    assert result["in_order"]["with_step"] == float(expected == "clock")
    assert verdict(result) == expected


def test_results_that_name_a_path_lead_to_no_picture(tmp_path: Path) -> None:
    """A result's names come from a file; a picture from elsewhere would be drawn into the figure."""
    with pytest.raises(MemobenchError, match=r"is '\.\./\.\./secret\.fixed\.7\.png', which names no file"):
        pictures_path(tmp_path, "../../secret", "fixed", 7)


def test_goals_behind_one_picture_are_weighed_together(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    task = get_task(STACK)
    assert len(variants_of(task, "random")) == 6
    assert variants_of(task, "fixed") == [task]
    shown = {
        k: demonstration((f"first {k}", scene(), 0.0), ("then", scene(dy=4 * k + 4, dx=4 * k), 0.1)) for k in range(5)
    }
    shown[5] = demonstration(("fumble", scene(), 0.0), success=False)
    by_hand(monkeypatch, shown)
    result = study(task, "random", Settings(episodes=1, budget=0), tmp_path)
    assert result["expert"] == {"n": 6, "success": 5}
    assert result["in_order"]["chance"] == pytest.approx(1 / 5), "a failed demonstration teaches no answer"
    assert result["in_order"]["deterministic"] == pytest.approx(1 / 5)
    assert result["in_order"]["as_it_happens"] == pytest.approx(1 / 5), "the arm is at home when the prompt ends"


def test_what_the_instruction_says_can_be_told_apart(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """The same picture asks for other answers under other instructions: that needs no memory, stopping in time does."""
    task = get_task("turn_the_stove_on_and_off_a_given_number_of_times")
    dark, lit = scene(), scene(gone=True)
    on_off = [("on", dark, 0.0), ("off", lit, 0.1)]
    by_hand(monkeypatch, {k: demonstration(*on_off * (k + 1), ("rest", dark, 0.0)) for k in range(3)})
    result = study(task, "drawn", Settings(episodes=1, budget=0), tmp_path)
    assert result["aliased"] == {"at_home": 3, "pixel_exact": 3, "as_it_happens": 3, "with_step": 3}
    assert result["in_order"]["stochastic"] == pytest.approx((1 / 4 + 4 / 27 + 27 / 256) / 3)
    assert result["in_order"]["as_it_happens"] == 0.0
    other = {k: demonstration((f"take {k}", dark, 0.0)) for k in range(3)}
    by_hand(monkeypatch, other)
    result = study(task, "drawn", Settings(episodes=1, budget=0, tolerance=0.01), tmp_path)
    assert (result["aliased"]["at_home"], verdict(result)) == (0, "no")


def test_an_expert_that_fails_leaves_no_figure(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    by_hand(monkeypatch, {0: demonstration(("on", scene(), 0.0), success=False)})
    result = study(get_task(PAN), "fixed", Settings(episodes=1), tmp_path)
    assert (result["in_order"], result["any_order"], verdict(result)) == (None, None, "unknown")
    assert "unknown" in markdown([result])


def test_scenes_are_kept_and_more_are_added(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    seen: list[int] = []
    one = demonstration(("on", scene(), 0.0), ("off", scene(gone=True), 0.1))

    def follow(task: Any, sim: Any, seed: int, horizon: int) -> Demonstration:
        seen.append(seed)
        return one

    monkeypatch.setattr("research.necessity.study.follow", follow)
    monkeypatch.setattr("lerobot_memobench.sim.simulation.Simulation", lambda task: None)
    task = get_task(PAN)
    first = study(task, "fixed", Settings(episodes=1), tmp_path)
    assert verdict(first) == "no"
    study(task, "fixed", Settings(episodes=3), tmp_path)
    study(task, "fixed", Settings(episodes=3), tmp_path)
    assert seen == [7, 8, 9]
    study(task, "fixed", Settings(episodes=1, tolerance=0.01), tmp_path)
    assert seen == [7, 8, 9, 7], "another tolerance is another question"
    damaged = next(path for path in (tmp_path / "results").iterdir() if path.name.endswith(".8.json"))
    damaged.write_text(damaged.read_text()[:40])
    study(task, "fixed", Settings(episodes=2, tolerance=0.01), tmp_path)
    assert seen == [7, 8, 9, 7, 8]


def test_a_task_with_one_goal_has_one_row(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    by_hand(monkeypatch, {0: demonstration(("on", scene(), 0.0))})
    result = study(get_task(PAN), "fixed", Settings(episodes=1), tmp_path)
    ((memory_type, task, cells),) = rows([result])
    assert (memory_type, task, cells[0]) == ("temporal", PAN, "both")
    # Of one with variants, the published goal is the fixed setting only.
    result = study(get_task(MILK), "fixed", Settings(episodes=1), tmp_path)
    assert rows([result])[0][2][0] == "fixed"


def test_the_command_shows_a_table_and_names_its_files(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    shown = {k: demonstration((f"take {k}", scene(), 0.0)) for k in range(2)}
    by_hand(monkeypatch, shown)
    words = ["--tasks", f"{PAN},{MILK}", "--episodes", "1", "--budget", "0", "--out", str(tmp_path)]
    assert main(words) == 0
    out = capsys.readouterr().out
    assert "3/3 scene of" in out, "the stove once, the milk under both settings"
    assert all(str(tmp_path / name) in out for name in ("necessity.json", "necessity.md", "aliased_pairs.png"))
    results = json.loads((tmp_path / "necessity.json").read_text())
    assert [(r["referent"], r["memory_needed"]) for r in results] == [
        ("fixed", "no"),
        ("fixed", "no"),
        ("random", "open"),
    ]


# --- the simulator ---


@pytest.mark.slow
def test_stove_and_pan_in_the_simulator(tmp_path: Path) -> None:
    """The dark stove asks for two answers; putting the pan on the lit burner is a way that needs no memory."""
    result = study(get_task(PAN), "fixed", Settings(episodes=1, budget=3000), tmp_path)
    assert result["expert"] == {"n": 1, "success": 1}
    assert result["in_order"]["chance"] == 0.25
    assert result["in_order"]["deterministic"] == 0.0
    (example, *_) = result["examples"]
    assert example["difference"] == 0.0, "the stove looks as it did"
    assert result["in_order"]["pixel_exact"] == 1.0, "some pixels differ, if a policy could use them"
    assert example["largest_pixel_difference"] > PIXEL_EXACT
    assert result["in_order"]["as_it_happens"] == 1.0, "and the pose of the hand differs"
    assert verdict(result) == "no"
    found = search(Laboratory([get_task(PAN)], Simulation(get_task(PAN)), 7), Settings(1, budget=3000))
    assert (found["deterministic"], found["confirmed"], found["complete"]) == (1.0, 1, True)


@pytest.mark.slow
def test_two_cartons_in_the_simulator(tmp_path: Path) -> None:
    """Which carton was highlighted cannot be seen when the policy may act, and a wrong one stays on the plate."""
    result = study(get_task(MILK), "random", Settings(episodes=1, budget=1500), tmp_path)
    assert result["in_order"]["chance"] == 0.5
    assert result["in_order"]["deterministic"] == 0.5
    assert result["any_order"]["deterministic"] == 0.5
    assert verdict(result) == ("cut off" if result["any_order"]["cut_off"] else "not found")
    fixed = study(get_task(MILK), "fixed", Settings(episodes=1, budget=1500), tmp_path)
    assert fixed["in_order"]["deterministic"] == 1.0
    assert verdict(fixed) == "no"


@pytest.mark.slow
def test_counting_in_the_simulator(tmp_path: Path) -> None:
    """The dark stove comes back with the hand at home; who does not count stops by chance, and no map ever stops."""
    task = get_task("turn_the_stove_on_and_off_a_given_number_of_times")
    result = study(task, "drawn", Settings(episodes=1), tmp_path)
    assert result["expert"] == {"n": 3, "success": 3}
    assert result["in_order"]["deterministic"] == result["in_order"]["as_it_happens"] == 0.0
    found = result["any_order"]
    assert (found["deterministic"], found["complete"]) == (0.0, True)
    assert 1 / 6 < found["stochastic"] < 1 / 4
    assert verdict(result) == ("cut off" if found["cut_off"] else "not found")


@pytest.mark.slow
def test_a_hidden_thing_in_the_simulator(tmp_path: Path) -> None:
    """Three starts look the same, and a wrong drawer ends the search for the thing."""
    task = get_task("find_the_artichoke_hidden_in_one_of_the_drawers")
    result = study(task, "drawn", Settings(episodes=1), tmp_path)
    assert result["expert"] == {"n": 3, "success": 3}
    assert result["in_order"]["as_it_happens"] == pytest.approx(1 / 3)
    found = result["any_order"]
    assert (found["confirmed"], found["of"], found["exhausted"]) == (1, 3, True)
    assert found["deterministic"] == found["stochastic"] == pytest.approx(1 / 3)
    assert verdict(result) == "not found"
