"""What the demo makes of an evaluation; the evaluation itself is LeRobot's and is replaced here."""

from __future__ import annotations

from pathlib import Path

import av
import numpy as np
import pytest
from PIL import Image

from lerobot_memobench.envs.episode_log import write_episodes
from lerobot_memobench.envs.video import LAST_FRAMES, VideoRecorder
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.evaluation.html.write import write_html
from lerobot_memobench.run import demo
from lerobot_memobench.run.demo import FAILED, SOLVED, STRIP_WIDTH, TITLE, joined, read_video, side_by_side, strip
from lerobot_memobench.tasks.catalogue import BOWL, get_task
from tests.support.logs import rollout


def write_video(path: Path, frames: int = 12) -> None:
    """A video whose brightness rises from black to white."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with av.open(str(path), "w") as container:
        stream = container.add_stream("mpeg4", rate=20)
        stream.width, stream.height, stream.pix_fmt = 128, 64, "yuv420p"
        for k in range(frames):
            image = np.full((64, 128, 3), 255 * k // (frames - 1), dtype=np.uint8)
            container.mux(stream.encode(av.VideoFrame.from_ndarray(image, format="rgb24")))
        container.mux(stream.encode())


def fake_evaluation(output: Path) -> None:
    for name in demo.TASKS:
        write_video(output / "videos" / f"{name}.0.mp4")
    for name in ("episodes.jsonl", "report.json", "report.md", "evaluation.json"):
        (output / name).write_text(name)


def fake_comparison(work: Path, made: Path) -> None:
    made.mkdir(parents=True)
    for name in (demo.MEMORY_VIDEO, demo.MEMORY_STRIP, demo.MEMORY_TABLE):
        (made / name).write_text(name)


def test_one_task_of_each_memory_type() -> None:
    assert [get_task(name).memory_type for name in demo.TASKS] == ["temporal", "spatial", "object", "procedural"]


def test_the_demo_folder(tmp_path: Path) -> None:
    out = tmp_path / "outputs" / "demo"
    (out / "videos").mkdir(parents=True)
    (out / "videos" / "old.mp4").write_text("")
    (out / "notes.txt").write_text("the user's own")
    with pytest.raises(MemobenchError, match="no earlier demo"):
        demo.make_demo(out, fake_evaluation, fake_comparison)
    assert (out / "videos" / "old.mp4").exists()
    (out / demo.CONTACT_SHEET).touch()
    demo.make_demo(out, fake_evaluation, fake_comparison)
    assert {path.name for path in out.iterdir()} == {*demo.PRODUCTS, "notes.txt"}
    assert {path.name for path in (out / "videos").iterdir()} == {f"{name}.0.mp4" for name in demo.TASKS}
    with Image.open(out / "contact_sheet.png") as sheet:
        pixels = np.asarray(sheet.convert("L")).astype(int)
    assert pixels.shape == (4 * 160, demo.FRAMES_PER_VIDEO * demo.COLUMN_WIDTH)
    means = pixels[:160].reshape(160, demo.FRAMES_PER_VIDEO, -1).mean(axis=(0, 2))
    assert (np.diff(means) > 20).all()  # evenly spaced in time, left to right
    assert (means[0] < 20, means[-1] > 235) == (True, True), "both ends are there"


def test_the_html_report_finds_the_demos_films(tmp_path: Path) -> None:
    def evaluate(output: Path) -> None:
        fake_evaluation(output)
        (output / "episodes.jsonl").unlink()
        write_episodes(output, [rollout(name, "temporal", "", [], True, 0) for name in demo.TASKS])

    demo.make_demo(tmp_path / "demo", evaluate, fake_comparison)
    (tmp_path / "demo" / "evaluation.json").unlink()  # of a fake evaluation: none
    written = write_html([tmp_path / "demo"], tmp_path / "html")
    assert written.videos == len(demo.TASKS)
    assert not written.notes


def fail(*where: object) -> None:
    raise MemobenchError("the weights cannot be loaded")


def test_a_failed_evaluation_leaves_the_earlier_demo(tmp_path: Path) -> None:
    (tmp_path / demo.CONTACT_SHEET).write_text("earlier")
    with pytest.raises(MemobenchError, match="the weights cannot be loaded"):
        demo.make_demo(tmp_path, fail, fake_comparison)
    assert [path.name for path in tmp_path.iterdir()] == [demo.CONTACT_SHEET]


def test_a_failed_comparison_leaves_the_earlier_demo(tmp_path: Path) -> None:
    (tmp_path / demo.CONTACT_SHEET).write_text("earlier")
    with pytest.raises(MemobenchError, match="the weights cannot be loaded"):
        demo.make_demo(tmp_path, fake_evaluation, lambda *where: demo.compare_memories(*where, fail))
    assert [path.name for path in tmp_path.iterdir()] == [demo.CONTACT_SHEET]


def test_the_memories_are_compared_on_the_same_episodes(tmp_path: Path) -> None:
    wrong, other = "reference_drift", "storage_failure"
    failed = {"expert": {}, "with memory": {3: wrong}, "without memory": {1: wrong, 2: wrong, 3: other}}

    def evaluate(name: str, folder: Path) -> None:
        ends = [failed[name].get(k) for k in range(5)]
        write_episodes(
            folder, [rollout(BOWL, "object", "S", [not end], not end, k, failure=end) for k, end in enumerate(ends)]
        )
        write_video(folder / "videos" / f"{BOWL}.1.mp4")  # the first on which they differ

    told = demo.compare_memories(tmp_path / "work", tmp_path / "made", evaluate)
    assert [one.solved for one in told.values()] == [
        (True, True, True, True, True),
        (True, True, True, False, True),
        (True, False, False, False, True),
    ]
    assert "| without memory | 2/5 | 2 |" in (tmp_path / "made" / demo.MEMORY_TABLE).read_text()
    frames = demo.read_video(tmp_path / "made" / demo.MEMORY_VIDEO)
    assert frames[0].shape[1] == 3 * 128, "three films side by side"


def test_what_is_compared_differs_in_the_policy_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(demo, "plan_line", lambda words: words)
    told = [demo.memory_plan(name, tmp_path) for name in demo.POLICIES]
    others = [[word for word in words if not word.startswith("policy=")] for words in told]
    assert others[0] == others[1] == others[2]
    assert [len(words) - len(rest) for words, rest in zip(told, others, strict=True)] == [0, 1, 1]


def test_without_trained_policies_the_demo_is_the_experts(tmp_path: Path) -> None:
    for name in (demo.MEMORY_TABLE, demo.CONTACT_SHEET):
        (tmp_path / name).write_text("of an earlier demo")
    demo.make_demo(tmp_path, fake_evaluation, None)
    assert not {path.name for path in tmp_path.iterdir()} & {demo.MEMORY_VIDEO, demo.MEMORY_TABLE}


def test_a_missing_video_is_named(tmp_path: Path) -> None:
    with pytest.raises(MemobenchError, match=demo.TASKS[0]):
        demo.collect_videos(tmp_path, tmp_path / "videos")


HEIGHT, WIDTH = 32, 64


@pytest.fixture
def films(tmp_path: Path) -> dict[str, tuple[Path, bool]]:
    """A grey film of five frames that is solved, and a bright one of nine that is not."""
    found = {}
    for name, shade, length, solved in (("with", 60, 5, True), ("without", 200, 9, False)):
        film = VideoRecorder(tmp_path / f"{name}.mp4")
        for _ in range(length):
            film.add(np.full((HEIGHT, WIDTH, 3), shade, np.uint8))
        path = film.finish()
        assert path is not None
        found[name] = (path, solved)
    return found


def coloured(picture: np.ndarray, colour: tuple[int, int, int]) -> bool:
    return bool((picture == colour).all(axis=-1).any())


def test_films_stand_side_by_side_and_say_how_they_ended(films: dict[str, tuple[Path, bool]], tmp_path: Path) -> None:
    frames = list(joined(films))
    assert len(frames) == 9 + LAST_FRAMES
    assert frames[0].shape == (TITLE + HEIGHT, 2 * WIDTH, 3)
    left, right = frames[0][TITLE:, :WIDTH], frames[0][TITLE:, WIDTH:]
    assert abs(float(left.mean()) - 60) < 4
    assert abs(float(right.mean()) - 200) < 4
    ends = [[coloured(frame[:TITLE], colour) for frame in frames] for colour in (SOLVED, FAILED)]
    assert [end.index(True) for end in ends] == [5 + LAST_FRAMES - 1, 9 + LAST_FRAMES - 1]
    written = read_video(side_by_side(films, tmp_path / "both.mp4"))
    assert len(written) == len(frames) + LAST_FRAMES


def test_a_film_that_cannot_be_read_leaves_nothing(films: dict[str, tuple[Path, bool]], tmp_path: Path) -> None:
    out = tmp_path / "new" / "both.mp4"
    broken = tmp_path / "broken.mp4"
    broken.write_bytes(b"no film")
    with pytest.raises(Exception, match="Invalid data"):
        side_by_side({**films, "broken": (broken, False)}, out)
    assert not out.exists()


def test_a_strip_has_a_row_per_film(films: dict[str, tuple[Path, bool]]) -> None:
    picture = np.asarray(strip(films))
    assert picture.shape == (2 * (TITLE + STRIP_WIDTH * HEIGHT // WIDTH), 6 * STRIP_WIDTH, 3)
    half = len(picture) // 2
    assert coloured(picture[:TITLE], SOLVED)
    assert coloured(picture[half : half + TITLE], FAILED)
