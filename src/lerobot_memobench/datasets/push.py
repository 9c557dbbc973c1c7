"""Push a dataset to the Hugging Face hub, so that ``LeRobotDataset("<user>/memobench")`` loads it anywhere.

huggingface_hub's ``upload_folder`` does the work: it skips files whose hash the hub has already, so the same call
continues an upload that was broken off, and it deletes the files of an earlier dataset.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from lerobot_memobench.datasets.lerobot_format.card import CARD_FILE, hub_card
from lerobot_memobench.datasets.lerobot_format.layout import MANIFEST_FILE, is_dataset, read_info
from lerobot_memobench.errors import MemobenchError

PARTS = (MANIFEST_FILE, "data/**", "meta/**", "states/**", "videos/**")
"""Files that are uploaded besides the card; others in the folder, such as feature caches, stay here."""
REPLACED = (*PARTS, "hdf5/**", "feature_cache/**")
"""Files of an earlier dataset on the hub, which an upload deletes: LeRobot would load its frames too."""


def push(
    folder: Path | str,
    repo_id: str,
    *,
    token: str | None = None,
    private: bool | None = None,
    tell: Callable[[str], None] = lambda _: None,
) -> str:
    """Upload a finished dataset; return its address. The same call continues an upload that was broken off.

    The repository then holds this dataset and no file of an earlier one (its history keeps them). The card shows how to
    load it from there.

    Args:
        folder: the dataset.
        repo_id: ``user/name`` on the hub; made if it is not there.
        token: a token that may write; by default the one of ``hf auth login`` or HF_TOKEN.
        private: whether a repository that has to be made is private; None leaves it to the account's setting.
        tell: called with a sentence on what stays here.

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
    if (folder / "feature_cache").is_dir():
        tell(f"the feature caches in {folder} stay here; training makes them again elsewhere")
    api = HfApi(token=token)
    with _in_sentences(repo_id):
        repo_id = api.create_repo(repo_id, repo_type="dataset", private=private, exist_ok=True).repo_id
        where: dict[str, Any] = {"repo_id": repo_id, "repo_type": "dataset"}
        api.upload_folder(
            folder_path=folder,
            allow_patterns=list(PARTS),
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
def _in_sentences(repo_id: str) -> Iterator[None]:
    """Turn an error of the hub, or of the connection, into a sentence with a way out."""
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


def _line(error: BaseException) -> str:
    return " ".join(str(error).split())
