"""Commands as processes: imports, SIGTERM, a second writer, and evaluations killed at random."""

from __future__ import annotations

import contextlib
import functools
import os
import shlex
import signal
import subprocess
import sys
import time
import uuid
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from lerobot_memobench.cli.lerobot import main as lerobot
from lerobot_memobench.cli.memobench import main as memobench
from lerobot_memobench.envs.episode_log import read_episodes
from lerobot_memobench.envs.evaluation_file import write_evaluation
from lerobot_memobench.evaluation.html import UNFINISHED
from lerobot_memobench.jobs.processes import locked
from tests.support import logs, synthetic_dataset
from tests.support.fake_loop import STOVE
from tests.support.fork_server import Fork, ForkServer
from tests.support.synthetic_dataset import make_object_dataset

COMMANDS = {"lerobot": "lerobot_memobench.cli.lerobot", "memobench": "lerobot_memobench.cli.memobench"}


# --- imports ---

KNOWN = """
import sys
from lerobot.configs.policies import PreTrainedConfig
from lerobot.envs.configs import EnvConfig
assert "memobench" in EnvConfig.get_known_choices()
policies = {"memobench_mem", "memobench_expert", "memobench_random", "memobench_remote"}
assert policies <= set(PreTrainedConfig.get_known_choices())
found = {"mujoco"} & set(sys.modules) | {n for n in sys.modules if "memobench" in n and "modeling" in n}
assert not found, found
"""


@pytest.mark.slow  # LeRobot's import, in each process; the discovery itself is part of the tests of a second writer
@pytest.mark.parametrize(
    "first",
    [
        "import lerobot.scripts.lerobot_eval as s; s.register_third_party_plugins()",
        "import lerobot_policy_memobench, lerobot.policies, lerobot.envs",
        "import lerobot.envs, lerobot.policies, lerobot_policy_memobench",
        "import lerobot_memobench.registration",
    ],
)
def test_configurations_are_registered_without_the_simulator(first: str) -> None:
    done = subprocess.run([sys.executable, "-c", first + "\n" + KNOWN], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def test_a_command_without_lerobot_does_not_import_it() -> None:
    code = (
        "import sys; from lerobot_memobench.cli.memobench import main; status = main(['tasks']); "
        "heavy = {'lerobot', 'torch', 'mujoco'} & set(sys.modules); print(sorted(heavy), file=sys.stderr)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stderr.strip() == "[]"


# --- a second writer ---

EVALUATION = ["policy=memobench_random", f"tasks={STOVE}", "episodes=2", "policy.device=cpu", "output_dir=out"]
EVAL = ["eval", "env=memobench", *EVALUATION]
GENERATE = ["generate", "--tasks", STOVE, "--episodes", "1", "--out", "ds"]

#: Command -> its exit status, and the place of its lock.
WRITERS: dict[str, tuple[Callable[[], int], int, str]] = {
    "evaluation": (lambda: lerobot(EVAL), 2, "out"),
    "resumed evaluation": (lambda: lerobot([*EVAL, "resume=true"]), 2, "out"),
    "evaluation with a log elsewhere": (lambda: lerobot([*EVAL, "env.log_dir=other"]), 2, "out"),
    "parts of an evaluation": (lambda: lerobot([*EVAL, "shards=2", "batch_size=1"]), 2, "out"),
    "sealed test": (lambda: memobench(["test-sealed", *EVALUATION]), 2, "out"),
    "merge": (lambda: memobench(["merge", "out", "logged"]), 2, "out"),
    "report": (lambda: memobench(["report", "logged"]), 0, "logged"),
    "html": (lambda: memobench(["report", "logged", "--html", "html"]), 2, "html"),
    "generation": (lambda: memobench(GENERATE), 2, "ds/.staging"),
    "conversion": (lambda: memobench(["convert", "files", "--out", "ds"]), 2, "ds/.staging"),
    "training": (
        lambda: lerobot(["train", "policy=memobench_mem", "policy.device=cpu", "dataset=data", "output_dir=run"]),
        2,
        ".run.lock",
    ),
}


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return synthetic_dataset.make_dataset(tmp_path_factory.mktemp("data") / "data")


@pytest.mark.parametrize("command", WRITERS)
def test_a_second_writer_changes_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Any, dataset: Path, command: str
) -> None:
    monkeypatch.chdir(tmp_path)
    for name in ("out/notes.json", "out/.1-a.part.evaluation.json", "run/model", "files/a.hdf5"):
        Path(name).parent.mkdir(exist_ok=True)
        Path(name).write_text("of the first run")
    write_evaluation(Path("out"), logs.card({"tasks": [STOVE], "episodes": 2}))
    for name in ("ds/.staging/episodes/.tmp-000000", "html/videos/run", "data"):
        Path(name).mkdir(parents=True)
    Path("html/index.html").write_text(UNFINISHED)
    Path("html/videos/run/a.mp4").write_text("of the first run")
    Path("ds/.staging/request.json").write_text("{}")
    for path in dataset.iterdir():
        Path("data", path.name).symlink_to(path)
    Path(".run.lock").touch()
    logs.write_log(Path("logged"), [logs.record(STOVE)])

    def files() -> dict[Path, bytes | None]:
        return {path: path.read_bytes() if path.is_file() else None for path in tmp_path.rglob("*")}

    run, status, place = WRITERS[command]
    with locked(Path(place), Path("out")):
        before = files()
        assert run() == status
        after = files()
    if command == "html":  # the report itself is written next to the log, which is not locked
        after = {path: content for path, content in after.items() if path in before}
    assert after == before
    assert "another run is writing" in capsys.readouterr().err


# --- SIGTERM ---


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
        """Numbers of its running processes."""
        found = set()
        for place in Path("/proc").iterdir():
            with contextlib.suppress(OSError):
                if place.name.isdecimal() and self.mark.encode() in (place / "environ").read_bytes():
                    found.add(int(place.name))
        return found

    def wait_until(self, condition: Callable[[], bool]) -> None:
        """Wait for a condition; the test's own limit of time ends the waiting."""
        while not condition():
            assert self.process.poll() is None, (self.folder / "err.txt").read_text()
            time.sleep(0.1)

    def end(self, processes: int = 2) -> str:
        """End it by SIGTERM, as a cluster does; return its message. No process may be left a moment later."""
        assert len(self.alive) >= processes  # else the check below would be empty
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
        lines = (self.folder / "err.txt").read_text().splitlines()
        return next(line for line in lines if "ended by SIGTERM" in line)


TREE = """
import subprocess, sys, time
from pathlib import Path
from lerobot_memobench.jobs.processes import process_pool, adding_resume_hint

def work(number):
    subprocess.Popen(["sleep", "600"], start_new_session=True)
    Path(f"begun-{number}").touch()
    time.sleep(600)

if __name__ == "__main__":
    with adding_resume_hint("a", lambda: "outer"), adding_resume_hint("b", lambda: "resume"):
        with process_pool(2) as pool:
            list(pool.map(work, range(2)))
"""
linux = pytest.mark.skipif(sys.platform != "linux", reason="processes are looked up in /proc")


@linux
def test_all_processes_end(tmp_path: Path) -> None:
    (tmp_path / "tree.py").write_text(TREE)
    job = Job(["tree.py"], tmp_path)
    job.wait_until(lambda: len(list(tmp_path.glob("begun-*"))) == 2)
    assert job.end() == "b: ended by SIGTERM; resume"


@linux
@pytest.mark.parametrize(
    ("script", "waiting", "children"), [("train_in_ten_minutes", "lerobot", 2), ("demo", "lerobot", 1)]
)
def test_children_of_examples_end(tmp_path: Path, script: str, waiting: str, children: int) -> None:
    for name in ("memobench", "lerobot"):
        (tmp_path / name).write_text(f"#!/bin/sh\n{'touch begun-$$; exec sleep 600' if name == waiting else ''}\n")
        (tmp_path / name).chmod(0o755)
    path = Path(__file__).parents[2] / "examples" / f"{script}.py"
    code = f"import runpy, sys; sys.argv = ['example', '--out', '.']; sys.executable = {str(tmp_path / 'python')!r}; "
    job = Job(["-c", f"{code}runpy.run_path({str(path)!r}, run_name='__main__')"], tmp_path)
    job.wait_until(lambda: len(list(tmp_path.glob("begun-*"))) == children)
    assert job.end(1 + children).endswith("the same command resumes")


def test_another_handler_of_the_signal_is_kept(tmp_path: Path) -> None:
    code = (
        "import os, signal\n"
        "from lerobot_memobench.jobs.processes import adding_resume_hint\n"
        "signal.signal(signal.SIGTERM, lambda *_: os._exit(7))\n"
        "with adding_resume_hint('a', lambda: 'not printed'):\n    os.kill(os.getpid(), signal.SIGTERM)\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False, timeout=60)
    assert (done.returncode, done.stderr) == (7, "")


@linux
@pytest.mark.slow
@pytest.mark.parametrize("parts", [False, True])
def test_an_evaluation_is_ended(tmp_path: Path, parts: bool) -> None:
    words = ["eval", "env=memobench", f"tasks={STOVE}", "obs_type=environment_state_agent_pos", "episodes=40"]
    words += ["shards=2"] if parts else ["batch_size=2"]
    job = Job(["-m", COMMANDS["lerobot"], *words], tmp_path)
    job.wait_until(lambda: any(tmp_path.rglob("episodes/*.jsonl")))
    again = shlex.split(job.end().partition("resume with: ")[2])
    assert again[: len(words) + 1] == ["lerobot", *words]
    assert again[-2] == "resume=true"
    folder = tmp_path / again[-1].removeprefix("output_dir=")
    assert any(folder.rglob("episodes/*.jsonl"))


@linux
@pytest.mark.slow
def test_a_training_is_ended_and_resumed(tmp_path: Path) -> None:
    make_object_dataset(tmp_path / "data")
    words = ["train", "policy=memobench_mem", "size=tiny", "perception=objects", "dataset=data", "steps=100000"]
    words += ["save_freq=5", "num_workers=1", "batch_size=2", "prompt_frames=false"]
    job = Job(["-m", COMMANDS["lerobot"], *words], tmp_path)
    job.wait_until(lambda: any(tmp_path.glob("outputs/train/*/*/checkpoints/last")))
    again = shlex.split(job.end(processes=1).partition(" with: ")[2])  # samples in memory need no loaders
    program, train, output, resume, kept = again
    assert (program, train, resume, kept) == ("lerobot", "train", "resume=true", "prompt_frames=false")
    (run,) = tmp_path.glob("outputs/train/*/*")
    assert tmp_path / output.removeprefix("output_dir=") == run
    before = (run / "checkpoints" / "last").resolve().name
    job = Job(["-m", COMMANDS["lerobot"], *again[1:]], tmp_path)
    job.wait_until(lambda: (run / "checkpoints" / "last").resolve().name != before)
    assert int((run / "checkpoints" / "last").resolve().name) > int(before)
    job.end(processes=1)


# --- one evaluation in several ways, and kills of processes with children ---

COMMON = ["env=memobench", "env.videos=-1", "batch_size=2"]
COMMON += ["eval.use_async_envs=false"]  # rows in one process: workers would start for longer than an episode lasts


@pytest.fixture(scope="module")
def server() -> Iterator[ForkServer]:
    """Forks of a process with LeRobot: its import takes longer than an episode."""
    modules = ("lerobot_memobench.envs.env", "lerobot_memobench.rollouts.evaluate", "lerobot_memobench.cli.lerobot")
    forks = ForkServer(modules)
    yield forks
    forks.close()


def start(server: ForkServer, out: Path, settings: list[str], resume: bool = True) -> Fork:
    words = ["eval", *COMMON, *settings, f"output_dir={out}", *(["resume=true"] if resume else [])]
    code = f"from lerobot_memobench.cli.lerobot import main; raise SystemExit(main({words!r}))"
    return server.start(code, out.with_suffix(".txt"))


WAYS = {
    "three rows": ["batch_size=3"],
    "ten rows": ["batch_size=10"],
    "processes": ["batch_size=3", "eval.use_async_envs=true"],
    "parts": ["batch_size=2", "shards=2", "workers=2"],
}
SUITES = {
    "published": STOVE,
    "strict": "put_only_the_milk_from_the_highlighted_location_in_the_prompt_video_on_the_plate",
}


@pytest.fixture(scope="module")
def alone(server: ForkServer, tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Path]:
    """Return a function of a suite: the folder of an evaluation of single episodes."""

    @functools.cache
    def evaluated(suite: str) -> Path:
        out = tmp_path_factory.mktemp("alone") / suite
        assert start(server, out, evaluation(suite, ["batch_size=1"]), resume=False).wait() == 0
        return out

    return evaluated


def evaluation(suite: str, way: list[str]) -> list[str]:
    """Return settings of ten episodes of the random policy on objects."""
    more = ["obs_type=environment_state_agent_pos", "episodes=10", "horizon=20", "env.videos=0"]
    return [f"suite={suite}", f"tasks={SUITES[suite]}", "policy=memobench_random", *more, *way]


def outcomes(out: Path) -> list[dict[str, Any]]:
    """Return the lines of a log without what names the run or its time."""
    changing = {"run", "wall_s", "finished"}
    return [{key: value for key, value in line.items() if key not in changing} for line in read_episodes(out)]


@linux
@pytest.mark.slow
@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("suite", SUITES)
def test_outcomes_do_not_depend_on_batches_parts_and_kills(
    server: ForkServer, tmp_path: Path, alone: Callable[[str], Path], suite: str, way: str
) -> None:
    settings = evaluation(suite, WAYS[way])
    for kill in range(3):
        process = start(server, tmp_path / "out", settings)
        while process.poll() is None and len([*tmp_path.rglob("episodes/*.jsonl")]) <= kill:
            time.sleep(0.01)
        if process.poll() is None:
            process.kill()
    deadline = time.monotonic() + 60
    while (process := start(server, tmp_path / "out", settings)).wait() and time.monotonic() < deadline:
        time.sleep(1)  # workers of the killed process hold the folder for a moment
    assert outcomes(tmp_path / "out") == outcomes(alone(suite))


@pytest.mark.parametrize("words", [["eval", "--help"], ["eval", "env=memobench", "tasks=stov"]])
def test_mistyped_names_and_help_import_no_torch(words: list[str]) -> None:
    code = (
        f"import sys; from lerobot_memobench.cli.lerobot import main; main({words}); sys.exit('torch' in sys.modules)"
    )
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, check=False).returncode == 0
