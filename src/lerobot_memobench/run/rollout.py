"""What LeRobot's evaluation loop is made to do beside its own: run parts of a task, seed batches, draw what is needed.

LeRobot seeds Python, NumPy and torch once per run, so what a sampling policy draws in an episode depends on all that
ran before it. Here each batch is seeded from the run's seed, the task and the batch's first episode: an evaluation
that is resumed or shared among machines draws what an undisturbed one draws.

LeRobot draws every picture. Here a picture is drawn and converted only for a policy that needs the observation; between
two of these a policy is handed the pictures and objects of the last one, which it has said it will not read. All else
of an observation is of the present. The environment records videos itself (``env.videos``): LeRobot would render ten
episodes of each task a second time. What a dataset is asked for of a rollout, `recording` writes.

Written against loops that were read: what it relies on is listed in tests/run/test_lerobot_loop.py, whose failures say
what to look at when LeRobot moves on. A loop or a policy that nobody has read is known by its source, and gets every
picture. How it gets there, and out again: `lerobot_hooks`.
"""

from __future__ import annotations

import functools
import hashlib
import sys
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, closing, contextmanager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np
import torch
from lerobot.envs import check_env_attributes_and_types, preprocess_observation
from lerobot.envs.utils import NEW_ROLLOUT_OPTION
from lerobot.utils.constants import ACTION, OBS_IMAGES
from numpy.typing import NDArray
from tqdm import trange

from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.jobs.threads import limit_torch
from lerobot_memobench.lerobot_hooks import INSIDE_SLURM, ROLLOUT, RUN_ONE, check_version, hooked, is_read
from lerobot_memobench.run.memory_reads import ReadLog
from lerobot_memobench.run.plan import Range
from lerobot_memobench.run.recording import Recorder

PIXELS, PHASE = "pixels", "phase"
"""Of an observation: what is left out where nobody needs it; 0 in the demonstration prompt, 1 in execution."""
KEEPS_FRAMES = ("return_observations", "render_callback", "predicted_latents_callback")
"""Settings of LeRobot's rollout that make use of every frame, or of what only its own loop does."""
RECORDS = ("recording_dir", "env_features", "recording_repo_id", "recording_private")
"""Settings by which a rollout is recorded as a dataset; see `recording`."""
QUEUES = ("_action_queue", "_queues")
"""Attributes in which LeRobot's policies keep planned actions, or earlier observations."""
_rolling: WeakKeyDictionary[Any, threading.Lock] = WeakKeyDictionary()
"""A lock for each such policy that has been rolled out."""
KEEPS_ITS_NOISE = ("memobench_mem",)
"""Policies that seed each episode's noise themselves, from torch's initial seed: it must stay the run's."""
LOOPS = ("ed85d8da2c46",)
"""`lerobot_hooks.digest` of each rollout of LeRobot's whose steps `_roll` takes."""


@dataclass(frozen=True)
class ChunkPolicy:
    """A policy of LeRobot's that plans action chunks.

    Attributes:
        needs: whether one of them needs the next observation.
        read: `lerobot_hooks.digest` of each ``select_action`` by which it does.
    """

    needs: Callable[[Any], bool]
    read: tuple[str, ...]


KNOWN: dict[tuple[str, str], ChunkPolicy] = {
    ("lerobot.policies.act.modeling_act", "ACTPolicy"): ChunkPolicy(
        lambda policy: policy.config.temporal_ensemble_coeff is not None or not policy._action_queue,
        ("031085d1a22c",),
    ),
    ("lerobot.policies.pi0.modeling_pi0", "PI0Policy"): ChunkPolicy(
        lambda policy: not policy._action_queue, ("a330b536084c",)
    ),
    # Its visual memory takes in the pictures of every step.
    ("lerobot.policies.pi05.modeling_pi05", "PI05Policy"): ChunkPolicy(
        lambda policy: getattr(policy.config, "use_visual_memory", False) or not policy._action_queue,
        ("a330b536084c", "41d18fe29b12"),
    ),
    ("lerobot.policies.smolvla.modeling_smolvla", "SmolVLAPolicy"): ChunkPolicy(
        lambda policy: not policy._queues[ACTION], ("3b7b12d0066f",)
    ),
}
"""By module and class."""


@contextmanager
def calm_output() -> Iterator[None]:
    """Keep progress bars out of log files."""
    # The bar is redrawn at every step. LeRobot leaves it out where it takes itself to be in a batch job.
    with nullcontext() if sys.stderr.isatty() else hooked(INSIDE_SLURM, lambda _: lambda: True):
        yield


@contextmanager
def steered(
    seed: int | None,
    ranges: Mapping[tuple[str, int], list[Range]] | None = None,
    reads: ReadLog | None = None,
    begin: Callable[[], None] = lambda: None,
) -> Iterator[None]:
    """While this lasts, LeRobot's loop seeds batches, draws what is observed, records nothing and runs only ``ranges``.

    Args:
        seed: of the run; batches are not seeded when None.
        ranges: by LeRobot's name of a task the runs of it; everything when None.
        reads: where it is noted how much the policy's chunks read of what it remembers; not when None.
        begin: called once, before the first scene, when LeRobot has loaded the policy.

    Raises:
        MemobenchError: the installed LeRobot is another than those whose loop is known here.
    """
    check_version()
    from lerobot.scripts import lerobot_eval

    def one(run_one: Callable[..., Any]) -> Callable[..., Any]:
        run = _begun(_unrecorded(run_one), begin)
        return run if ranges is None else _only(run, ranges)

    def rolled(rollout: Callable[..., Any]) -> Callable[..., Any]:
        spared = sparing(rollout, lambda: lerobot_eval.inside_slurm(), reads)
        return spared if seed is None else _seeded(spared, seed)

    with hooked(RUN_ONE, one), hooked(ROLLOUT, rolled):
        yield


def _begun(run_one: Callable[..., Any], begin: Callable[[], None]) -> Callable[..., Any]:
    """Wrap LeRobot's evaluation of one task: something is called before the first, tasks may run in threads."""
    lock, pending = threading.Lock(), [begin]

    @functools.wraps(run_one)
    def run(*args: Any, **settings: Any) -> Any:
        with lock:
            if pending:
                pending.pop()()
        return run_one(*args, **settings)

    return run


def _unrecorded(run_one: Callable[..., Any]) -> Callable[..., Any]:
    """Wrap LeRobot's evaluation of one task: it renders no episode, and makes no folder for videos."""

    @functools.wraps(run_one)
    def run(task_group: str, task_id: int, env: Any, **settings: Any) -> tuple[str, int, dict[str, Any]]:
        imagines = getattr(getattr(settings.get("policy"), "config", None), "save_predicted_video", False)
        folder = settings["videos_dir"] if imagines else None  # a world model's own videos stay
        return run_one(task_group, task_id, env, **{**settings, "max_episodes_rendered": 0, "videos_dir": folder})

    return run


def _only(run_one: Callable[..., Any], ranges: Mapping[tuple[str, int], list[Range]]) -> Callable[..., Any]:
    """Wrap LeRobot's evaluation of one task: it is called once per range, the results are joined."""

    @functools.wraps(run_one)
    def run(task_group: str, task_id: int, env: Any, **settings: Any) -> tuple[str, int, dict[str, Any]]:
        joined: dict[str, Any] = {}
        mine = ranges.get((task_group, task_id), [])
        for first, count in mine:
            changed = {**settings, "start_seed": settings["start_seed"] + first, "n_episodes": count}
            for folder in ("videos_dir", "recording_dir"):
                if len(mine) > 1 and settings.get(folder) is not None:  # LeRobot numbers its videos from 0
                    changed[folder] = settings[folder] / f"from_{first}"
            _, _, metrics = run_one(task_group, task_id, env, **changed)
            for key, values in metrics.items():
                joined[key] = [*joined.get(key, []), *values]
        return task_group, task_id, joined

    return run


def _seeded(rollout: Callable[..., Any], seed: int) -> Callable[..., Any]:
    """Wrap LeRobot's rollout of one batch: what the policy draws depends on the batch alone."""
    first_seeds: dict[str, int] = {}  # of the policy's own generators: a setting of the policy's may have chosen them

    @functools.wraps(rollout)
    def run(env: Any, policy: Any, *args: Any, **settings: Any) -> Any:
        seeds = settings.get("seeds")
        if seeds and getattr(policy, "name", None) not in KEEPS_ITS_NOISE:
            _seed_batch(policy, first_seeds, seed, env.call("task")[0], seeds[0])
        return rollout(env, policy, *args, **settings)

    return run


def _seed_batch(policy: Any, first_seeds: dict[str, int], seed: int, task: str, first: int) -> None:
    """Seed what LeRobot seeds, and the policy's own generators, whose first seeds are remembered and still count."""
    from lerobot.utils.random_utils import set_seed
    from torch import Generator

    set_seed(batch_seed(seed, task, first))
    for name, generator in vars(policy).items():
        if isinstance(generator, Generator):
            own = first_seeds.setdefault(name, generator.initial_seed())
            generator.manual_seed(batch_seed(seed, task, first, own))


def batch_seed(seed: int, task: str, first: int, *more: int) -> int:
    """Return the seed (32 bits) of the batch that begins with the episode of the seed ``first``."""
    text = " ".join(str(part) for part in (seed, task, first, *more))
    return int.from_bytes(hashlib.blake2b(text.encode(), digest_size=4).digest(), "big")


# --- the loop over control steps: the same steps in the same order as LeRobot's, and the same tensors ---


def sparing(
    rollout: Callable[..., dict[str, Any]], hides_progress: Callable[[], bool], reads: ReadLog | None = None
) -> Callable[..., dict[str, Any]]:
    """Wrap LeRobot's rollout: where nothing but the policy takes the frames, only those that it needs are drawn.

    Args:
        hides_progress: whether the bar over a rollout's steps is left out.
        reads: see `steered`.
    """
    known = is_read(rollout, LOOPS)  # another loop may take other steps

    @functools.wraps(rollout)
    def run(env: Any, policy: Any, *args: Any, **settings: Any) -> dict[str, Any]:
        limit_torch(sum(parameter.numel() for parameter in getattr(policy, "parameters", tuple)()))
        noting = nullcontext() if reads is None else reads.noting(env, policy, settings["seeds"])
        with _alone(policy), noting as ended:
            if args or not known or any(settings.get(name) for name in KEEPS_FRAMES):
                return rollout(env, policy, *args, **settings)
            return _roll(env, policy, settings, quiet=hides_progress(), ended=ended)

    return run


@contextmanager
def _alone(policy: Any) -> Iterator[None]:
    """Refuse a second rollout at once with a policy that has one queue for both, as LeRobot would run them."""
    queued = any(hasattr(policy, name) for name in QUEUES)
    if queued and not _rolling.setdefault(policy, threading.Lock()).acquire(blocking=False):
        raise MemobenchError(
            f"env.max_parallel_tasks rolls out two tasks at once with one policy, and {policy.name} has one queue, in "
            "which actions or pictures of both would stand; leave it out, and ask for more rows by eval.batch_size"
        )
    try:
        yield
    finally:
        if queued:
            _rolling[policy].release()


def _roll(
    env: Any, policy: Any, settings: dict[str, Any], quiet: bool, ended: Callable[[NDArray[np.bool_]], None] | None
) -> dict[str, Any]:
    """Run one episode in each environment of a batch; see LeRobot's rollout for what is returned.

    Args:
        ended: told after each step which episodes are over.
    """
    policy.reset()
    observation, _ = env.reset(seed=settings.get("seeds"), options={NEW_ROLLOUT_OPTION: True})
    limit = env.call("_max_episode_steps")[0]
    check_env_attributes_and_types(env)
    done = ever = np.zeros(env.num_envs, bool)
    steps: list[tuple[NDArray[Any], ...]] = []
    bar = trange(limit, desc=f"Running rollout with at most {limit} steps", disable=quiet, leave=False)
    with bar, _recorder(env, settings) as recorder:
        inputs = Inputs(env, needs_observation(policy) if recorder is None else lambda: True)
        while not done.all() and len(steps) < limit:
            before, batch = observation, inputs.of(observation)
            action = _act(env, policy, settings, batch)
            inputs.announce()
            observation, reward, terminated, truncated, info = env.step(action)
            holds = info.get("final_info", info).get("is_success", False)
            success = np.broadcast_to(np.asarray(holds, bool), env.num_envs)
            done = terminated | truncated | done | (len(steps) + 1 == limit)
            ever = ever | success
            if ended is not None:
                ended(done)
            if recorder is not None:
                broken = np.broadcast_to(info.get("_fault", False), done.shape)  # gymnasium's mark of rows that tell it
                recorder.add(before, action, reward, success, done, batch["task"], broken)
            steps.append((action, reward, success, done))
            bar.set_postfix({"running_success_rate": f"{ever.mean() * 100:.1f}%"}, refresh=False)
            bar.update()
    if hasattr(policy, "use_original_modules"):
        policy.use_original_modules()
    stacked = (torch.from_numpy(np.stack(parts, axis=1)) for parts in zip(*steps, strict=True))
    return dict(zip((ACTION, "reward", "success", "done"), stacked, strict=True))


def _recorder(env: Any, settings: Mapping[str, Any]) -> AbstractContextManager[Recorder | None]:
    """Return what records the batch, None where nothing does; what it has recorded is whole when it is left."""
    folder, features, repository, private = (settings.get(name) for name in RECORDS)
    if folder is None or features is None:
        return nullcontext()
    fps = env.unwrapped.metadata["render_fps"]
    return closing(Recorder(Path(folder), features, env.num_envs, fps, repository, bool(private)))


def _act(env: Any, policy: Any, through: Mapping[str, Any], batch: dict[str, Any]) -> NDArray[np.float32]:
    """Return the actions (batch, A) of a policy for an observation, both ``through`` the processors of each."""
    batch["task"] = list(env.call("task_description"))
    processed = through["preprocessor"](through["env_preprocessor"](batch))
    with torch.inference_mode():
        action = policy.select_action(processed)
    action = through["env_postprocessor"]({ACTION: through["postprocessor"](action)})[ACTION]
    found: NDArray[np.float32] = action.to("cpu").numpy()
    return found


class Inputs:
    """The observations of a rollout as its policy gets them.

    Args:
        env: the vector environment, told whether its next pictures and objects are needed.
        needed: tells, after an action, whether the policy needs the next observation.
    """

    def __init__(self, env: Any, needed: Callable[[], bool]) -> None:
        self._env, self._needed = env, needed
        self._drawn = True  # since the environment's reset
        self._pictures: dict[str, torch.Tensor] = {}
        self._phase: NDArray[np.float32] | None = None

    def announce(self) -> None:
        """Tell the environment, before its step, whether anybody needs the observation after it."""
        needed = self._needed()
        if needed != self._drawn:
            self._env.call("need_observation", needed)
            self._drawn = needed

    def of(self, observation: dict[str, Any]) -> dict[str, Any]:
        """Return LeRobot's form of an observation, with the last pictures where nobody needs new ones."""
        begins = self._phase is None or bool((observation[PHASE] != self._phase).any())
        self._phase = np.array(observation[PHASE])
        if begins or self._drawn:  # the first frame of an execution is always drawn: none can know when it comes
            converted = preprocess_observation(observation)
            self._pictures = {key: value for key, value in converted.items() if key.startswith(OBS_IMAGES)}
            return converted
        converted = preprocess_observation({key: value for key, value in observation.items() if key != PIXELS})
        return {**self._pictures, **converted}


def needs_observation(policy: Any) -> Callable[[], bool]:
    """Return what tells, before a step, whether a policy needs pictures or objects of the observation after it.

    A policy of ours says so itself, by its method of that name. LeRobot's policies that plan action chunks need one
    when their queue is empty; each is known by the very function that was read, so a subclass that acts in another way,
    a wrapped policy, one of a LeRobot that acts otherwise, and any other need every observation. (`diffusion` queues
    pictures at every step.)
    """
    own = getattr(policy, "needs_observation", None)
    if own is not None:
        return own
    acts: Any = getattr(type(policy), "select_action", None)
    for (module, name), known in KNOWN.items():
        # A policy of a module that nobody has imported is not here.
        theirs: Any = getattr(getattr(sys.modules.get(module), name, None), "select_action", None)
        if theirs is not None and acts is theirs and is_read(theirs, known.read):
            return lambda: known.needs(policy)
    return lambda: True
