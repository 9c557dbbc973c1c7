"""``lerobot eval env=memobench``: the benchmark's defaults, and the choice of how it is run."""

from __future__ import annotations

import datetime as dt
import os
from collections.abc import Callable
from pathlib import Path

from lerobot_memobench.cli import preflight
from lerobot_memobench.cli.arguments import Translation
from lerobot_memobench.cli.evaluation import Evaluation, make_grid
from lerobot_memobench.cli.orders import Orders
from lerobot_memobench.cli.running import run_evaluation
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.evaluation.records.protocol import CARD_FILE, read_card

ENVIRONMENT = "memobench"
EXPERT = "memobench_expert"
FIRST_SEED = 7
"""Episode i of the protocol uses seed 7 + i."""


def evaluate(
    translation: Translation, run: Callable[[], int], say_where: bool = True, orders: Orders | None = None
) -> int:
    """Complete the flags of an evaluation, run it, write and print its report; return the exit status.

    An environment of LeRobot's own gets nothing but the checks.
    """
    orders = orders or Orders()
    if not translation.has("env.type") and not translation.has("config_path"):
        raise MemobenchError("name an environment: env=memobench")
    if translation.get("env.type") != ENVIRONMENT:
        if orders.any:
            raise MemobenchError("resume=, shard= and shards= belong to the benchmark: name it with env=memobench")
        preflight.check_policy(translation)
        return run()
    evaluation = prepare(translation, orders)
    if orders.shards:
        from lerobot_memobench.cli.shards import run_shards

        return run_shards(evaluation)
    return run_evaluation(evaluation, run, say_where)


def prepare(translation: Translation, orders: Orders) -> Evaluation:
    """Complete the flags and find out what they ask for; what is wrong with them is told here."""
    if orders.resume and not translation.has("output_dir"):
        raise MemobenchError("resume=true needs the folder of the evaluation to go on with: output_dir=<folder>")
    if orders.shard is not None and translation.has("output_dir"):
        translation.set("output_dir", Path(translation.get("output_dir") or "") / orders.shard.folder)
    add_policy(translation)
    preflight.check_policy(translation)
    policy = preflight.parse_choice(translation, "policy")
    if orders.resume:
        add_earlier_batch_size(translation)
    if orders.shard is not None or orders.shards:
        translation.add("eval.batch_size", 1)  # by cores, each machine would cut the evaluation differently
    most = getattr(policy, "max_environments", None)
    if most is not None:
        add_batch_size(translation, most)  # its servers keep one memory each
    add_protocol(translation, getattr(policy, "n_action_steps", None))
    environment = preflight.parse_choice(translation, "env")
    if environment is None and orders.any:
        raise MemobenchError("resume=, shard= and shards= cannot go with config_path=; give its settings on the line")
    grid = make_grid(translation, environment) if environment is not None else None
    preflight.check_rendering()
    return Evaluation(translation, orders, policy, environment, grid)


def add_policy(translation: Translation) -> None:
    """Use the scripted expert where no policy is named, and let the environment offer it its action."""
    if not translation.has("policy.path"):
        translation.add("policy.type", EXPERT)
    if translation.get("policy.type") == EXPERT:
        translation.add("env.expert_action", True)
    if "policy" not in translation.chosen:
        from lerobot.configs.policies import PreTrainedConfig

        name = translation.get("policy.type")
        if name is not None:
            translation.chosen["policy"] = PreTrainedConfig.get_choice_class(name)


def add_protocol(translation: Translation, n_action_steps: int | None) -> None:
    """Set seed, episodes, batch size, device and folders where the user has not."""
    import torch

    translation.add("seed", FIRST_SEED)
    translation.add("eval.n_episodes", 50)
    add_batch_size(translation)
    if not torch.cuda.is_available() and not torch.backends.mps.is_available():
        translation.add("policy.device", "cpu")
    if n_action_steps is not None:
        translation.add("env.replan_steps", n_action_steps)
    translation.add("output_dir", default_output(translation))
    translation.add("env.log_dir", translation.get("output_dir"))


def add_batch_size(translation: Translation, most: int = 64) -> None:
    """Choose the largest batch that LeRobot would choose and that divides the episodes; at most ``most``.

    LeRobot runs whole batches and throws the surplus of the last one away, after simulating it.
    """
    if (translation.get("eval.batch_size") or "0") != "0":
        return
    episodes = int(translation.get("eval.n_episodes") or 50)
    limit = max(1, min(int((os.cpu_count() or 4) * 0.7), episodes, most))
    translation.set("eval.batch_size", max(size for size in range(1, limit + 1) if episodes % size == 0))


def add_earlier_batch_size(translation: Translation) -> None:
    """Use the batch size of the evaluation that is gone on with: what a policy samples may depend on it."""
    path = Path(translation.get("env.log_dir") or translation.get("output_dir") or "") / CARD_FILE
    if path.is_file() and (translation.get("eval.batch_size") or "0") == "0":
        translation.set("eval.batch_size", read_card(path)["runs"][-1]["batch_size"])


def default_output(translation: Translation) -> Path:
    """Return a folder that no evaluation has used: ``outputs/eval/<date>/<time>_memobench_<policy>``."""
    chosen = translation.chosen.get("policy")
    name = translation.get("policy.type") or (chosen.get_choice_name(chosen) if chosen else "policy")  # type: ignore[attr-defined]
    now = dt.datetime.now()
    base = Path("outputs/eval") / f"{now:%Y-%m-%d}" / f"{now:%H-%M-%S}_{ENVIRONMENT}_{name}"
    folder, k = base, 1
    while folder.exists():
        k += 1
        folder = base.with_name(f"{base.name}_{k}")
    return folder
