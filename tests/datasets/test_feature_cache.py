"""The feature cache: contents, going on after a kill, waiting for others, full disks, refusing what does not fit."""

from __future__ import annotations

import json
import logging
import shutil
import subprocess
import threading
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import pytest
import torch

from lerobot_memobench.datasets.feature_cache import building
from lerobot_memobench.datasets.feature_cache.building import build_feature_cache
from lerobot_memobench.datasets.feature_cache.frames import resolve_subgoals
from lerobot_memobench.datasets.feature_cache.layout import (
    FOLDER,
    check_cache,
    dataset_fingerprint,
    find_cache,
    read_meta,
)
from lerobot_memobench.datasets.feature_cache.reading import FeatureCache
from lerobot_memobench.errors import MemobenchError
from tests.support import synthetic_dataset
from tests.support.kills import hashes, killed_at

CAMERA = "observation.images.image"
SUBGOALS_1 = "open the top drawer; put the bowl in the drawer"


class _Frames:
    """Four tokens per frame that hold the frame's mean brightness; counts its frames, or stops like a killed run."""

    tokens_per_frame, dim = 4, 3

    def __init__(self, key: str = "tower", stop_after: int | None = None) -> None:
        self.key, self.stop_after, self.seen = key, stop_after, 0

    def __call__(self, images: torch.Tensor) -> torch.Tensor:
        if self.stop_after is not None and self.seen >= self.stop_after:
            raise KeyboardInterrupt
        self.seen += len(images)
        return images.mean(dim=(1, 2, 3))[:, None, None].expand(-1, 4, 3).to(torch.bfloat16)


class _WideFrames(_Frames):
    """16 KiB per frame: 1.5 MB in all."""

    dim = 2048

    def __call__(self, images: torch.Tensor) -> torch.Tensor:
        return super().__call__(images)[..., :1].expand(-1, -1, self.dim)


class _HeldFrames(_Frames):
    """Waits in its first pass until it is let go."""

    def __init__(self) -> None:
        super().__init__()
        self.begun, self.go = threading.Event(), threading.Event()

    def __call__(self, images: torch.Tensor) -> torch.Tensor:
        self.begun.set()
        assert self.go.wait(60)
        return super().__call__(images)


class _Texts:
    dim = 5

    def __init__(self, key: str = "texts") -> None:
        self.key = key

    def __call__(self, texts: Sequence[str]) -> torch.Tensor:
        return torch.tensor([[float(len(text))] * 5 for text in texts])


@pytest.fixture(scope="module")
def original(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return synthetic_dataset.make_dataset(tmp_path_factory.mktemp("cache") / "data")


@pytest.fixture
def root(original: Path, tmp_path: Path) -> Path:
    shutil.copytree(original, tmp_path / "data")
    return tmp_path / "data"


def _open(root: Path, **changes: object) -> FeatureCache:
    wanted = {"frames_key": "tower", "camera": CAMERA, "stride": 1, "texts_key": "texts"} | changes
    return FeatureCache.open(root, "test", **wanted)  # type: ignore[arg-type]


def _frame(root: Path, episode: int, frame: int) -> torch.Tensor:
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    dataset = LeRobotDataset("x/y", root=root)
    return dataset[dataset.meta.episodes["dataset_from_index"][episode] + frame][CAMERA]


def test_contents(root: Path) -> None:
    calls: list[tuple[int, int]] = []
    folder = build_feature_cache(
        root, "test", _Frames(), _Texts(), batch_size=7, progress=lambda *done: calls.append(done)
    )
    assert folder == root / FOLDER / "test"
    assert calls == [(0, 3), (1, 3), (2, 3), (3, 3)]
    cache = _open(root)
    assert cache.num_frames == sum(synthetic_dataset.LENGTHS)
    assert np.diff(cache.episodes).tolist() == list(synthetic_dataset.LENGTHS)
    assert cache.locate(0) == (0, 0)
    assert cache.locate(40) == (1, 0)
    assert cache.locate(93) == (2, 30)
    tokens = cache.tokens(1, [0, 22, 5])
    assert tokens.shape == (3, 4, 3)
    assert tokens.dtype == torch.bfloat16
    expected = torch.stack([_frame(root, 1, frame).mean() for frame in (0, 22, 5)]).to(torch.bfloat16)
    torch.testing.assert_close(tokens[:, 0, 0], expected)
    assert cache.phase[40:50].tolist() == [0] * 8 + [1] * 2
    assert cache.phase[:40].all()
    rows = cache.text_rows("intermediate")
    first = cache.texts[rows[0]]
    assert first == "pick up the cream cheese"
    assert float(cache.text_embeddings[rows[0], 0]) == len(first)
    assert cache.texts[rows[3]] == first  # frame 3 has no text: the next frame's counts
    assert cache.texts[cache.text_rows("fine")[0]].endswith("(0.1, 0.2)")
    assert cache.texts[cache.text_rows("coarse")[0]] == "pick it"
    assert cache.memory_texts([0, 39, 62]) == ["", "pick up the cream cheese", SUBGOALS_1]
    with pytest.raises(MemobenchError, match="outside"):
        cache.locate(94)


def test_stride(root: Path) -> None:
    frames = _Frames()
    build_feature_cache(root, "test", frames, _Texts(), stride=4)
    assert frames.seen == 10 + 6 + 8
    cache = _open(root, stride=4)
    expected = _frame(root, 2, 28).mean().to(torch.bfloat16)
    torch.testing.assert_close(cache.tokens(2, [7])[0, 0, 0], expected)


def test_a_finished_cache_is_left_alone_and_moves_with_its_dataset(root: Path, tmp_path: Path) -> None:
    build_feature_cache(root, "test", _Frames(), _Texts())
    again = _Frames()
    build_feature_cache(root, "test", again, _Texts())
    assert again.seen == 0
    moved = tmp_path / "elsewhere"
    root.rename(moved)
    assert _open(moved).num_frames == 94


def test_a_killed_build_goes_on(root: Path) -> None:
    with pytest.raises(KeyboardInterrupt):
        build_feature_cache(root, "test", _Frames(stop_after=45), _Texts(), batch_size=10)
    meta = read_meta(root, "test")
    assert meta is not None
    assert not meta.complete
    with pytest.raises(MemobenchError, match=r"not finished.*memobench cache"):
        _open(root)
    rest = _Frames()
    build_feature_cache(root, "test", rest, _Texts())
    assert rest.seen == 94 - 40  # the first episode was done
    whole = root / FOLDER / "test" / "tokens.bin"
    resumed = whole.read_bytes()
    shutil.rmtree(root / FOLDER)
    build_feature_cache(root, "test", _Frames(), _Texts())
    assert whole.read_bytes() == resumed


@pytest.mark.filterwarnings("ignore:.*use of fork:DeprecationWarning")
@pytest.mark.parametrize(
    ("name", "call"),
    [("_write_tables", 1), ("_write_done", 3), ("_write_hashes", 1), ("_write_meta", 2)],
    ids=["tables", "second episode", "hashes", "last file"],
)
@pytest.mark.parametrize("after", [False, True])
def test_a_build_that_got_sigkill_goes_on(root: Path, name: str, call: int, after: bool) -> None:
    def build() -> Path:
        return build_feature_cache(root, "test", _Frames(), _Texts(), batch_size=10, workers=1)

    undisturbed = hashes(build())
    assert json.loads((root / FOLDER / "test" / "hashes.json").read_text()) == {
        name: value for name, value in undisturbed.items() if name != "hashes.json"
    }
    shutil.rmtree(root / FOLDER)
    killed_at(building, name, call, build, after=after)
    assert hashes(build()) == undisturbed
    assert check_cache(root / FOLDER / "test") is None


@pytest.mark.parametrize("content", [b"", b"\x93NUMPY\x01", b"PK\x03\x04", None])
def test_a_build_that_does_not_know_how_far_it_was_begins_again(root: Path, content: bytes | None) -> None:
    with pytest.raises(KeyboardInterrupt):
        build_feature_cache(root, "test", _Frames(stop_after=45), _Texts(), batch_size=10)
    done = root / FOLDER / "test" / "done.npy"
    if content is None:
        np.save(done, np.ones(7, np.uint8))  # of another dataset
    else:
        done.write_bytes(content)
    rest = _Frames()
    build_feature_cache(root, "test", rest, _Texts())
    assert rest.seen == 94
    assert np.load(done).tolist() == [1, 1, 1]


def test_damaged_texts_of_an_unfinished_cache_are_told(root: Path) -> None:
    with pytest.raises(KeyboardInterrupt):
        build_feature_cache(root, "test", _Frames(stop_after=45), _Texts(), batch_size=10)
    (root / FOLDER / "test" / "texts.json").write_text('["a", 5')
    with pytest.raises(MemobenchError, match=r"texts.json: it is not JSON .*; delete .*/test, and it is made again"):
        build_feature_cache(root, "test", _Frames(), _Texts("others"))


def test_the_number_of_threads_changes_nothing(root: Path) -> None:
    whole = root / FOLDER / "test" / "tokens.bin"
    contents = []
    for workers in (1, 4):
        shutil.rmtree(root / FOLDER, ignore_errors=True)
        build_feature_cache(root, "test", _Frames(), _Texts(), batch_size=7, workers=workers)
        contents.append(whole.read_bytes())
    assert contents[0] == contents[1]
    assert any(contents[0])


def test_a_decoder_that_fails_stops_the_build(root: Path) -> None:
    next((root / "videos" / CAMERA).rglob("*.mp4")).write_bytes(b"no video")
    with pytest.raises((RuntimeError, ValueError, OSError)):
        build_feature_cache(root, "test", _Frames(), _Texts(), workers=3)
    meta = read_meta(root, "test")
    assert meta is not None
    assert not meta.complete


def test_refusals_name_reason_and_fix(root: Path) -> None:
    with pytest.raises(MemobenchError, match=r"no feature cache.*memobench cache"):
        _open(root)
    build_feature_cache(root, "test", _Frames(), _Texts())
    for changes, reason in (
        ({"frames_key": "other"}, "another visual encoder"),
        ({"stride": 2}, "stride 1, and stride 2"),
        ({"texts_key": "other"}, "another text encoder"),
    ):
        with pytest.raises(MemobenchError, match=f"{reason}.*memobench cache") as caught:
            _open(root, **changes)
        assert str(caught.value).count("\n") == 0
    assert _open(root, texts_key=None).texts  # without alignment the text encoder does not matter
    meta_file = root / FOLDER / "test" / "meta.json"
    meta_file.write_text(json.dumps({"something": "else"}))
    with pytest.raises(MemobenchError, match=r"cannot|not a feature cache"):
        _open(root)


def test_a_changed_dataset_makes_its_cache_stale_and_building_mends_it(root: Path) -> None:
    build_feature_cache(root, "test", _Frames(), _Texts())
    before = dataset_fingerprint(root, CAMERA)
    (root / "README.md").write_text("a card changes nothing")
    assert dataset_fingerprint(root, CAMERA) == before
    video = next((root / "videos" / CAMERA).rglob("*.mp4"))
    content = bytearray(video.read_bytes())
    content[-1] ^= 1
    video.write_bytes(bytes(content))
    with pytest.raises(MemobenchError, match=r"stale.*memobench cache"):
        _open(root)
    again = _Frames()
    build_feature_cache(root, "test", again, _Texts())
    assert again.seen == 94
    assert _open(root).num_frames == 94


def test_wrong_folders_and_cameras(root: Path, tmp_path: Path) -> None:
    with pytest.raises(MemobenchError, match="no LeRobotDataset"):
        build_feature_cache(tmp_path, "test", _Frames(), _Texts())
    with pytest.raises(MemobenchError, match=r"no camera 'observation.images.top'.*observation.images.image"):
        build_feature_cache(root, "test", _Frames(), _Texts(), camera="observation.images.top")
    assert not (root / FOLDER / "test").exists()


def test_frames_without_text_take_the_next_then_the_last() -> None:
    rows = np.array([-1, 4, -1, 5, -1, -1, -1, 6, -1], np.int32)
    episodes = np.array([0, 5, 7, 9])
    assert resolve_subgoals(rows, episodes).tolist() == [4, 4, 5, 5, 5, -1, -1, 6, 6]


# -- several at once -----------------------------------------------------------------------------------------------


def test_whoever_comes_second_says_so_and_waits(root: Path) -> None:
    told = threading.Event()

    class Listener(logging.Handler):
        def emit(self, record: logging.LogRecord) -> None:
            if "waiting" in record.getMessage():
                told.set()

    logger, listener = logging.getLogger("lerobot_memobench"), Listener()
    first, second = _HeldFrames(), _Frames()
    builders = [
        threading.Thread(target=build_feature_cache, args=(root, "test", frames, _Texts()), daemon=True)
        for frames in (first, second)
    ]
    logger.addHandler(listener)
    try:
        builders[0].start()
        assert first.begun.wait(60)
        builders[1].start()
        assert told.wait(60)
        first.go.set()
        for builder in builders:
            builder.join(60)
    finally:
        logger.removeHandler(listener)
    assert (first.seen, second.seen) == (94, 0)
    assert _open(root).num_frames == 94


def test_what_decides_the_content_decides_the_name(root: Path, tmp_path: Path) -> None:
    contents = {"frames_key": "tower-96x96", "camera": CAMERA, "stride": 1}
    others = [{"frames_key": "tower-48x48"}, {"frames_key": "other-96x96"}, {"camera": "other"}, {"stride": 2}]
    for place in (None, tmp_path / "caches"):
        folders = [find_cache(root, "tiny", place=place, **contents | other) for other in ({}, *others)]
        assert len(set(folders)) == len(folders)
        assert {folder.parent for folder in folders} == {place or root / FOLDER}
        assert folders[0] == find_cache(root, "tiny", place=place, **contents)
    with_place = find_cache(root, "tiny", place=tmp_path / "caches", **contents)
    with_place.mkdir(parents=True)
    moved = Path(shutil.copytree(root, tmp_path / "under another name"))
    assert find_cache(moved, "tiny", place=tmp_path / "caches", **contents) == with_place
    parquet = next((root / "data").rglob("*.parquet"))
    parquet.write_bytes(parquet.read_bytes() + b" ")  # another dataset of the same name
    assert find_cache(root, "tiny", place=tmp_path / "caches", **contents) != with_place


def test_a_cache_named_before_the_hash_is_found_when_it_fits(root: Path) -> None:
    earlier = build_feature_cache(root, "tiny-stride1", _Frames(), _Texts())
    contents = {"camera": CAMERA, "stride": 1}
    assert find_cache(root, "tiny-stride1", frames_key="tower", **contents) == earlier
    other = find_cache(root, "tiny-stride1", frames_key="other", **contents)
    build_feature_cache(root, other.name, _Frames("other"), _Texts())
    meta = read_meta(root, earlier.name)
    assert meta is not None
    assert (meta.complete, meta.frames_key) == (True, "tower")
    assert {path.name for path in (root / FOLDER).iterdir() if path.is_dir()} == {earlier.name, other.name}


def test_another_text_encoder_adds_its_texts_and_nothing_else(root: Path) -> None:
    build_feature_cache(root, "test", _Frames(), _Texts())
    again = _Frames()
    build_feature_cache(root, "test", again, _Texts("second"))
    assert again.seen == 0
    first, second = _open(root, texts_key="texts"), _open(root, texts_key="second")
    assert torch.equal(first.text_embeddings, second.text_embeddings)
    assert len(list((root / FOLDER / "test").glob("texts*.npy"))) == 2


# -- the disk ------------------------------------------------------------------------------------------------------


@pytest.fixture
def small_disk(root: Path) -> Iterator[Path]:
    """A disk of one MiB where the dataset's caches lie."""
    folder = root / FOLDER
    folder.mkdir()
    mounted = subprocess.run(["mount", "-t", "tmpfs", "-o", "size=1m", "tmpfs", folder], capture_output=True)
    if mounted.returncode:
        pytest.skip("nothing may be mounted here")
    yield folder
    subprocess.run(["umount", folder], check=True)


def test_its_size_is_told_before_anything_is_encoded(root: Path, tmp_path: Path) -> None:
    frames, told = _WideFrames(), []
    build_feature_cache(
        root, "test", frames, _Texts(), place=tmp_path / "b" / "c", tell=lambda said: told.append((frames.seen, said))
    )
    assert (tmp_path / "b" / "c" / "test" / "tokens.bin").stat().st_size == 94 * 16 * 1024
    assert [seen for seen, _ in told] == [0]
    assert "takes 1.5 MiB: 94 frames of 16.0 KiB" in told[0][1]
    assert not (root / FOLDER).exists()
    assert _open(root, place=tmp_path / "b" / "c").num_frames == 94


def test_a_disk_without_room_is_one_sentence_and_nothing_is_left(
    root: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    usage = shutil.disk_usage(tmp_path)
    monkeypatch.setattr(shutil, "disk_usage", lambda _: usage._replace(free=1_000_000))
    frames = _WideFrames()
    with pytest.raises(
        MemobenchError, match=r"1\.5 MiB are needed there and 976\.6 KiB are free.*feature_cache_dir"
    ) as told:
        build_feature_cache(root, "test", frames, _Texts())
    assert "\n" not in str(told.value)
    assert frames.seen == 0
    assert not (root / FOLDER / "test").exists()


def test_a_disk_that_is_full_kills_nobody(root: Path, small_disk: Path) -> None:
    frames = _WideFrames()
    with pytest.raises(MemobenchError, match="does not fit on its disk"):
        build_feature_cache(root, "test", frames, _Texts())
    assert frames.seen == 0
    assert [path for path in small_disk.iterdir() if path.is_dir()] == []
    subprocess.run(["mount", "-o", "remount,size=4m", small_disk], check=True)
    build_feature_cache(root, "test", frames, _Texts())
    assert frames.seen == 94


def test_a_disk_that_fills_up_meanwhile_loses_nothing_that_was_done(
    root: Path, small_disk: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # A disk that promises room which it then has not, as file systems do that copy on write.
    building = "lerobot_memobench.datasets.feature_cache.building"
    with monkeypatch.context() as patched:
        patched.setattr(f"{building}.reserve", lambda path, size: path.open("wb").truncate(size))
        with pytest.raises(MemobenchError, match=r"is full.*make room") as told:
            build_feature_cache(root, "test", _WideFrames(), _Texts(), batch_size=5)
    assert "\n" not in str(told.value)
    meta = read_meta(root, "test")
    assert meta is not None
    assert not meta.complete
    done = np.load(small_disk / "test" / "done.npy")
    assert done.tolist() == [1, 0, 0]
    subprocess.run(["mount", "-o", "remount,size=4m", small_disk], check=True)
    rest = _WideFrames()
    build_feature_cache(root, "test", rest, _Texts())
    assert rest.seen == 94 - 40


def test_where_nothing_may_be_written_it_says_so(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(path: Path, *_: object) -> None:
        raise PermissionError(13, "Permission denied", str(path))

    with monkeypatch.context() as patched:
        patched.setattr("lerobot_memobench.datasets.feature_cache.building.taking_turns", refuse)
        with pytest.raises(MemobenchError, match=r"cannot be written \(Permission denied\).*memobench cache --out"):
            build_feature_cache(root, "test", _Frames(), _Texts())
    build_feature_cache(root, "test", _Frames(), _Texts())
    with monkeypatch.context() as patched:  # a finished one is read all the same
        patched.setattr("lerobot_memobench.datasets.feature_cache.building.taking_turns", refuse)
        build_feature_cache(root, "test", _Frames(), _Texts())


@pytest.mark.parametrize("pattern", ["data/**/*.parquet", "videos/observation.images.image/**/*.mp4"])
def test_a_damaged_file_of_the_dataset_is_named(root: Path, pattern: str) -> None:
    path = next(root.glob(pattern))
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    with pytest.raises(MemobenchError, match=f"{path.name} cannot be read .*the dataset is damaged") as told:
        build_feature_cache(root, "test", _Frames(), _Texts())
    assert str(told.value).startswith(f"{path} ")
