"""What a run says of how far it is."""

from __future__ import annotations

import io

from rich.console import Console

from lerobot_memobench.cli.console import counting


def test_a_log_file_tells_the_time_left_by_this_run_alone() -> None:
    now, written = 0.0, io.StringIO()
    screen = Console(file=written, width=140, get_time=lambda: now)
    with counting(screen, "episodes") as count:
        for done in range(1, 5):
            count(done, 10, f"episode {done}", found=4)
        for done in range(5, 8):
            now += 2.0
            trouble = "it slipped" if done == 6 else None
            count(done, 10, f"episode {done}", trouble=trouble, found=4)
    assert written.getvalue().splitlines() == [
        "4/10 are there already",
        "5/10 episode 5",
        "episode 6: it slipped",
        "7/10 episode 7, 0:00:06 left",
    ]


def test_a_terminal_shows_a_bar_and_names_only_troubles() -> None:
    written = io.StringIO()
    screen = Console(file=written, width=100, force_terminal=True, highlight=False)
    with counting(screen, "episodes", 2) as count:
        count(1, 2, "a task, seed 1")
        count(2, 2, "a task, seed 2", trouble="it slipped")
    printed = written.getvalue()
    assert "2/2" in printed
    assert "a task, seed 2: it slipped" in printed
    assert "seed 1" not in printed
