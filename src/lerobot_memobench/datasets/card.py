"""The dataset card: README.md beside the data, as the Hugging Face hub shows it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from lerobot_memobench.datasets.paper_figures import FAMILIES, LENGTH_BUCKETS
from lerobot_memobench.datasets.staging import StagedEpisode

LICENSE = "apache-2.0"

SCRIPTED = (
    "Scripted experts act in a MuJoCo simulation; nothing was collected from people or robots. Actions were recorded "
    "as applied, so that replaying them from the seed gives the same states."
)

COLUMNS = {
    "observation.images.image": "third-person camera",
    "observation.images.wrist_image": "wrist camera",
    "observation.state": "end-effector position 3, axis-angle 3, gripper joints 2",
    "action": "OSC pose delta 6 (±1 is ±0.05 m, ±0.5 rad), gripper (−1 opens, +1 closes)",
    "phase": "0 prompt video (the policy does not act), 1 execution",
    "checkpoint.index": "number of checkpoints completed in order before this frame",
    "checkpoint.operation": "of the next one: 0 Storage, 1 Update, 2 Compression; −1 when none is left",
    "checkpoint.completed": "checkpoint k has been satisfied by now; false beyond the task's count",
    "checkpoint.event": "a checkpoint is satisfied for the first time at this frame",
    "simple_subgoal": "text of the checkpoint being worked on, intermediate level",
    "grounded_subgoal": "the same at the fine level; once all are done, the last one's text stays",
    "coarse_subgoal": "the same at the coarse level",
    "memory": "the checkpoints completed in order before this frame, as text (oracle memory); empty at the start",
    "language_persistent": "LeRobot's language rows, styles `subtask` and `memory`, for its training recipes",
}

EPISODE_COLUMNS = {
    "task_name": "task of the catalogue",
    "memory_type": "temporal, spatial, object or procedural",
    "family": "group of similar tasks",
    "operations": "labels of the checkpoints in order, e.g. SUC",
    "seed": "seed of the scene",
    "referent": "fixed, or random: the prompt video decides what the goal is",
    "variant": "which admissible referent or order; 0 is the published one",
    "success": "the goal was reached",
    "exec_start_index": "frame at which execution starts",
    "key_frames": "frame at which each checkpoint was completed in order, −1 if never",
    "scene_hash": "hash of the initial scene",
    "fixture_poses": "JSON, fixture to position and quaternion wxyz",
    "digest": "sha256 of states, actions and labels",
}


def write_card(
    folder: Path,
    episodes: Sequence[StagedEpisode],
    features: dict[str, dict[str, Any]],
    *,
    repo_id: str,
    made_by: str,
    left_out: Sequence[str] = (),
) -> None:
    """Write ``folder``/README.md: what the dataset is, its columns, how it was made, statistics, licence."""
    written = [episode.info for episode in episodes if episode.failure is None]
    failed = [episode for episode in episodes if episode.failure is not None]
    tasks = sorted({info["task_name"] for info in written})
    storage = _storage(folder, [episode for episode in episodes if episode.failure is None])
    parts = [
        _front_matter(len(written)),
        "# MEMOBench demonstrations",
        f"{len(written)} demonstrations of {len(tasks)} robot manipulation tasks that need memory "
        f"({_memory_types(written)}), as a LeRobotDataset v3.0 at 20 frames per second. Each task names the "
        "checkpoints a memory has to keep (Storage), revise (Update) or summarise (Compression); every frame "
        "says which of them are done, because the simulator wrote the labels. Benchmark and metrics: "
        "MEMOBench; "
        "generator, environment and policies: `lerobot_memobench`.",
        f'```python\nfrom lerobot.datasets import LeRobotDataset\n\ndataset = LeRobotDataset("{repo_id}", '
        'root="<this folder>")\n'
        'one_type = LeRobotDataset(..., episode_filter=lambda episode: episode["memory_type"] == "spatial")\n'
        "```",
        "Pass `collate_fn=lerobot.utils.collate.lerobot_collate_fn` to a DataLoader of your own: language "
        "rows "
        "differ in number between episodes. `lerobot-train` does so by itself.",
        "## How it was made",
        (made_by or f"Written by `lerobot_memobench`. {SCRIPTED}") + " `manifest.json` holds a hash of every episode's "
        "states, actions and labels; `states/` holds the simulator's states (1 + nq + nv numbers per frame).",
        _failures(failed, len(episodes)),
        _left_out(left_out),
        "## Statistics",
        "Steps are frames: control steps of 50 ms, prompt video included. The paper's rows are those of its "
        "demonstrations (appendix, family level statistics), stored as HDF5; storage here is that of the "
        "LeRobotDataset: videos as they are, everything else in proportion to the frames.",
        _statistics(written, storage),
        _prompts(written),
        "How many episodes have which length, in steps (paper: appendix, distribution of lengths):",
        _buckets(written),
        _per_task(written, failed),
        "## Columns",
        _table(
            ["column", "type", "meaning"],
            [[f"`{key}`", _type(ft), COLUMNS[key]] for key, ft in features.items() if key in COLUMNS],
        ),
        "LeRobot's own columns are there too: `task`, `timestamp`, `frame_index`, `episode_index`, `index`, "
        "`task_index`.",
        "Per episode, in `meta/episodes`:",
        _table(["column", "meaning"], [[f"`{key}`", meaning] for key, meaning in EPISODE_COLUMNS.items()]),
        "`meta/stats.json` holds mean, standard deviation, range and the quantiles q01, q10, q50, q90, "
        "q99; those "
        "of numbers are exact over all frames, those of images over sampled frames.",
        "## Licence",
        "Apache-2.0.",
    ]
    (folder / "README.md").write_text("\n\n".join(part for part in parts if part) + "\n", encoding="utf-8")


def _front_matter(count: int) -> str:
    bucket = "n<1K" if count < 1000 else "1K<n<10K"
    return "\n".join(
        [
            "---",
            f"license: {LICENSE}",
            "task_categories:",
            "- robotics",
            "tags:",
            *(f"- {tag}" for tag in ("LeRobot", "memobench", "memory", "manipulation", "simulation", "mujoco")),
            "language:",
            "- en",
            "size_categories:",
            f"- {bucket}",
            "configs:",
            "- config_name: default",
            "  data_files: data/*/*.parquet",
            "---",
        ]
    )


def _memory_types(infos: Sequence[dict[str, Any]]) -> str:
    return ", ".join(ordered_types(infos))


def _failures(failed: Sequence[StagedEpisode], asked: int) -> str:
    if not failed:
        return f"All {asked} seeds asked for were solved; none was left out."
    lines = [f"- {e.info['task_name']}, seed {e.info['seed']}: {e.failure}" for e in failed]
    return f"**{len(failed)} of {asked} seeds asked for have no demonstration here:**\n\n" + "\n".join(lines)


def _left_out(problems: Sequence[str]) -> str:
    if not problems:
        return ""
    return f"**Left out ({len(problems)}):**\n\n" + "\n".join(f"- {problem}" for problem in problems)


def _storage(folder: Path, episodes: Sequence[StagedEpisode]) -> dict[str, float]:
    """Return bytes per memory type, and their ``total``; what belongs to no episode is shared out by frames."""
    total = sum(path.stat().st_size for path in folder.rglob("*") if path.is_file() and "hdf5" not in path.parts)
    videos = sum(episode.video_bytes for episode in episodes)
    frames = sum(episode.info["frames"] for episode in episodes)
    found: dict[str, float] = {"total": float(total)}
    for episode in episodes:
        share = episode.video_bytes + (total - videos) * episode.info["frames"] / frames
        found[episode.info["memory_type"]] = found.get(episode.info["memory_type"], 0.0) + share
    return found


def ordered_types(infos: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return the memory types of episodes, each once: the paper's in its order, then a user's own."""
    there = {info["memory_type"] for info in infos}
    return [name for name in FAMILIES if name in there] + sorted(there - set(FAMILIES))


def _statistics(infos: Sequence[dict[str, Any]], storage: dict[str, float]) -> str:
    rows = []
    for name in [*ordered_types(infos), "total"]:
        chosen = [info for info in infos if name in (info["memory_type"], "total")]
        lengths = np.array([info["frames"] for info in chosen])
        tasks = len({info["task_name"] for info in chosen})
        figures = [lengths.mean(), np.median(lengths), np.percentile(lengths, 95)]
        row = [name, "here", f"{tasks}", f"{len(chosen):,}", f"{lengths.sum():,}", *(f"{x:,.2f}" for x in figures)]
        rows.append([*row, f"{lengths.max():,}", _bytes(storage.get(name, 0.0))])
        if name in FAMILIES:
            paper = FAMILIES[name]
            figures = [paper.mean, paper.median, paper.p95]
            row = ["", "paper", f"{paper.tasks}", f"{paper.episodes:,}", f"{paper.steps:,}"]
            rows.append([*row, *(f"{x:,.2f}" for x in figures), f"{paper.max:,}", f"{paper.storage:.2f} GiB"])
    header = ["memory type", "", "tasks", "episodes", "steps", "mean", "median", "P95", "max", "storage"]
    frames = sum(info["frames"] for info in infos)
    return _table(header, rows) + f"\n\n{storage['total'] / frames:,.0f} bytes per frame."


def _bytes(size: float) -> str:
    return f"{size / 1024**3:.2f} GiB" if size >= 0.1 * 1024**3 else f"{size / 1024**2:.2f} MiB"


def _prompts(infos: Sequence[dict[str, Any]]) -> str:
    parts = []
    for name in ordered_types(infos):
        lengths = [info["exec_start_index"] for info in infos if info["memory_type"] == name]
        if any(lengths):
            parts.append(f"{np.mean(lengths):.1f} in {name} tasks")
    return f"Of these steps the prompt video takes, on average, {' and '.join(parts)}." if parts else ""


def _buckets(infos: Sequence[dict[str, Any]]) -> str:
    lengths = np.array([info["frames"] for info in infos])
    published = sum(LENGTH_BUCKETS.values())
    rows = []
    for (low, high), theirs in LENGTH_BUCKETS.items():
        ours = int(((lengths >= low) & (lengths < (high or np.inf))).sum())
        span = f"{low:,}+" if high is None else f"{low:,}–{high - 1:,}"
        rows.append(
            [
                span,
                f"{ours:,}",
                f"{100 * ours / len(lengths):.2f} %",
                f"{theirs:,}",
                f"{100 * theirs / published:.2f} %",
            ]
        )
    return _table(["length", "episodes here", "share", "episodes in the paper", "share"], rows)


def _per_task(infos: Sequence[dict[str, Any]], failed: Sequence[StagedEpisode]) -> str:
    rows = []
    for name in sorted({info["task_name"] for info in infos} | {e.info["task_name"] for e in failed}):
        chosen = [info for info in infos if info["task_name"] == name]
        seeds = [str(e.info["seed"]) for e in failed if e.info["task_name"] == name]
        mean = f"{np.mean([info['frames'] for info in chosen]):.1f}" if chosen else ""
        operations = chosen[0]["operations"] if chosen else ""
        rows.append([name, operations, f"{len(chosen)}/{len(chosen) + len(seeds)}", mean, ", ".join(seeds)])
    return _table(["task", "operations", "solved", "mean frames", "failing seeds"], rows)


def _type(feature: dict[str, Any]) -> str:
    shape = tuple(feature["shape"])
    return feature["dtype"] if shape == (1,) else f"{feature['dtype']} {'×'.join(map(str, shape))}"


def _table(header: list[str], rows: list[list[str]]) -> str:
    lines = [header, ["---"] * len(header), *rows]
    return "\n".join("| " + " | ".join(cells) + " |" for cells in lines)
