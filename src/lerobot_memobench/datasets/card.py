"""Describe and publish a dataset: its card (README.md), a summary small enough to commit, and the upload."""

from __future__ import annotations

import contextlib
import json
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from huggingface_hub import DatasetCard, DatasetCardData

from lerobot_memobench.datasets.episodes import (
    STRANGER,
    DemonstrationRecord,
    ListedEpisode,
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
from lerobot_memobench.tasks.catalogue import get_task, suite_of

CARD_FILE, TABLES_FILE = "README.md", "tables.md"
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
FAMILIES = {
    "temporal": (10, 500, 198_099, 396.2, 400.5, 679.05, 779),
    "spatial": (10, 500, 357_865, 715.73, 727, 1101.1, 1513),
    "object": (5, 250, 121_276, 485.1, 492, 526, 556),
    "procedural": (5, 250, 250_204, 1000.82, 876, 1649.5, 2012),
    "total": (30, 1500, 927_444, 618.3, 489, 1110.1, 2012),
}
"""Rows of the paper's appendix, "Family level statistics": tasks, episodes, steps, mean, median, P95 and maximum."""
LENGTH_BUCKETS = {0: 50, 200: 199, 400: 687, 600: 108, 800: 290, 1000: 110, 1200: 31, 1500: 25}
"""Least steps -> episodes of the paper's 1,500."""

Described = tuple[DemonstrationRecord, int]  # record and length of an episode of this benchmark
Notify = Callable[[str], None]


# --- the card ---


def write_card(
    folder: Path,
    described: Sequence[Described],
    failed: Sequence[StagedEpisode],
    features: dict[str, dict[str, Any]],
    *,
    repo_id: str,
    made_by: str,
    left_out: Sequence[str] = (),
) -> None:
    """Write ``folder``/README.md: introduction, making, statistics, columns, limitations, licence."""
    requested = len(described) + len(failed)
    paragraphs = [
        (made_by or f"Written by `lerobot_memobench`. {SCRIPTED}") + " `manifest.json` holds a hash of every episode's "
        "states, actions and labels; `states/` holds the simulator's states (1 + nq + nv numbers per frame)."
    ]
    if failed:
        seeds = (f"- {episode.info['task_name']}, seed {episode.info['seed']}: {episode.failure}" for episode in failed)
        heading = f"**{len(failed)} of {requested} requested seeds have no demonstration:**"
        paragraphs.append(heading + "\n\n" + "\n".join(seeds))
    else:
        paragraphs.append(f"All {requested} requested seeds were solved.")
    if left_out:
        paragraphs.append(f"**Left out ({len(left_out)}):**\n\n" + "\n".join(f"- {note}" for note in left_out))
    text = _card(folder, described, failed, features, paragraphs, f'"{repo_id}", root="<this folder>"')
    (folder / CARD_FILE).write_text(text, encoding="utf-8")


def own_card(folder: Path, count: int) -> str | None:
    """Return the card of a dataset of ``count`` episodes; None if another program wrote it, or for other episodes."""
    try:
        card = (folder / CARD_FILE).read_text(encoding="utf-8")
    except FileNotFoundError:
        return None
    return card if MADE_BY in card and f"\n{count} demonstrations of " in card else None


def card_from_frames(folder: Path, episodes: Sequence[Described], repo_id: str | None = None) -> str:
    """Return a card for a dataset that has lost its own; ``repo_id`` is its address on the hub, None of a folder."""
    location = f'"{repo_id}"' if repo_id else '"local/demonstrations", root="<this folder>"'
    return _card(folder, episodes, [], read_info(folder)["features"], [EDITED], location)


def described_of(folder: Path, episodes: Iterable[ListedEpisode]) -> list[Described]:
    """Return records and lengths of a dataset's episodes, without episodes of other programs."""
    described = [(episode.record, episode.length) for episode in episodes if episode.record is not None]
    if not described:
        raise MemobenchError(f"{folder} has no episode of this benchmark: {STRANGER}")
    return described


def _card(
    folder: Path,
    episodes: Sequence[Described],
    failed: Sequence[StagedEpisode],
    features: Mapping[str, dict[str, Any]],
    paragraphs: Sequence[str],
    location: str,
) -> str:
    # ``paragraphs`` are on the making, ``location`` the arguments of ``LeRobotDataset``.
    records = [record for record, _ in episodes]
    fields = ("task_name", "memory_type", "operations", "exec_start_index")
    table = pd.DataFrame([record.model_dump(include={*fields}) | {"frames": length} for record, length in episodes])
    types = [name for name in FAMILIES if name in {*table.memory_type}]
    types += sorted({*table.memory_type} - {*FAMILIES})
    # MEMOBench's authors made converted demonstrations (`generate` knows the seed) and scans; they decide the licence.
    parts = {
        "The demonstrations": any(record.seed < 0 for record in records),
        "The scanned objects": any(map(_shows_scans, records)),
    }
    of_authors = [part for part, shown in parts.items() if shown]
    data = DatasetCardData(
        license="cc-by-nc-4.0" if of_authors else "other",
        task_categories=["robotics"],
        tags=["LeRobot", "memobench", "memory", "manipulation", "simulation", "mujoco"],
        language=["en"],
        size_categories=["n<1K" if len(records) < 1000 else "1K<n<10K"],
        configs=[{"config_name": "default", "data_files": "data/*/*.parquet"}],
    )
    prompts = table.groupby("memory_type").exec_start_index.mean()
    content = [folder / part for part in ("data", "meta", "states", "videos")]
    size = sum(path.stat().st_size for part in content for path in files_below(part))
    columns = [[f"`{key}`", _type(feature), MEANINGS[key]] for key, feature in features.items() if key in MEANINGS]
    meanings = DemonstrationRecord.meanings().items()
    card = DatasetCard.from_template(
        data,
        str(Path(__file__).with_name("card.md.jinja")),
        total={"episodes": len(table), "tasks": table.task_name.nunique()},
        types=types,
        stand_ins=sorted({name for record in records for name in record.stand_ins}),
        location=location,
        made=paragraphs,
        lengths=_lengths_table(table, types),
        bytes_per_frame=f"{size / table.frames.sum():,.0f}",
        prompts=[f"{prompts[name]:.1f} in {name} tasks" for name in types if prompts[name]],
        buckets=_buckets_table(table.frames),
        tasks=_tasks_table(table, failed),
        convention=convention_of(features),
        columns=markdown(["column", "type", "meaning"], columns),
        episode_columns=markdown(["column", "meaning"], [[f"`{key}`", text] for key, text in meanings]),
        of_authors=of_authors,
    )
    return str(card).rstrip() + "\n"


def _type(feature: dict[str, Any]) -> str:
    shape = tuple(feature["shape"])
    return feature["dtype"] if shape == (1,) else f"{feature['dtype']} {'×'.join(map(str, shape))}"


def _shows_scans(record: DemonstrationRecord) -> bool:
    # Each object of a spatial task is a scan or a stand-in.
    if record.memory_type != "spatial" or suite_of(record.task_name) is None:
        return False
    return not {*get_task(record.task_name).objects.values()} <= {*record.stand_ins}


def _lengths_table(table: pd.DataFrame, types: Sequence[str]) -> str:
    def row(name: str, source: str, values: Sequence[float]) -> list[str]:
        # Mean, median and P95 have decimals.
        return [name, source, *(f"{value:,.2f}" if 3 <= k <= 5 else f"{value:,}" for k, value in enumerate(values))]

    rows = []
    for name in [*types, "total"]:
        part = table if name == "total" else table[table.memory_type == name]
        steps = part.frames
        counts = (part.task_name.nunique(), len(part), steps.sum())
        rows.append(row(name, "here", (*counts, steps.mean(), steps.median(), steps.quantile(0.95), steps.max())))
        if name in FAMILIES:
            rows.append(row("", "paper", FAMILIES[name]))
    return markdown(["memory type", "", "tasks", "episodes", "steps", "mean", "median", "P95", "max"], rows)


def _buckets_table(lengths: pd.Series[int]) -> str:
    edges, rows = [*LENGTH_BUCKETS, np.inf], []
    ours, theirs = np.histogram(lengths, edges)[0], np.array([*LENGTH_BUCKETS.values()])
    for low, high, here, published in zip(edges[:-1], edges[1:], ours, theirs, strict=True):
        span = f"{low:,}+" if high == np.inf else f"{low:,}–{high - 1:,}"
        shares = (100 * here / ours.sum(), 100 * published / theirs.sum())
        rows.append([span, f"{here:,}", f"{shares[0]:.2f} %", f"{published:,}", f"{shares[1]:.2f} %"])
    return markdown(["length", "episodes here", "share", "episodes in the paper", "share"], rows)


def _tasks_table(table: pd.DataFrame, failed: Sequence[StagedEpisode]) -> str:
    rows = []
    for name in sorted({*table.task_name} | {episode.info["task_name"] for episode in failed}):
        part = table[table.task_name == name]
        seeds = [str(episode.info["seed"]) for episode in failed if episode.info["task_name"] == name]
        operations, mean = (part.operations.iloc[0], f"{part.frames.mean():.1f}") if len(part) else ("", "")
        rows.append([name, operations, f"{len(part)}/{len(part) + len(seeds)}", mean, ", ".join(seeds)])
    return markdown(["task", "operations", "solved", "mean frames", "failing seeds"], rows)


def markdown(header: list[str], rows: list[list[str]]) -> str:
    """Return a table in Markdown."""
    lines = [header, ["---"] * len(header), *rows]
    return "\n".join("| " + " | ".join(cells) + " |" for cells in lines)


# --- describe ---


def describe(folder: Path, out: Path, notify: Notify = lambda _: None) -> list[Path]:
    """Write the card's tables and the hash of each episode of the dataset in ``folder`` to ``out``; return the files.

    Episodes of other programs are left out; a dataset without others is refused, and a damaged one (`check_whole`).
    ``notify`` is called with messages about left-out episodes, and about parts that other tools have removed.
    """
    with undamaged(folder):
        episodes = list_episodes(folder)
    described = described_of(folder, episodes)
    strangers = [str(episode.index) for episode in episodes if episode.record is None]
    if strangers:
        numbers = ", ".join(strangers[:5]) + (", …" if len(strangers) > 5 else "")
        notify(f"{len(strangers)} of {len(episodes)} episodes ({numbers}) are left out: {STRANGER}")
    check_whole(folder)
    with undamaged(folder), naming_damage(folder):
        card = own_card(folder, len(episodes))
        text = card or card_from_frames(folder, described)
        manifest = read_manifest(folder) if (folder / MANIFEST_FILE).is_file() else _manifest_of(described)
    notify(
        "not checked: values of tables, frames of videos, statistics, states, hashes, HDF5 files and feature caches; "
        f"`memobench validate {folder}` checks them"
    )
    if card is None:
        notify(EDITED)
        if not (folder / CARD_FILE).exists():
            try:
                write_file(folder / CARD_FILE, text)
            except OSError as error:  # a mounted dataset may be read-only
                notify(f"its card could not be written to {folder} ({error.strerror})")
    tables = MADE_BY + text.partition(MADE_BY)[2].partition("## Columns")[0].rstrip() + "\n"
    with explaining_disk_errors(out):
        out.mkdir(parents=True, exist_ok=True)
        return [write_file(out / TABLES_FILE, tables), write_file(out / MANIFEST_FILE, _short_manifest(manifest))]


def _manifest_of(episodes: Sequence[Described]) -> dict[str, Any]:
    versions = sorted({json.dumps(record.versions, sort_keys=True) for record, _ in episodes if record.versions})
    return {
        "versions": [json.loads(text) for text in versions],
        "episodes": [{**record.model_dump(), "failure": None} for record, _ in episodes],
    }


def _short_manifest(manifest: Mapping[str, Any]) -> str:
    # One line per task: seed to the episode's hash, or to the reason of its failure.
    tasks: dict[str, dict[str, str]] = {}
    for row in manifest["episodes"]:
        tasks.setdefault(row["task_name"], {})[str(row["seed"])] = row["failure"] or row["digest"]
    head = {key: value for key, value in manifest.items() if key != "episodes"}
    lines = [f"{json.dumps(name)}: {json.dumps(seeds)}" for name, seeds in sorted(tasks.items())]
    return json.dumps(head | {"tasks": None})[: -len("null}")] + "{\n" + ",\n".join(lines) + "\n}}\n"


# --- push ---

UPLOADED = (MANIFEST_FILE, "data/**", "meta/**", "states/**", "videos/**")
"""Uploaded files besides the card; others, such as feature caches, are not uploaded."""
REPLACED = (*UPLOADED, "hdf5/**", "feature_cache/**")
"""Files of an earlier dataset on the hub that an upload deletes, because LeRobot would load its frames too."""


def push(
    folder: Path | str,
    repo_id: str,
    *,
    token: str | None = None,
    private: bool | None = None,
    notify: Notify = lambda _: None,
) -> str:
    """Upload a finished dataset, so that ``LeRobotDataset("<user>/memobench")`` loads it; return its address.

    The repository then holds this dataset and no file of an earlier one, which remains in its history. The same call
    continues an interrupted upload: huggingface_hub skips files whose hash the hub has already.

    ``token`` is by default the one of ``hf auth login`` or HF_TOKEN; ``private`` is that of a created repository, by
    default the account's setting. ``notify`` is called with a message about files that are not uploaded.

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
    with undamaged(folder):
        episodes = list_episodes(folder)
        card = own_card(folder, len(episodes))
    if card is None:
        card = card_from_frames(folder, described_of(folder, episodes), repo_id)
    else:  # its examples load the dataset from this disk
        card = re.sub(r'LeRobotDataset\("[^"\n]*", root="[^"\n]*"\)', f'LeRobotDataset("{repo_id}")', card)
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
    import httpx
    from huggingface_hub.errors import HfHubHTTPError, HFValidationError

    try:
        yield
    except (HFValidationError, HfHubHTTPError, httpx.TransportError, OSError) as error:
        line = " ".join(str(error).split())
        status = getattr(getattr(error, "response", None), "status_code", None)
        reason = f"the hub could not be reached ({type(error).__name__}: {line[:200]}); repeat the command to continue"
        if isinstance(error, HFValidationError):
            reason = f"the hub does not allow the repository name {repo_id!r}: {line}"
        elif status in (401, 403):
            reason = (
                f"the hub refused to write to {repo_id} ({status}): the token is not valid or has no write access; "
                "pass another token or name your own repository"
            )
        elif isinstance(error, HfHubHTTPError):
            reason = f"the hub answered {line[:300]}; repeat the command to continue"
        raise MemobenchError(reason) from None
