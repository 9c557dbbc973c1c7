from __future__ import annotations

import numpy as np
import pytest

from lerobot_memobench.datasets.labels import labels
from lerobot_memobench.datasets.language import persistent_rows


def rows_of(demo, style):
    return [(row["timestamp"], row["content"]) for row in persistent_rows(labels(demo)) if row["style"] == style]


def test_rows_follow_the_text_columns(make_demo):
    demo = make_demo(["0" * 10 + "1" * 30, "0" * 30 + "1" * 10])
    f32 = [float(np.float32(frame / 20)) for frame in (0, 11, 31)]
    assert rows_of(demo, "subtask") == [(f32[0], "did thing 0"), (f32[1], "did thing 1")]
    assert rows_of(demo, "memory") == [(f32[1], "did thing 0"), (f32[2], "did thing 0; did thing 1")]


def test_rows_are_what_lerobots_writer_accepts(make_demo):
    writer = pytest.importorskip("lerobot.annotations.steerable_pipeline.writer")
    rows = persistent_rows(labels(make_demo(["0" * 10 + "1" * 30, "0" * 30 + "1" * 10])))
    # Its only objection is that nothing is "" and [] here, for lerobot-dataset-viz's sake, and not None.
    assert all((row["camera"], row["tool_calls"]) == ("", []) for row in rows)
    nothing = {"camera": None, "tool_calls": None}
    assert [writer._normalize_persistent_row(row | nothing) for row in rows] == [row | nothing for row in rows]
    assert sorted(rows, key=writer._row_persistent_sort_key) == rows


def test_short_lived_texts_get_no_row(make_demo):
    # Checkpoints 0 and 1 complete two frames apart: "did thing 1" is worked on for 0.1 s only.
    demo = make_demo(["0" * 10 + "1" * 30, "0" * 12 + "1" * 28, "0" * 30 + "1" * 10])
    assert [text for _, text in rows_of(demo, "subtask")] == ["did thing 0", "did thing 2"]
    memory = rows_of(demo, "memory")
    assert [text for _, text in memory] == [
        "did thing 0; did thing 1",
        "did thing 0; did thing 1; did thing 2",
    ]
    assert memory[0][0] == float(np.float32(13 / 20))  # its own time: nothing is remembered too early


def test_a_text_is_active_from_the_first_frame_on(make_demo):
    demo = make_demo(["0100000000", "0001111111"])
    assert rows_of(demo, "subtask") == [(0.0, "did thing 1")]


def test_lerobots_resolvers_never_find_two_rows(make_demo):
    render = pytest.importorskip("lerobot.datasets.language_render")
    rng = np.random.default_rng(3)
    for _ in range(50):
        table = np.zeros((3, 30), dtype=int)
        for k in range(3):
            table[k, int(rng.integers(1, 30)) :] = 1
        demo = make_demo(["".join(map(str, row)) for row in table])
        rows = persistent_rows(labels(demo))
        for t in np.float32(np.arange(30) / 20).tolist():
            for style in ("subtask", "memory"):
                render.emitted_at(t, persistent=rows, events=[], style=style)
                active = render.active_at(t, persistent=rows, style=style)
                assert style == "memory" or active is not None
