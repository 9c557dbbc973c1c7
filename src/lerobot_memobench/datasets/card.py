"""Describe and publish a dataset: its card (README.md), a summary small enough to commit, and the upload."""

from __future__ import annotations

import contextlib
import json
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from huggingface_hub import DatasetCard, DatasetCardData

from lerobot_memobench.datasets.episodes import (
    STRANGER,
    DemonstrationRecord,
    EpisodePlace,
    check_whole,
    list_episodes,
    naming_damage,
    read_info,
    read_manifest,
    undamaged,
)
from lerobot_memobench.datasets.layout import MANIFEST_FILE, MEANINGS, is_dataset
from lerobot_memobench.datasets.stage import StagedEpisode
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.io import explaining_disk_errors, files_below, write_file
from lerobot_memobench.sim.convention import convention_of
from lerobot_memobench.sim.scene_hash import LIBERO, WORLD
from lerobot_memobench.tasks.catalogue import get_task, suite_of

CARD_FILE = "README.md"
MADE_BY = "## How it was made"
"""Heading in cards of this package, which LeRobot's cards do not have."""
EDITED = (
    "Another tool, such as `lerobot-edit-dataset`, has edited this dataset: its card, tables and hashes are computed "
    "from its frames. The list of failed seeds and the simulator's states were lost. `memobench validate` computes the "
    "states again from seed and actions and compares their hash, except for episodes without a seed."
)
SCRIPTED = (
    "Scripted experts act in a MuJoCo simulation; no data of people or robots was collected. Actions were recorded as "
    "applied (`executed_action`), so that replaying them from the seed gives the same states."
)
_STATISTICS = ("tasks", "episodes", "steps", "mean", "median", "p95", "max", "gib")
FAMILIES: dict[str, dict[str, Any]] = {
    "temporal": dict(zip(_STATISTICS, (10, 500, 198_099, 396.2, 400.5, 679.05, 779, 72.66), strict=True)),
    "spatial": dict(zip(_STATISTICS, (10, 500, 357_865, 715.73, 727, 1101.1, 1513, 131.58), strict=True)),
    "object": dict(zip(_STATISTICS, (5, 250, 121_276, 485.1, 492, 526, 556, 44.53), strict=True)),
    "procedural": dict(zip(_STATISTICS, (5, 250, 250_204, 1000.82, 876, 1649.5, 2012, 91.79), strict=True)),
    "total": dict(zip(_STATISTICS, (30, 1500, 927_444, 618.3, 489, 1110.1, 2012, 340.56), strict=True)),
}
"""Rows of the paper's appendix, "Family level statistics"; ``gib``: size of its HDF5 files."""
LENGTH_BUCKETS: dict[tuple[int, int | None], int] = {
    **{(0, 200): 50, (200, 400): 199, (400, 600): 687, (600, 800): 108},
    **{(800, 1000): 290, (1000, 1200): 110, (1200, 1500): 31, (1500, None): 25},
}
"""Steps [from, to) -> episodes of the paper's 1,500."""


def write_card(
    folder: Path,
    episodes: Sequence[StagedEpisode],
    features: dict[str, dict[str, Any]],
    *,
    repo_id: str,
    made_by: str,
    left_out: Sequence[str] = (),
) -> None:
    """Write ``folder``/README.md: introduction, making, statistics, columns, limitations, licence."""
    solved = [episode for episode in episodes if episode.failure is None]
    failed = [episode for episode in episodes if episode.failure is not None]
    made = [
        (made_by or f"Written by `lerobot_memobench`. {SCRIPTED}") + " `manifest.json` holds a hash of every episode's "
        "states, actions and labels; `states/` holds the simulator's states (1 + nq + nv numbers per frame).",
        _failures(failed, len(episodes)),
    ]
    if left_out:
        made.append(f"**Left out ({len(left_out)}):**\n\n" + "\n".join(f"- {problem}" for problem in left_out))
    infos = [episode.info for episode in solved]
    text = _card(infos, failed, features, _size(folder), made, f'"{repo_id}", root="<this folder>"')
    (folder / CARD_FILE).write_text(text, encoding="utf-8")


def own_card(folder: Path, count: int) -> str | None:
    """Return the card of a dataset of ``count`` episodes; None if another program wrote it, or for other episodes."""
    try:
        card = (folder / CARD_FILE).read_text(encoding="utf-8")
    except FileNotFoundError:
        return None
    return card if MADE_BY in card and f"\n{count} demonstrations of " in card else None


def card_from_frames(folder: Path, rows: Sequence[Mapping[str, Any]], repo_id: str | None = None) -> str:
    """Return a card for a dataset that has lost its own.

    Args:
        folder: the dataset.
        rows: records of its episodes, each with its ``length`` (`records_of`).
        repo_id: its address on the hub; None if it is loaded from a folder.
    """
    infos = [{**row, "frames": row["length"]} for row in rows]
    location = f'"{repo_id}"' if repo_id else '"local/demonstrations", root="<this folder>"'
    return _card(infos, [], read_info(folder)["features"], _size(folder), [EDITED], location)


def hub_card(folder: Path, repo_id: str) -> str:
    """Return the card of a dataset for ``repo_id`` on the hub; its examples load the dataset from there.

    Raises:
        MemobenchError: the dataset is damaged, or none of its episodes is one of this benchmark.
    """
    with undamaged(folder):
        places = list_episodes(folder)
        card = own_card(folder, len(places))
    if card is not None:
        return re.sub(r'LeRobotDataset\("[^"\n]*", root="[^"\n]*"\)', f'LeRobotDataset("{repo_id}")', card)
    return card_from_frames(folder, records_of(folder, places), repo_id)


def records_of(folder: Path, places: Iterable[EpisodePlace]) -> list[dict[str, Any]]:
    """Return the records of episodes, each with its ``length``, without episodes of other programs.

    Raises:
        MemobenchError: no episode has a record.
    """
    rows = [{**place.record.model_dump(), "length": place.length} for place in places if place.record is not None]
    if not rows:
        raise MemobenchError(f"{folder} has no episode of this benchmark: {STRANGER}")
    return rows


def _card(
    infos: Sequence[dict[str, Any]],
    failed: Sequence[StagedEpisode],
    features: Mapping[str, dict[str, Any]],
    size: int,
    made: Sequence[str],
    location: str,
) -> str:
    """Return the card.

    Args:
        infos: information on the episodes, with their ``frames``.
        failed: seeds without a demonstration.
        features: columns of the dataset.
        size: bytes of the dataset.
        made: paragraphs on its making.
        location: arguments of ``LeRobotDataset`` that load it.
    """
    licence, is_libero, of_authors = terms(infos)
    data = DatasetCardData(
        license=licence,
        task_categories=["robotics"],
        tags=["LeRobot", "memobench", "memory", "manipulation", "simulation", "mujoco"],
        language=["en"],
        size_categories=["n<1K" if len(infos) < 1000 else "1K<n<10K"],
        configs=[{"config_name": "default", "data_files": "data/*/*.parquet"}],
    )
    total = _figures(infos)
    shown = [[f"`{key}`", _type(ft), MEANINGS[key]] for key, ft in features.items() if key in MEANINGS]
    described = DemonstrationRecord.meanings().items()
    card = DatasetCard.from_template(
        data,
        str(Path(__file__).with_name("card.md.jinja")),
        total=total,
        types=ordered_types(infos),
        former=any(info.get(WORLD) != LIBERO for info in infos),
        stand_ins=sorted({name for info in infos for name in info.get("stand_ins") or ()}),
        location=location,
        made=[paragraph for paragraph in made if paragraph],
        lengths=_lengths_table(infos),
        bytes_per_frame=f"{size / total['steps']:,.0f}",
        prompts=_prompts(infos),
        buckets=_buckets_table(infos),
        tasks=_tasks_table(infos, failed),
        convention=convention_of(features),
        columns=markdown(["column", "type", "meaning"], shown),
        episode_columns=markdown(["column", "meaning"], [[f"`{key}`", text] for key, text in described]),
        is_libero=is_libero,
        of_authors=of_authors,
    )
    return str(card).rstrip() + "\n"


def _type(feature: dict[str, Any]) -> str:
    shape = tuple(feature["shape"])
    return feature["dtype"] if shape == (1,) else f"{feature['dtype']} {'×'.join(map(str, shape))}"


def _failures(failed: Sequence[StagedEpisode], asked: int) -> str:
    if not failed:
        return f"All {asked} requested seeds were solved."
    lines = [f"- {e.info['task_name']}, seed {e.info['seed']}: {e.failure}" for e in failed]
    return f"**{len(failed)} of {asked} requested seeds have no demonstration:**\n\n" + "\n".join(lines)


# --- the licence ---


def terms(infos: Iterable[Mapping[str, Any]]) -> tuple[str, bool, list[str]]:
    """Return a dataset's licence, as the hub names it, and its reasons.

    Args:
        infos: information on its episodes (`staging.episode_info`).

    Returns:
        The licence, whether scenes are LIBERO's, and the parts that are of MEMOBench's authors.
    """
    infos = list(infos)
    there = [info for info in infos if info.get(WORLD) == LIBERO]
    theirs = {
        "The demonstrations": any(info["seed"] < 0 for info in infos),  # converted: `memobench generate` knows the seed
        "The scanned objects": any(map(_shows_scans, there)),
    }
    parts = [part for part, shown in theirs.items() if shown]
    return "cc-by-nc-4.0" if parts else "other" if there else "apache-2.0", bool(there), parts


def _shows_scans(info: Mapping[str, Any]) -> bool:
    """Return whether an episode's scene has a scan: each object of a spatial task is one or a stand-in."""
    name = info["task_name"]
    if info["memory_type"] != "spatial" or suite_of(name) is None:
        return False
    return not set(get_task(name).objects.values()) <= set(info.get("stand_ins") or ())


# --- statistics, and the paper's ---


def _prompts(infos: Sequence[dict[str, Any]]) -> list[str]:
    """Return the mean length of prompts for each memory type that has some."""
    parts = []
    for name in ordered_types(infos):
        lengths = [info["exec_start_index"] for info in infos if info["memory_type"] == name]
        if any(lengths):
            parts.append(f"{np.mean(lengths):.1f} in {name} tasks")
    return parts


def _size(folder: Path) -> int:
    """Return the bytes of a dataset, without its card and manifest."""
    kept = [folder / part for part in ("data", "meta", "states", "videos")]
    return sum(path.stat().st_size for part in kept for path in files_below(part))


def ordered_types(infos: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return the distinct memory types of episodes: the paper's in its order, then others."""
    there = {info["memory_type"] for info in infos}
    return [name for name in FAMILIES if name in there] + sorted(there - set(FAMILIES))


def _lengths_table(infos: Sequence[dict[str, Any]]) -> str:
    """Return episodes and steps per memory type, and the paper's."""
    rows = []
    for name in [*ordered_types(infos), "total"]:
        rows.append([name, "here", *_lengths(_figures([i for i in infos if name in (i["memory_type"], "total")]))])
        if name in FAMILIES:
            rows.append(["", "paper", *_lengths(FAMILIES[name])])
    return markdown(["memory type", "", "tasks", "episodes", "steps", "mean", "median", "P95", "max"], rows)


def _figures(infos: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Return the statistics of episodes, with the keys of `FAMILIES`."""
    lengths = np.array([info["frames"] for info in infos])
    return {
        "tasks": len({info["task_name"] for info in infos}),
        "episodes": len(infos),
        "steps": lengths.sum(),
        "mean": lengths.mean(),
        "median": np.median(lengths),
        "p95": np.percentile(lengths, 95),
        "max": lengths.max(),
    }


def _lengths(row: Mapping[str, Any]) -> list[str]:
    whole, parts = ("tasks", "episodes", "steps"), ("mean", "median", "p95")
    return [*(f"{row[key]:,}" for key in whole), *(f"{row[key]:,.2f}" for key in parts), f"{row['max']:,}"]


def _buckets_table(infos: Sequence[dict[str, Any]]) -> str:
    lengths = np.array([info["frames"] for info in infos])
    published = sum(LENGTH_BUCKETS.values())
    rows = []
    for (low, high), theirs in LENGTH_BUCKETS.items():
        ours = int(((lengths >= low) & (lengths < (high or np.inf))).sum())
        span = f"{low:,}+" if high is None else f"{low:,}–{high - 1:,}"
        shares = [f"{100 * ours / len(lengths):.2f} %", f"{100 * theirs / published:.2f} %"]
        rows.append([span, f"{ours:,}", shares[0], f"{theirs:,}", shares[1]])
    return markdown(["length", "episodes here", "share", "episodes in the paper", "share"], rows)


def _tasks_table(infos: Sequence[dict[str, Any]], failed: Sequence[StagedEpisode]) -> str:
    rows = []
    for name in sorted({info["task_name"] for info in infos} | {e.info["task_name"] for e in failed}):
        chosen = [info for info in infos if info["task_name"] == name]
        seeds = [str(e.info["seed"]) for e in failed if e.info["task_name"] == name]
        mean = f"{np.mean([info['frames'] for info in chosen]):.1f}" if chosen else ""
        operations = chosen[0]["operations"] if chosen else ""
        rows.append([name, operations, f"{len(chosen)}/{len(chosen) + len(seeds)}", mean, ", ".join(seeds)])
    return markdown(["task", "operations", "solved", "mean frames", "failing seeds"], rows)


def markdown(header: list[str], rows: list[list[str]]) -> str:
    """Return a table in Markdown."""
    lines = [header, ["---"] * len(header), *rows]
    return "\n".join("| " + " | ".join(cells) + " |" for cells in lines)


TABLES_FILE = "tables.md"
UNCHECKED = (
    "not checked: values of tables, frames of videos, statistics, states, hashes, HDF5 files and feature caches; "
    "`memobench validate {folder}` checks them"
)
UPLOADED = (MANIFEST_FILE, "data/**", "meta/**", "states/**", "videos/**")
"""Uploaded files besides the card; others, such as feature caches, are not uploaded."""
REPLACED = (*UPLOADED, "hdf5/**", "feature_cache/**")
"""Files of an earlier dataset on the hub that an upload deletes, because LeRobot would load its frames too."""

Notify = Callable[[str], None]


# --- describe ---


def describe(folder: Path, out: Path, notify: Notify = lambda _: None) -> list[Path]:
    """Write the card's tables and the hash of each episode of the dataset in ``folder`` to ``out``; return the files.

    Episodes of other programs are left out. ``notify`` is called with messages about them, and about parts that other
    tools have removed from the dataset.

    Raises:
        MemobenchError: the folder is no dataset, one of its files is truncated (see `check_whole`), or none of its
            episodes is one of this benchmark.
    """
    with undamaged(folder):
        places = list_episodes(folder)
    rows = records_of(folder, places)
    strangers = [str(place.index) for place in places if place.record is None]
    if strangers:
        listed = ", ".join(strangers[:5]) + (", …" if len(strangers) > 5 else "")
        notify(f"{len(strangers)} of {len(places)} episodes ({listed}) are left out: {STRANGER}")
    check_whole(folder)
    with undamaged(folder), naming_damage(folder):
        card = own_card(folder, read_info(folder)["total_episodes"])
        tables = card_tables(card or card_from_frames(folder, rows))
        manifest = read_manifest(folder) if (folder / MANIFEST_FILE).is_file() else _manifest_of(rows)
    notify(UNCHECKED.format(folder=folder))
    if card is None:
        notify(EDITED)
        _put_card(folder, rows, notify)
    with explaining_disk_errors(out):
        out.mkdir(parents=True, exist_ok=True)
        return [
            write_file(out / TABLES_FILE, tables),
            write_file(out / MANIFEST_FILE, short_manifest(manifest)),
        ]


def _put_card(folder: Path, rows: Sequence[Mapping[str, Any]], notify: Notify) -> None:
    """Write a card for a dataset without one, if the folder is writable."""
    if (folder / CARD_FILE).exists():
        return
    try:
        write_file(folder / CARD_FILE, card_from_frames(folder, rows))
    except OSError as error:
        notify(f"its card could not be written to {folder} ({error.strerror})")


def _manifest_of(rows: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Return a manifest of existing episodes."""
    versions = sorted({json.dumps(row["versions"], sort_keys=True) for row in rows if row["versions"]})
    return {
        "versions": [json.loads(each) for each in versions],
        "episodes": [{**row, "failure": None} for row in rows],
    }


def card_tables(card: str) -> str:
    """Return the sections of a dataset card from its making to its statistics."""
    begin, end = card.find(MADE_BY), card.find("## Columns")
    if begin < 0:
        raise MemobenchError("the dataset's README.md has no section 'How it was made': another program wrote it")
    return card[begin : end if end > begin else None].rstrip() + "\n"


def short_manifest(manifest: Mapping[str, Any]) -> str:
    """Return a manifest as JSON with one line per task: seed to the episode's hash, or to the reason of its failure."""
    tasks: dict[str, dict[str, str]] = {}
    for row in manifest["episodes"]:
        tasks.setdefault(row["task_name"], {})[str(row["seed"])] = (
            row["failure"] or row.get("digest") or "no hash was stored"
        )
    head = {key: value for key, value in manifest.items() if key != "episodes"}
    lines = [f"{json.dumps(name)}: {json.dumps(seeds)}" for name, seeds in sorted(tasks.items())]
    return json.dumps(head | {"tasks": None})[: -len("null}")] + "{\n" + ",\n".join(lines) + "\n}}\n"


# --- push ---


def push(
    folder: Path | str,
    repo_id: str,
    *,
    token: str | None = None,
    private: bool | None = None,
    notify: Notify = lambda _: None,
) -> str:
    """Upload a finished dataset, so that ``LeRobotDataset("<user>/memobench")`` loads it; return its address.

    The repository then holds this dataset and no file of an earlier one, which remains in its history. The card shows
    how to load it from the hub. The same call continues an interrupted upload: huggingface_hub skips files whose hash
    the hub has already.

    Args:
        folder: the dataset.
        repo_id: ``user/name`` on the hub; created if necessary.
        token: token with write access; by default the one of ``hf auth login`` or HF_TOKEN.
        private: whether a created repository is private; None uses the account's setting.
        notify: called with a message about files that are not uploaded.

    Raises:
        MemobenchError: no dataset, no token, a token without write access, or a hub that cannot be reached.
    """
    from huggingface_hub import HfApi, get_token

    folder = Path(folder)
    if not is_dataset(folder):
        raise MemobenchError(f"{folder} is no finished dataset (there is no meta/info.json); name a generated one")
    if repo_id.count("/") != 1:
        raise MemobenchError(f"found repository {repo_id!r}, expected user/name, such as memobench/memobench")
    token = token or get_token()
    if not token:
        raise MemobenchError(
            f"there is no token to write to {repo_id}: run `hf auth login`, set HF_TOKEN, or pass a token"
        )
    card = hub_card(folder, repo_id)
    if (folder / "feature_cache").is_dir():
        notify(f"the feature caches in {folder} are not uploaded; training makes them again elsewhere")
    api = HfApi(token=token)
    with _hub_errors(repo_id):
        repo_id = api.create_repo(repo_id, repo_type="dataset", private=private, exist_ok=True).repo_id
        where: dict[str, Any] = {"repo_id": repo_id, "repo_type": "dataset"}
        api.upload_folder(
            folder_path=folder,
            allow_patterns=list(UPLOADED),
            delete_patterns=list(REPLACED),
            commit_message="Upload MEMOBench demonstrations",
            **where,
        )
        api.upload_file(
            path_or_fileobj=card.encode(), path_in_repo=CARD_FILE, commit_message="Upload the card", **where
        )
        version = read_info(folder)["codebase_version"]  # LeRobot loads no dataset without a tag of its format
        if version in [tag.name for tag in api.list_repo_refs(**where).tags]:
            api.delete_tag(tag=version, **where)
        api.create_tag(tag=version, **where)
    return f"{api.endpoint}/datasets/{repo_id}"


@contextlib.contextmanager
def _hub_errors(repo_id: str) -> Iterator[None]:
    """Turn an error of the hub or the connection into a `MemobenchError` with a fix."""
    import httpx
    from huggingface_hub.errors import HfHubHTTPError, HFValidationError

    try:
        yield
    except HFValidationError as error:
        raise MemobenchError(f"the hub does not allow the repository name {repo_id!r}: {_line(error)}") from None
    except HfHubHTTPError as error:
        status = error.response.status_code if error.response is not None else None
        if status in (401, 403):
            raise MemobenchError(
                f"the hub refused to write to {repo_id} ({status}): the token is not valid or has no write access; "
                "pass another token or name your own repository"
            ) from None
        raise MemobenchError(f"the hub answered {_line(error)[:300]}; repeat the command to continue") from None
    except (httpx.TransportError, OSError) as error:
        raise MemobenchError(
            f"the hub could not be reached ({type(error).__name__}: {_line(error)[:200]}); repeat the command to "
            "continue"
        ) from None


def _line(error: BaseException) -> str:
    return " ".join(str(error).split())
