"""The words that are shorter than LeRobot's names for a setting, and those that are no settings of LeRobot's."""

from __future__ import annotations

import textwrap
from typing import NamedTuple

EVERYWHERE: dict[str, tuple[str, ...]] = {
    "align": ("policy.align",),
    "size": ("policy.size",),
    "perception": ("policy.perception",),
    "eyes": ("policy.eyes",),
    "device": ("policy.device",),
    "replan": ("policy.n_action_steps", "env.replan_steps"),
    "tasks": ("env.tasks",),
    "obs_type": ("env.obs_type",),
    "suite": ("env.suite",),
    "referent": ("env.referent",),
}

#: Command -> short form -> the fields it sets, of which those that exist are set.
SHORT_FORMS: dict[str, dict[str, tuple[str, ...]]] = {
    "eval": {
        **EVERYWHERE,
        "host": ("policy.host",),
        "port": ("policy.port",),
        "dialect": ("policy.dialect",),
        "prompt_video": ("env.prompt_video",),
        "prompt_in": ("env.prompt_in",),
        "horizon": ("env.horizon",),
        "films": ("env.films",),
        "episodes": ("eval.n_episodes",),
        "batch_size": ("eval.batch_size",),
    },
    "train": {**EVERYWHERE, "episodes": ("dataset.episodes",)},
}

#: Short forms that choose something rather than set a field.
CHOOSING = ("policy", "env", "dataset")

#: Words of `lerobot eval env=memobench` that say how it is run, not what (see `engine.orders`).
EVALUATION_WORDS = ("verbose", "resume", "shard", "shards", "workers", "executor", "executor_option")

#: Words of `lerobot train` that are none of LeRobot's (see `settings.training`).
TRAINING_WORDS = ("prompt_frames", "obs_type")


class Meaning(NamedTuple):
    """A row of the help: what is typed, what it sets, and what holds without it ("" where nothing is said)."""

    words: str
    sets: str
    default: str = ""


#: Command -> what `lerobot <command> --help` says of its words; docs/evaluate.md and docs/train.md have the same rows.
MEANINGS: dict[str, tuple[Meaning, ...]] = {
    "eval": (
        Meaning(
            "policy=",
            "a checkpoint folder (or a training run's), a repository user/name, a policy of the package, or a policy "
            "type; a folder that is named like one of these is named by a path, ./act",
            "the scripted expert",
        ),
        Meaning(
            "host=, port=, dialect=",
            "with policy=remote: the policy server that acts",
            "127.0.0.1, by dialect, openpi",
        ),
        Meaning("suite=", "published, or strict: thirty tasks made to need a memory", "published"),
        Meaning(
            "tasks=",
            "of that suite all, memory types (temporal, spatial, object, procedural), task names, or numbers and "
            "ranges of memobench tasks (12, 3-7), separated by commas",
            "all",
        ),
        Meaning("episodes=", "episodes per task; episode i uses the seed 7 + i, or that of seed= + i", "50"),
        Meaning(
            "replan=",
            "the policy executes so many actions of each prediction; also noted in the log",
            "the policy's own",
        ),
        Meaning(
            "obs_type=",
            "what is seen: pixels_agent_pos, environment_state_agent_pos or both",
            "what the policy was trained on, else pictures",
        ),
        Meaning(
            "eyes=",
            "with a policy that sees objects: package or a file, eyes that find them in pictures",
            "none: the environment tells them",
        ),
        Meaning(
            "referent=",
            "fixed: the published goals; random: the seed decides what the prompt video shows; strict tasks are always "
            "drawn",
            "fixed",
        ),
        Meaning("prompt_video=", "false leaves the prompt out", "true"),
        Meaning(
            "prompt_in=",
            "steps: the policy sees the prompt; reset: it plays before the first observation",
            "by the policy",
        ),
        Meaning("horizon=", "execution steps per episode", "1200"),
        Meaning(
            "films=",
            "episodes of each task that are filmed: 0 to n − 1",
            "10, without pictures in the observations 0",
        ),
        Meaning(
            "batch_size=",
            "environments at once, each in a process of its own",
            "by cores, dividing the episodes",
        ),
        Meaning("device=", "where the policy runs: cpu, cuda, …", "the checkpoint's, else by machine"),
        Meaning("output_dir=", "where everything goes", "outputs/eval/<date>/<time>_…"),
        Meaning("verbose=", "true: LeRobot's own messages too, its configuration and progress", "false"),
        Meaning("resume=", "true: go on with the evaluation in output_dir=", "false"),
        Meaning("shard=", "run this part alone, such as 1/8; memobench merge joins the parts", "all of it"),
        Meaning("shards=", "run so many parts as jobs and merge them", "no parts"),
        Meaning(
            "workers=, executor=, executor_option=",
            "with shards=: how many jobs at once; processes, local, slurm or ray; what that one takes, key=value",
            "all at once, processes",
        ),
        Meaning(
            "align=, size=, perception=",
            "of a policy named by its type, as in lerobot train; a checkpoint keeps its own, and others are refused",
            "the type's",
        ),
    ),
    "train": (
        Meaning("policy=", "a policy type, or a checkpoint to start from"),
        Meaning("config=", "a recipe of memobench recipe, or a YAML file of your own"),
        Meaning("align=", "how memory is aligned with checkpoint language: none, semantic, contrastive, framewise"),
        Meaning("dataset=", "a folder that memobench generate wrote, or a repository user/name"),
        Meaning("size=", "small and tiny: a few million parameters, from scratch, on a CPU; pi05: 3.2 billion"),
        Meaning(
            "perception=",
            "pixels: pictures, through a frozen tower, at size=small through eyes; objects: what can be seen, as "
            "numbers",
        ),
        Meaning(
            "eyes=",
            "with perception=objects: eyes that find them in pictures; with pixels, the eyes looked through",
        ),
        Meaning("replan=", "actions executed per prediction at evaluation"),
        Meaning(
            "obs_type=",
            "what a policy of LeRobot's learns to see: pixels_agent_pos, environment_state_agent_pos or both; left "
            "out: pictures where the dataset has them, else objects",
        ),
        Meaning("prompt_frames=", "false: no frame of a prompt is trained on; true: all are; left out: by the policy"),
        Meaning("episodes=", "of the dataset, those of these numbers: [0, 1, 2]"),
        Meaning("device=", "where it is trained: cpu, cuda, …"),
        Meaning("output_dir=", "where everything goes; with resume=true, the training that is gone on with"),
        Meaning("resume=", "true: go on with the last checkpoint in output_dir="),
        Meaning("steps=", "updates of the weights, with resume=true those before included", "100000"),
        Meaning("batch_size=", "frames per update", "8, of objects or through eyes 72"),
        Meaning("save_freq=", "updates from one checkpoint to the next; the last update always makes one", "20000"),
        Meaning("env=", "memobench: evaluate within the training, every env_eval_freq= updates", "no evaluation"),
        Meaning("tasks=", "with env=: those evaluated on, as in lerobot eval", "all"),
        Meaning("suite=", "with env=: theirs, published or strict", "published"),
        Meaning("referent=", "with env=: fixed, the published goals; random, the seed decides", "fixed"),
    ),
}

EXAMPLES = {
    "eval": "lerobot eval env=memobench policy=<checkpoint> tasks=object episodes=10",
    "train": "lerobot train policy=memobench_mem align=contrastive dataset=<folder>",
}


def help_text(command: str, width: int = 100) -> str:
    """Return what `lerobot eval --help` or `lerobot train --help` says before LeRobot's own flags."""
    lines = [f"usage: {EXAMPLES[command]}", "", "short forms:"]
    for words, sets, default in MEANINGS[command]:
        told = sets + (f" (default: {default})" if default else "")
        lines += [f"  {words}", *textwrap.wrap(told, width, initial_indent=" " * 8, subsequent_indent=" " * 8)]
    lines += [
        "",
        "Any other setting goes by LeRobot's full name, as key=value or --key=value; those of what env= and policy=",
        "name are among them:",
        "",
    ]
    return "\n".join(lines)
