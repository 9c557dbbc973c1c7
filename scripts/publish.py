"""Release this project: wheel, datasets, weights, site, EnvHub page and invitations.

    python scripts/publish.py                            # upload all parts to an index and a hub on this machine
    python scripts/publish.py --only wheel install       # some parts
    python scripts/publish.py --plan                     # print the commands
    python scripts/publish.py --user NAME --upload       # needs TWINE_PASSWORD and HF_TOKEN

All parts are built and checked before the first is uploaded. The dry run gives the commands of an upload the addresses
of two local servers, then installs the wheel by its name in an empty environment and evaluates there. An upload refuses
uncommitted changes, a part that is not at hand, and a version if the index has another wheel of it. The same command
continues an interrupted upload: index and hub skip files whose hash they have. The last lines are the
remaining manual steps. The site becomes a static Space, because no workflow publishes it.
"""

from __future__ import annotations

import argparse
import json
import os
import shlex
import subprocess
import sys
import tempfile
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT))  # `scripts` and `tests` are not installed

from lerobot_memobench.io import file_hash, write_file  # noqa: E402
from lerobot_memobench.policies.checkpoint import checkpoint_files, shipped_policies  # noqa: E402
from scripts.invitations import GUESTS, invitation  # noqa: E402
from tests.support.hub_server import TOKEN, Hub  # noqa: E402
from tests.support.index_server import Index  # noqa: E402

PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
NAME, VERSION = PROJECT["name"], PROJECT["version"]
TOKENS = ("TWINE_PASSWORD", "HF_TOKEN")
PARTS = ("strict", "published", "weights", "site", "envhub", "invitations", "wheel", "install")
"""In the order of the uploads. The wheel is the last one, because it cannot be replaced."""
GENERATE = {"strict": "--suite strict --perturb --episodes 50", "published": "--episodes 50"}
"""Suite -> options of `memobench generate`, as in results/demonstrations.md."""
TRIED = "suite=strict tasks=put_only_the_butter_picked_up_in_the_prompt_video_on_the_plate episodes=1"
SPACE = "---\ntitle: lerobot_memobench\nsdk: static\napp_file: index.html\nlicense: apache-2.0\n---\n"


@dataclass(frozen=True)
class Part:
    """Commands that build and check a part, and that upload it; ``missing``: why it cannot be uploaded."""

    build: tuple[str, ...] = ()
    upload: tuple[str, ...] = ()
    missing: str = ""


def release(user: str, out: Path, datasets: Mapping[str, Path], checkpoints: Sequence[Path]) -> dict[str, Part]:
    """Return the parts of a release; ``checkpoints``: weights of the board's rows, besides the shipped policies."""
    weights, absent = weights_of_rows(checkpoints)
    dist = " ".join(quote(out / f"dist/{NAME}-{VERSION}{end}") for end in ("-py3-none-any.whl", ".tar.gz"))
    site = quote(out / "site")
    return {
        **{suite: dataset(suite, folder, user, out) for suite, folder in datasets.items()},
        "weights": Part(
            (), tuple(f"hf upload {user}/{name} {quote(path)} ." for name, path in weights.items()), absent
        ),
        "site": Part(
            (f"python -m mkdocs build --strict --site-dir {site}",),
            (
                f"hf repos create {user}/memobench-docs --repo-type space --space-sdk static --exist-ok",
                f"hf upload {user}/memobench-docs {site} . --repo-type space --delete '*'",
            ),
        ),
        "envhub": Part((), (f"hf upload {user}/memobench {quote(out / 'envhub')} .",)),
        "wheel": Part(
            (f"python -m hatchling build -d {quote(out / 'dist')}", f"python -m twine check --strict {dist}"),
            (f"python -m twine upload --non-interactive --disable-progress-bar {dist}",),
        ),
    }


def dataset(suite: str, folder: Path, user: str, out: Path) -> Part:
    """Return the part of a suite's demonstrations."""
    if not (folder / "meta/info.json").is_file():
        generate = f"memobench generate {GENERATE[suite]} --no-images --workers 2 --out {quote(folder)}"
        return Part(missing=f"{folder} holds no dataset. In some hours of all cores:\n\n    {generate}\n")
    check = f"memobench describe {quote(folder)} --out {quote(out / 'described' / suite)}"
    return Part((check,), (f"memobench push {quote(folder)} --repo-id {user}/memobench-{suite}",))


def weights_of_rows(checkpoints: Sequence[Path]) -> tuple[dict[str, Path], str]:
    """Return name -> folder of the shipped policies and the board's rows; and the rows whose weights are not given."""
    found, absent = shipped_policies(), []
    for file in sorted((ROOT / "results/board").glob("*/evaluation.json")):
        checkpoint = json.loads(file.read_text())["checkpoint"] or {}
        hashes = checkpoint.get("files")  # a scripted policy has none
        if hashes is None or checkpoint.get("revision"):  # one from the hub has a revision, and is there already
            continue
        if any(checkpoint_files(folder) == hashes for folder in found.values()):
            continue
        if given := [folder for folder in checkpoints if checkpoint_files(folder) == hashes]:
            found[file.parent.name] = given[0]
        else:
            absent.append(file.parent.name)
    return found, f"--weights lacks the checkpoints of the board's rows {', '.join(absent)}" if absent else ""


def quote(path: Path) -> str:
    """Return a path as a word of a command."""
    return shlex.quote(str(path))


def write_folders(out: Path, user: str) -> None:
    """Write the EnvHub page with the user's name, and the invitations."""
    for name in ("envhub", "invitations"):
        (out / name).mkdir(parents=True, exist_ok=True)
    for path in (ROOT / "contrib/lerobot/envhub").iterdir():
        write_file(out / "envhub" / path.name, path.read_text().replace("<user>", user))
    for guest in GUESTS:
        write_file(out / "invitations" / f"{guest.slug}.md", invitation(guest, user, f"{NAME}=={VERSION}"))


def run(command: str, environment: Mapping[str, str], folder: Path = ROOT) -> None:
    """Run a command; end with its failure."""
    print(f"$ {command}", flush=True)
    if subprocess.run(shlex.split(command), env=environment, cwd=folder).returncode:
        raise SystemExit("publish: the last command failed, see above; repeat this one to continue")


def programs(**changes: str) -> dict[str, str]:
    """Return this process's environment, in which the programs of this Python and the project's uv are found."""
    path = os.pathsep.join([str(Path(sys.executable).parent), str(ROOT / ".uv/bin"), os.environ.get("PATH", "")])
    return {**os.environ, "PATH": path, "NO_MKDOCS_2_WARNING": "1", "TWINE_USERNAME": "__token__", **changes}


def refuse(parts: Mapping[str, Part]) -> None:
    """Refuse an upload without a token, with uncommitted changes, or without a part."""
    absent = [name for name in TOKENS if not os.environ.get(name)]
    changed = subprocess.check_output(["git", "status", "--porcelain"], cwd=ROOT, text=True)
    reasons = [f"found no {' and no '.join(absent)} in the environment; set it"] if absent else []
    reasons += [f"found uncommitted changes; commit or remove them:\n{changed}"] if changed else []
    reasons += [f"{name}: {part.missing}" for name, part in parts.items() if part.missing]
    if reasons:
        raise SystemExit("\n".join(["publish: nothing was uploaded", *reasons]))


def refuse_other_wheel(wheel: Path, environment: Mapping[str, str]) -> None:
    """Refuse a version if the index has another wheel of it."""
    with tempfile.TemporaryDirectory() as folder:
        options = f"-q --no-cache-dir --no-deps --only-binary :all: -d {folder}"
        words = shlex.split(f"python -m pip download {options} {NAME}=={VERSION}")
        subprocess.run(words, env=environment, capture_output=True)  # it fails if the index has no such version
        if any(file_hash(path) != file_hash(wheel) for path in Path(folder).glob("*.whl")):
            raise SystemExit(f"publish: the index has another {NAME} {VERSION}; raise `version` in pyproject.toml")


def publish(parts: Mapping[str, Part], out: Path, user: str, environment: Mapping[str, str]) -> None:
    """Build and check all parts, then upload them."""
    write_folders(out, user)
    for command in [command for part in parts.values() for command in part.build]:
        run(command, environment)
    if "site" in parts:
        write_file(out / "site/README.md", SPACE)
    if "wheel" in parts:
        refuse_other_wheel(out / f"dist/{NAME}-{VERSION}-py3-none-any.whl", environment)
    for command in [command for part in parts.values() for command in part.upload]:
        run(command, environment)


def local(hub: Hub, index: Index, folder: Path) -> dict[str, str]:
    """Return an environment in which a hub and an index of this machine stand for the public ones."""
    return programs(
        **{"HF_ENDPOINT": hub.address, "HF_TOKEN": TOKEN, "HF_HOME": str(folder / "hub"), "HF_HUB_OFFLINE": "0"},
        **{"HF_HUB_DISABLE_XET": "1", "HF_HUB_DISABLE_UPDATE_CHECK": "1", "PIP_INDEX_URL": f"{index.address}/simple"},
        **{"TWINE_REPOSITORY_URL": index.address, "TWINE_PASSWORD": TOKEN},
    )


def rehearse(parts: Mapping[str, Part], out: Path, user: str, installed: bool) -> None:
    """Upload to a hub and an index of this machine; then, if ``installed``, try the wheel in an empty environment."""
    with tempfile.TemporaryDirectory() as folder, Hub() as hub, Index(Path(folder)) as index:
        environment = local(hub, index, Path(folder))
        publish(parts, out, user, environment)
        if installed:
            policies = ["memobench_expert", *(name for name in hub.repos if name == f"{user}/memobench_strict")]
            try_installed(environment["PIP_INDEX_URL"], policies, environment, Path(folder))


def try_installed(index: str, policies: Sequence[str], environment: Mapping[str, str], folder: Path) -> None:
    """Install the package by its name in an empty environment; evaluate policies there; the first must succeed."""
    clean = {key: value for key, value in environment.items() if not key.startswith(("PYTHON", "VIRTUAL_ENV"))}
    run(f"uv venv -q --python {quote(Path(sys.executable))} env", clean, folder)
    run(f"uv pip install -p env --index {index} {NAME}", clean, folder)
    for number, policy in enumerate(policies):
        words = f"{TRIED} policy={policy} videos=0 output_dir=eval-{number}"
        run(f"env/bin/lerobot eval env=memobench {words}", clean, folder)
    (episode,) = (folder / "eval-0/episodes.jsonl").read_text().splitlines()
    if not json.loads(episode)["success"]:
        raise SystemExit(f"publish: {policies[0]} failed in {TRIED}")


def left(parts: Mapping[str, Part], user: str, uploaded: bool = False) -> str:
    """Return the remaining manual steps, in order."""
    upload = f"""\
- Upload. Not seen yet: whether the index grants the name, how the hub stores files and shows its pages.

    {"=... ".join(TOKENS)}=... python scripts/publish.py --user {user} --upload

"""
    missing = "".join(f"- {name}: {part.missing}\n" for name, part in parts.items() if part.missing)
    return f"""
Left to do by hand:

{missing}{"" if uploaded else upload}- On another machine:

    pip install {NAME}=={VERSION} mujoco==3.9.0
    memobench doctor
    lerobot eval env=memobench {TRIED} policy={user}/memobench_strict

- Publish the repository: submissions to the board are its pull requests.

    git tag v{VERSION}
    git push origin main v{VERSION}

- Open LeRobot's pull request. contrib/lerobot/README.md has the place of each file.

    git -C ../lerobot apply "$PWD/contrib/lerobot/lerobot.patch"

- Demonstrations with images: `memobench generate` without `--no-images`, some 10 GB.
- Read and send the {len(GUESTS)} texts in the folder `invitations`."""


def main(argv: Sequence[str] | None = None) -> None:
    """Print the plan, run it on this machine, or upload; then print what is left."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="+", choices=PARTS, default=PARTS, metavar="PART", help=", ".join(PARTS))
    parser.add_argument("--user", default="memobench", help="account or organisation of the repositories on the hub")
    parser.add_argument("--out", type=Path, default=Path("outputs/publish"), help="folder of what is built")
    for suite in GENERATE:
        parser.add_argument(f"--{suite}", type=Path, default=Path("outputs", suite), help=f"{suite} demonstrations")
    parser.add_argument("--weights", type=Path, nargs="*", default=[], help="checkpoints of the board's rows")
    parser.add_argument("--plan", action="store_true", help="print the commands and run none")
    parser.add_argument("--upload", action="store_true", help="upload to the package index and to the hub")
    given = parser.parse_args(argv)
    if "install" in given.only and "wheel" not in given.only:
        parser.error("install needs the part wheel too")
    out, datasets = given.out.absolute(), {suite: getattr(given, suite).absolute() for suite in GENERATE}
    parts = release(given.user, out, datasets, given.weights)
    parts = {name: part for name, part in parts.items() if name in given.only}
    if given.plan:
        for name, part in parts.items():
            print(f"{name}:", *part.build, *part.upload, sep="\n    ")
    elif given.upload:
        refuse(parts)
        publish(parts, out, given.user, programs())
    else:
        rehearse(parts, out, given.user, "install" in given.only)
    print(left(parts, given.user, given.upload and not given.plan and given.only == PARTS))


if __name__ == "__main__":
    main()
