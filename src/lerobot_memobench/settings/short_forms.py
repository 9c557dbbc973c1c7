"""The words that are shorter than LeRobot's names for a setting, and those that are no settings of LeRobot's."""

from __future__ import annotations

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
EVALUATION_WORDS = ("resume", "shard", "shards", "workers", "executor", "executor_option")

#: Words of `lerobot train` that are none of LeRobot's (see `settings.training`).
TRAINING_WORDS = ("prompt_frames", "obs_type")
