"""Publish a dataset: summarise it in files small enough to commit, and push it to the Hugging Face hub."""

from __future__ import annotations

import contextlib
import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from lerobot_memobench.datasets.lerobot_format.card import (
    CARD_FILE,
    EDITED,
    MADE_BY,
    card_from_frames,
    hub_card,
    own_card,
    records_of,
)
from lerobot_memobench.datasets.lerobot_format.damage import check_whole, naming_damage
from lerobot_memobench.datasets.lerobot_format.layout import MANIFEST_FILE, is_dataset
from lerobot_memobench.datasets.lerobot_format.manifest import read_manifest
from lerobot_memobench.datasets.lerobot_format.reading import STRANGER, list_episodes
from lerobot_memobench.datasets.lerobot_format.tables import read_info, undamaged
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.io import explaining_disk_errors, write_file

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
