"""Run many independent jobs, such as the making of one episode, and find them finished again: here, on Slurm, on Ray.

Whatever runs them, the result is the same, because a job depends on nothing but itself and knows from the disk whether
it is finished. So a killed run is continued by giving the same jobs again. Slurm and Ray are reached by datatrove.
"""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from inspect import signature
from pathlib import Path
from typing import Any

from lerobot_memobench.errors import MemobenchError, nearest
from lerobot_memobench.jobs.processes import Advance, Job, ProgressCallback, check_finished, run_in_processes

EXECUTORS = ("processes", "local", "slurm", "ray")
"""``processes``: this package's own; the others are datatrove's."""

ELSEWHERE = ("slurm", "ray")
"""Those whose jobs may run on other machines than this one."""

DATATROVE = {"local": "LocalPipelineExecutor", "slurm": "SlurmPipelineExecutor", "ray": "RayPipelineExecutor"}
SET_HERE = ("pipeline", "tasks", "workers", "depends")
"""Arguments of datatrove's executors that follow from the jobs and from ``workers``."""
NESTED = ("sbatch_args", "srun_args")
"""Arguments that are words of another program: ``sbatch_args.constraint=a100``."""
SBATCH = ("account", "gres", "constraint", "reservation", "nodelist", "exclude", "signal", "nice")
"""Words of sbatch that are understood without ``sbatch_args.`` before them."""
GPU_WORDS = ("gres", "gpus", "gpus-per-task", "gpus-per-node")
"""Those by which a user may ask for GPUs in another way than by ``gpus_per_task``."""
NAME = "memobench"
"""Of the jobs on Slurm."""

POLL_SECONDS = 1.0
JOBS_PER_RANK = 10
"""Jobs that a datatrove task runs, one after another: neighbours share what is costly to set up, such as a scene."""


def run_jobs(
    jobs: Sequence[Job],
    *,
    workers: int = 1,
    progress: ProgressCallback | None = None,
    executor: str = "processes",
    options: Mapping[str, Any] | None = None,
    logs: Path,
    finish: Callable[[], Any] | None = None,
    jobs_per_rank: int = JOBS_PER_RANK,
) -> bool:
    """Run the jobs that are not finished yet; tell ``progress`` of every one, old or new.

    Args:
        jobs: what to do.
        workers: how many run at a time.
        progress: called after each job (on Slurm, for those that were finished before).
        executor: one of ``EXECUTORS``.
        options: further arguments of datatrove's executor, such as Slurm's ``partition`` and ``time``.
        logs: folder for datatrove's logs.
        finish: what is to be done when all jobs are; called only on Slurm, in a job of its own.
        jobs_per_rank: how many a datatrove task runs, one after another.

    Returns:
        Whether all jobs are finished; False when they have been handed to Slurm.

    Raises:
        MemobenchError: a worker was killed, jobs ended without a result, or the executor is unknown, not installed or
            misses an option.
    """
    check_executor(executor, options)
    finished = [job.finished() for job in jobs]
    waiting = [job for job, over in zip(jobs, finished, strict=True) if not over]
    tell = _Teller(len(jobs), sum(finished), progress)
    for job, over in zip(jobs, finished, strict=True):
        if over:
            tell(job)
    if not waiting:
        return True
    if executor != "processes":
        datatrove = Datatrove(executor, workers, logs, jobs_per_rank, options or {})
        if executor == "slurm":
            datatrove.submit(waiting, finish)
            return False
        datatrove.run(waiting, tell)
    elif workers == 1 or len(waiting) == 1:
        for job in waiting:
            job.run()
            tell(job)
    else:
        run_in_processes(waiting, workers, tell)
    return True


class _Teller:
    """Tells the progress callback of each finished job once, whichever thread notices it first."""

    def __init__(self, total: int, found: int, progress: ProgressCallback | None) -> None:
        self._total, self._found, self._progress = total, found, progress
        self._told: set[Path] = set()
        self._lock = threading.Lock()

    def __call__(self, job: Job) -> None:
        with self._lock:
            if job.folder in self._told:
                return
            self._told.add(job.folder)
            if self._progress is not None:
                done = len(self._told)
                self._progress(Advance(done, self._total, job.task_name, job.seed, job.failure(), self._found))


@dataclass(frozen=True)
class Needs:
    """What one job asks a cluster for, unless its user says otherwise: cores, memory (GB) and GPUs."""

    cores: int = 2
    memory_gb: int = 8
    gpus: int = 0


def options_text(executor: str, options: Mapping[str, Any], needs: Needs) -> dict[str, Any]:
    """Return the options of an executor, with what a job needs where they say nothing of it; on Slurm alone.

    Datatrove would ask for one core, 2 GB and no GPU.
    """
    if executor != "slurm":
        return dict(options)
    asked = {"cpus_per_task": needs.cores, "gpus_per_task": needs.gpus, **options}
    if any(word in _sbatch_words(options) for word in GPU_WORDS):
        asked["gpus_per_task"] = options.get("gpus_per_task", 0)  # a user's own way to ask for them
    memory = -(-needs.memory_gb // max(1, int(asked["cpus_per_task"])))
    return {"mem_per_cpu_gb": memory, **asked}


def read_options(given: Sequence[str]) -> dict[str, Any]:
    """Return typed options, such as ``partition=cpu``: numbers, truth values and ``none`` as such.

    In the arguments of another program (``srun_args.mpi=none``) ``none`` is a name.

    Raises:
        MemobenchError: one is not ``key=value``.
    """
    plain: dict[str, bool | None] = {"true": True, "false": False}
    options: dict[str, Any] = {}
    for option in given:
        key, equals, value = option.partition("=")
        if not key or not equals:
            raise MemobenchError(f"found executor option {option!r}, expected key=value, such as partition=cpu")
        known = plain if "." in key else {**plain, "none": None, "null": None}
        options[key] = int(value) if value.isdecimal() else known.get(value.lower(), value)
    return options


def asked_for(options: Mapping[str, Any]) -> str:
    """Return in a sentence what each job on Slurm asks for."""
    cores, gpus = int(options["cpus_per_task"]), options["gpus_per_task"]
    own = [f"{word}={value}" for word, value in _sbatch_words(options).items()]
    gpu = [] if any(word in _sbatch_words(options) for word in GPU_WORDS) else [f"{gpus or 'no'} GPU"]
    asked = ", ".join([f"{cores} core{'s' * (cores > 1)}", f"{cores * int(options['mem_per_cpu_gb'])} GB", *gpu, *own])
    return (
        f"each job asks for {asked}; change it by the executor's options cpus_per_task=, mem_per_cpu_gb=, "
        "gpus_per_task=, and what else sbatch takes by account=, gres= or sbatch_args.<word>="
    )


def _sbatch_words(options: Mapping[str, Any]) -> dict[str, Any]:
    """Return what options hand to sbatch itself."""
    prefix = f"{NESTED[0]}."
    chosen = [key for key in options if key in SBATCH or key.startswith(prefix)]
    return {**options.get(NESTED[0], {}), **{key.removeprefix(prefix): options[key] for key in chosen}}


def _arguments(executor: str, options: Mapping[str, Any]) -> dict[str, Any]:
    """Return options as arguments of datatrove's executor: words of other programs gathered, numbers as numbers."""
    kinds = {name: parameter.annotation for name, parameter in signature(_executor_class(executor)).parameters.items()}
    found: dict[str, Any] = {}
    for key, value in options.items():
        outer, dot, inner = key.partition(".")
        if executor == "slurm" and key in SBATCH and key not in kinds:
            outer, dot, inner = NESTED[0], ".", key
        if isinstance(value, Mapping):
            found[key] = {**value, **found.get(key, {})}
        elif not dot:
            found[key] = _checked(executor, key, value, str(kinds.get(key)))
        elif value is not False and value is not None:  # a word without a value is an empty one, as datatrove has it
            found.setdefault(outer, {})[inner] = "" if value is True else str(value)
    return found


def _checked(executor: str, key: str, value: Any, kind: str) -> Any:
    """Return an option's value after a look at what the executor takes."""
    is_number = isinstance(value, int) and not isinstance(value, bool)
    if "bool" in kind and not isinstance(value, bool):
        raise MemobenchError(f"found {key}={value} for executor {executor!r}; expected true or false")
    if "int" in kind and not (is_number or value is None):
        raise MemobenchError(f"found {key}={value} for executor {executor!r}; expected a whole number")
    if "tuple" in kind and isinstance(value, str):
        return tuple(part for part in value.split(",") if part)
    return value


def check_executor(executor: str, options: Mapping[str, Any] | None) -> None:
    """Raise when jobs cannot be run that way."""
    if executor not in EXECUTORS:
        raise MemobenchError(f"found executor {executor!r}, {nearest(executor, EXECUTORS)}")
    if executor == "processes":
        if options:
            raise MemobenchError(
                f"options {', '.join(options)} were given for executor 'processes', which takes none; name local, "
                "slurm or ray"
            )
        return
    _check_installed(executor)
    takes = [name for name in signature(_executor_class(executor)).parameters if name not in SET_HERE]
    if executor == "slurm":
        takes = [*(name for name in takes if name not in NESTED), *SBATCH]
    for name, value in (options or {}).items():
        outer, _, inner = name.partition(".")
        nested = executor == "slurm" and outer in NESTED and (inner or isinstance(value, Mapping))
        if name not in takes and not nested:
            raise MemobenchError(f"found option {name!r} for executor {executor!r}, {nearest(name, takes)}")
    missing = [name for name in ("partition", "time") if executor == "slurm" and name not in (options or {})]
    if missing:
        raise MemobenchError(
            f"executor 'slurm' needs {' and '.join(missing)}: pass e.g. partition=cpu and time=08:00:00 as options"
        )
    _arguments(executor, options or {})


def _check_installed(executor: str) -> None:
    try:
        import datatrove  # noqa: F401

        if executor == "ray":
            import ray  # noqa: F401
    except ImportError as error:
        raise MemobenchError(
            f"executor {executor!r} needs {error.name}, which is not installed: pip install "
            f"{'datatrove ray' if executor == 'ray' else 'datatrove'}"
        ) from None


def _executor_class(executor: str) -> Callable[..., Any]:
    from datatrove import executor as executors

    found: Callable[..., Any] = getattr(executors, DATATROVE[executor])
    return found


@dataclass(frozen=True)
class Datatrove:
    """One of datatrove's executors, and what it is told.

    Attributes:
        executor: one of ``EXECUTORS`` but ``processes``.
        workers: jobs at a time.
        logs: folder for its logs.
        jobs_per_rank: jobs that one of its tasks runs, one after another.
        options: its further arguments.
    """

    executor: str
    workers: int
    logs: Path
    jobs_per_rank: int
    options: Mapping[str, Any] = field(default_factory=dict)

    def run(self, jobs: Sequence[Job], tell: Callable[[Job], None]) -> None:
        """Run the jobs here or on Ray; ``tell`` of each."""
        with _watching(jobs, tell):
            self._making(jobs).run()
        for job in jobs:
            if job.finished():
                tell(job)
        check_finished(jobs, self.logs)  # Ray's executor returns though tasks failed

    def submit(self, jobs: Sequence[Job], finish: Callable[[], Any] | None) -> None:
        """Hand the jobs to Slurm, and with them a last one that calls ``finish`` when they are done."""
        making = self._making(jobs, job_name=NAME)
        if finish is None:
            making.run()
            return
        from lerobot_memobench.jobs.datatrove_steps import FinishStep

        settings = {**self.arguments, "logging_dir": str(self.logs / "finish")}
        settings["job_name"] = f"{settings.get('job_name', NAME)}-finish"
        settings["gpus_per_task"] = 0  # it merges, or assembles
        words = settings.get(NESTED[0], {})
        settings[NESTED[0]] = {word: value for word, value in words.items() if word not in GPU_WORDS}
        settings["run_on_dependency_fail"] = True  # else it would wait for ever for an array with a failed member
        step = FinishStep(list(jobs), self.logs, finish)
        _executor_class(self.executor)([step], tasks=1, depends=making, **settings).run()

    def _making(self, jobs: Sequence[Job], **settings: Any) -> Any:
        from lerobot_memobench.jobs.datatrove_steps import JobsStep

        ranks = max(min(self.workers, len(jobs)), -(-len(jobs) // self.jobs_per_rank))
        settings = {**settings, "logging_dir": str(self.logs / "make"), **self.arguments}
        apart = self.executor == "ray" or (self.executor == "local" and self.workers > 1)
        step = JobsStep(list(jobs), apart)
        return _executor_class(self.executor)([step], tasks=ranks, workers=self.workers, **settings)

    @property
    def arguments(self) -> dict[str, Any]:
        """What the executor is made with, beside the jobs, their number and the place of its logs."""
        # What is finished is known from the jobs' folders, better than from datatrove's list of completed tasks.
        found = {"skip_completed": False, **_arguments(self.executor, self.options)}
        if self.executor == "slurm":  # datatrove's job of statistics depends on the success of all members
            found[NESTED[0]] = {"kill-on-invalid-dep": "yes", **found.get(NESTED[0], {})}
        return found


@contextlib.contextmanager
def _watching(jobs: Sequence[Job], tell: Callable[[Job], None]) -> Iterator[None]:
    """Tell of finished jobs as they appear: datatrove has no such callback."""
    over = threading.Event()

    def watch() -> None:
        waiting = list(jobs)
        while not over.wait(POLL_SECONDS):
            for job in [job for job in waiting if job.finished()]:
                waiting.remove(job)
                tell(job)

    thread = threading.Thread(target=watch, daemon=True)
    thread.start()
    try:
        yield
    finally:
        over.set()
        thread.join()
