"""A job that is told to end (SIGTERM) says how to go on and leaves no process behind: real commands as processes."""

from __future__ import annotations

import contextlib
import os
import shlex
import signal
import subprocess
import sys
import time
import uuid
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from lerobot_memobench.errors import MemobenchError
from tests.support.object_dataset import make_object_dataset

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="processes are looked up in /proc")

STOVE = "turn_on_the_stove_and_turn_it_off"
COMMANDS = {"lerobot": "lerobot_memobench.cli.lerobot", "memobench": "lerobot_memobench.cli.memobench"}


class Job:
    """A process whose descendants are known by a word in their environment, whoever their parent has become."""

    def __init__(self, words: list[str], folder: Path) -> None:
        self.mark, self.folder = uuid.uuid4().hex, folder
        self.process = subprocess.Popen(
            [sys.executable, *words],
            cwd=folder,
            env={**os.environ, "MEMOBENCH_TEST_MARK": self.mark},
            stdout=(folder / "out.txt").open("wb"),
            stderr=(folder / "err.txt").open("wb"),
        )

    @property
    def alive(self) -> set[int]:
        """Numbers of its processes that run."""
        found = set()
        for place in Path("/proc").iterdir():
            with contextlib.suppress(OSError):
                if place.name.isdecimal() and self.mark.encode() in (place / "environ").read_bytes():
                    found.add(int(place.name))
        return found

    def wait_until(self, what: Callable[[], bool]) -> None:
        """Wait for something to be seen; the test's own limit of time ends the waiting."""
        while not what():
            assert self.process.poll() is None, (self.folder / "err.txt").read_text()
            time.sleep(0.1)

    def end(self) -> str:
        """Tell it to end as Slurm does; return what it says of that. Nothing of it may be left a moment later."""
        assert len(self.alive) > 1  # else there would be nothing to leave behind
        self.process.terminate()
        try:
            assert self.process.wait(30) == 128 + signal.SIGTERM
            deadline = time.monotonic() + 10
            while self.alive and time.monotonic() < deadline:
                time.sleep(0.1)
            assert not self.alive
        finally:
            for pid in self.alive:
                os.kill(pid, signal.SIGKILL)
        said = (self.folder / "err.txt").read_text().splitlines()
        return next(line for line in said if "ended by SIGTERM" in line)


TREE = """
import subprocess, sys, time
from pathlib import Path
from lerobot_memobench.jobs.processes import process_pool, saying_how_to_go_on

def work(number):
    subprocess.Popen(["sleep", "600"], start_new_session=True)
    Path(f"begun-{number}").touch()
    time.sleep(600)

if __name__ == "__main__":
    with saying_how_to_go_on("a", lambda: "outer"), saying_how_to_go_on("b", lambda: "go on"):
        with process_pool(2) as pool:
            list(pool.map(work, range(2)))
"""


def test_whatever_was_started_ends(tmp_path: Path) -> None:
    (tmp_path / "tree.py").write_text(TREE)
    job = Job(["tree.py"], tmp_path)
    job.wait_until(lambda: len(list(tmp_path.glob("begun-*"))) == 2)
    assert job.end() == "b: ended by SIGTERM; go on"


def test_who_handles_the_signal_already_is_let(tmp_path: Path) -> None:
    code = (
        "import os, signal\n"
        "from lerobot_memobench.jobs.processes import saying_how_to_go_on\n"
        "signal.signal(signal.SIGTERM, lambda *_: os._exit(7))\n"
        "with saying_how_to_go_on('a', lambda: 'not said'):\n    os.kill(os.getpid(), signal.SIGTERM)\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False, timeout=60)
    assert (done.returncode, done.stderr) == (7, "")


def test_the_handler_goes_with_the_command() -> None:
    from lerobot_memobench.cli.memobench import main

    before = signal.getsignal(signal.SIGTERM)
    assert main(["tasks", "--help"]) == 0
    assert signal.getsignal(signal.SIGTERM) is before


@pytest.mark.parametrize(("words", "begins"), [(["cache", "nowhere"], "go on"), (["tasks", "--json"], "begin anew")])
def test_what_a_command_says(words: list[str], begins: str, monkeypatch: pytest.MonkeyPatch) -> None:
    from lerobot_memobench.cli import console, memobench

    said: list[str] = []

    @contextlib.contextmanager
    def saying(program: str, how: Callable[[], str]) -> Iterator[None]:
        said.append(f"{program}: {how()}")
        raise MemobenchError("not now")
        yield

    monkeypatch.setattr(console, "saying_how_to_go_on", saying)
    monkeypatch.setattr(memobench, "use_threads", lambda role: None)
    assert memobench.main(words) == 2
    assert said == [f"memobench: {begins} with: {shlex.join(['memobench', *words])}"]


@pytest.mark.slow
def test_demonstrations(tmp_path: Path) -> None:
    words = ["generate", "--out", "my data", "--tasks", STOVE, "--no-images", "--episodes", "200", "--workers", "2"]
    job = Job(["-m", COMMANDS["memobench"], *words], tmp_path)
    job.wait_until(lambda: any((tmp_path / "my data" / ".staging").glob("*/*/*")))
    said = job.end()
    assert said == f"memobench: ended by SIGTERM; go on with: {shlex.join(['memobench', *words])}"


@pytest.mark.slow
@pytest.mark.parametrize("parts", [False, True])
def test_an_evaluation(tmp_path: Path, parts: bool) -> None:
    words = ["eval", "env=memobench", f"tasks={STOVE}", "obs_type=environment_state_agent_pos", "episodes=40"]
    words += ["shards=2"] if parts else ["batch_size=2"]
    job = Job(["-m", COMMANDS["lerobot"], *words], tmp_path)
    job.wait_until(lambda: any(tmp_path.rglob("episodes/*.jsonl")))
    said = job.end().partition("go on with: ")[2]
    again = shlex.split(said)
    assert again[: len(words) + 1] == ["lerobot", *words]
    assert again[-2] == "resume=true"
    folder = tmp_path / again[-1].removeprefix("output_dir=")
    assert any(folder.rglob("episodes/*.jsonl"))


@pytest.mark.slow
def test_a_training(tmp_path: Path) -> None:
    make_object_dataset(tmp_path / "data")
    words = ["train", "policy=memobench_mem", "size=tiny", "perception=objects", "dataset=data", "steps=100000"]
    words += ["save_freq=5", "num_workers=1", "batch_size=2", "prompt_frames=false"]
    job = Job(["-m", COMMANDS["lerobot"], *words], tmp_path)
    job.wait_until(lambda: any(tmp_path.glob("outputs/train/*/*/checkpoints/last")))
    said = job.end().partition("go on with: ")[2]
    program, train, output, resume, kept = shlex.split(said)
    assert (program, train, resume, kept) == ("lerobot", "train", "resume=true", "prompt_frames=false")
    (run,) = tmp_path.glob("outputs/train/*/*")
    assert tmp_path / output.removeprefix("output_dir=") == run
    # And it does go on.
    before = (run / "checkpoints" / "last").resolve().name
    job = Job(["-m", COMMANDS["lerobot"], *shlex.split(said)[1:]], tmp_path)
    job.wait_until(lambda: (run / "checkpoints" / "last").resolve().name != before)
    assert int((run / "checkpoints" / "last").resolve().name) > int(before)
    job.end()
