"""Push a dataset to the Hugging Face hub, so that ``LeRobotDataset("<user>/memobench")`` loads it anywhere.

huggingface_hub's ``upload_folder`` does the work (its ``upload_large_folder`` is deprecated in favour of it): it
commits a large folder in parts, and the same call continues an upload that was broken off, since what the hub has
already is known by its hash. What an earlier dataset has left there is deleted by the same upload: LeRobot would load
its frames too. When it is over the hub is asked what it holds.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from fnmatch import fnmatch
from pathlib import Path
from typing import TYPE_CHECKING

from lerobot_memobench.datasets.lerobot_format.card import CARD_FILE, hub_card
from lerobot_memobench.datasets.lerobot_format.layout import HDF5_FOLDER, MANIFEST_FILE, is_dataset, read_info
from lerobot_memobench.errors import MemobenchError

if TYPE_CHECKING:
    from huggingface_hub import HfApi

PARTS = (MANIFEST_FILE, "data/**", "meta/**", "states/**", "videos/**")
"""What is uploaded beside the card: the dataset, and nothing that was later put beside it, such as a feature cache."""
HDF5 = f"{HDF5_FOLDER}/**"
DERIVED = "feature_cache/**"
"""Made from a dataset's frames on the machine that trains; one on the hub is of frames that are replaced."""


def push(
    folder: Path | str,
    repo_id: str,
    *,
    token: str | None = None,
    private: bool | None = None,
    hdf5: bool = False,
    tell: Callable[[str], None] = lambda _: None,
) -> str:
    """Upload a finished dataset; return its address. The same call continues an upload that was broken off.

    The repository then holds this dataset and no file of an earlier one: what it had in the dataset's folders, HDF5
    files and feature caches, and what is not uploaded now, is deleted (its history keeps it). The card says how to load
    it from there.

    Args:
        folder: the dataset.
        repo_id: ``user/name`` on the hub; made if it is not there.
        token: a token that may write; by default the one of ``hf auth login`` or HF_TOKEN.
        private: whether a repository that has to be made is private; None leaves it to the account's setting.
        hdf5: upload the HDF5 files beside the dataset as well.
        tell: told, in a sentence, what is deleted there and what stays here.

    Raises:
        MemobenchError: no dataset, no token, a token that may not write there, or a hub that cannot be reached.
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
            f"there is no token to write to {repo_id}: run `hf auth login`, set HF_TOKEN, or pass one that may write"
        )
    card = hub_card(folder, repo_id)
    parts = [*PARTS, *([HDF5] if hdf5 else [])]
    if (folder / DERIVED.removesuffix("/**")).is_dir():
        tell(f"the feature caches in {folder} stay here: they are made anew where the dataset is trained on")
    api = HfApi(token=token)
    with _told(repo_id):
        repo_id = api.create_repo(repo_id, repo_type="dataset", private=private, exist_ok=True).repo_id
        others = _on_the_hub(api, repo_id).keys() - _sizes(folder, parts).keys()
        stale = sorted(name for name in others if any(fnmatch(name, part) for part in (*PARTS, HDF5, DERIVED)))
        if stale:
            tell(
                f"{len(stale)} files that this dataset does not have, such as {stale[0]}, are deleted from {repo_id}; "
                "its history keeps them"
            )
        api.upload_folder(
            repo_id=repo_id,
            folder_path=folder,
            repo_type="dataset",
            allow_patterns=parts,
            delete_patterns=stale or None,
            commit_message="Upload MEMOBench demonstrations",
        )
        api.upload_file(
            repo_id=repo_id,
            path_or_fileobj=card.encode(),
            path_in_repo=CARD_FILE,
            repo_type="dataset",
            commit_message="Upload the card",
        )
        there, sizes = _on_the_hub(api, repo_id), _sizes(folder, parts) | {CARD_FILE: len(card.encode())}
        missing = sorted(name for name, size in sizes.items() if there.get(name) != size)
        if missing:
            raise MemobenchError(
                f"{len(missing)} files, such as {missing[0]}, did not arrive at {repo_id}; run the same command again"
            )
        _tag(api, folder, repo_id)
    return f"{api.endpoint}/datasets/{repo_id}"


@contextlib.contextmanager
def _told(repo_id: str) -> Iterator[None]:
    """Turn what the hub or the way to it objects into a sentence with a way out."""
    import httpx
    from huggingface_hub.errors import HfHubHTTPError, HFValidationError

    try:
        yield
    except HFValidationError as error:
        raise MemobenchError(f"found repository {repo_id!r}, which the hub does not allow: {_line(error)}") from None
    except HfHubHTTPError as error:
        status = error.response.status_code if error.response is not None else None
        if status in (401, 403):
            raise MemobenchError(
                f"the hub refused to write to {repo_id} ({status}): the token is not valid or may not write there; "
                "pass another one or name a repository of yours"
            ) from None
        raise MemobenchError(f"the hub answered {_line(error)[:300]}; run the same command again to go on") from None
    except (httpx.TransportError, OSError) as error:
        raise MemobenchError(
            f"the hub could not be reached ({type(error).__name__}: {_line(error)[:200]}); run the same command "
            "again to go on"
        ) from None


def _sizes(folder: Path, parts: list[str]) -> dict[str, int]:
    """Return the files that are uploaded and their sizes."""
    tops = [folder / pattern.removesuffix("/**") for pattern in parts]
    files = [path for top in tops for path in [top, *top.rglob("*")] if path.is_file()]
    return {path.relative_to(folder).as_posix(): path.stat().st_size for path in files}


def _on_the_hub(api: HfApi, repo_id: str) -> dict[str, int]:
    """Return the files that the hub holds and their sizes."""
    entries = api.list_repo_tree(repo_id, repo_type="dataset", recursive=True)
    return {entry.path: entry.size for entry in entries if hasattr(entry, "size")}


def _tag(api: HfApi, folder: Path, repo_id: str) -> None:
    """Mark the commit with the version of LeRobot's format: LeRobot loads no dataset without it."""
    version = read_info(folder)["codebase_version"]
    if version in [tag.name for tag in api.list_repo_refs(repo_id, repo_type="dataset").tags]:
        api.delete_tag(repo_id, tag=version, repo_type="dataset")
    api.create_tag(repo_id, tag=version, repo_type="dataset")


def _line(error: BaseException) -> str:
    return " ".join(str(error).split())
