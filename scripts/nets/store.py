"""Facts of the nets, the committed record, and the comparison of both.

A fact is a plain value of a field of a subject, so a comparison names fields that went, came or changed. A field that
ends in `BITS` hashes numbers. On another machine, where kernels may round differently, it is not compared; the numbers
with it are, with a tolerance.
"""

import gzip
import hashlib
import json
import platform
from collections import defaultdict
from collections.abc import Callable, Mapping
from importlib.metadata import version
from math import isclose
from pathlib import Path
from traceback import print_exc
from typing import Any

import numpy as np

ROOT = Path(__file__).resolve().parents[2]
RECORD = Path(__file__).with_name("record.json.gz")
BITS = "bits"
TOLERANCE = 1e-6
"""Largest relative difference of a number across machines."""
EXAMPLES = 3
"""Printed examples of each field."""

Facts = dict[str, dict[str, Any]]
"""Subject -> field -> text, number, truth value or None."""
Parts = Mapping[str, Callable[[Path], Facts]]
"""Name of a part -> function that returns its facts; its folder is shared by the net's parts."""


def digest(*values: Any) -> str:
    """Return a hash of arrays with their types and shapes, of bytes and of text."""
    sha = hashlib.sha256()
    for value in values:
        if isinstance(value, bytes | str):
            sha.update(value.encode() if isinstance(value, str) else value)
        else:
            array = np.ascontiguousarray(value)
            sha.update(f"{array.dtype.str}{array.shape}".encode() + array.tobytes())
    return sha.hexdigest()[:12]


def flatten(value: Any, name: str = "") -> dict[str, Any]:
    """Return the leaves of nested dictionaries and lists by their dotted path."""
    if not isinstance(value, dict | list) or not value:
        return {name: str(value) if isinstance(value, dict | list) else value}
    items = value.items() if isinstance(value, dict) else enumerate(value)
    return {k: v for key, one in items for k, v in flatten(one, f"{name}.{key}" if name else str(key)).items()}


def work_folder(net: str) -> Path:
    """Return the folder of a net's parts for the present sources."""
    files = sorted(file for file in (ROOT / "src").rglob("*") if file.is_file() and "__pycache__" not in file.parts)
    source = digest(*(one for file in files for one in (file.relative_to(ROOT).as_posix(), file.read_bytes())))
    return ROOT / "outputs" / "nets" / source / net


def run_parts(parts: Parts, folder: Path, only: str) -> None:
    """Run the parts whose name contains ``only``, except for those that have run; an error is the fact ``error``."""
    (folder / "parts").mkdir(parents=True, exist_ok=True)
    for number, (name, part) in enumerate(parts.items()):
        file = part_file(folder, name)
        if only not in name or (file.exists() and "error" not in json.loads(file.read_text()).get(name, {})):
            continue
        print(f"  {folder.name} {number + 1}/{len(parts)}: {name}", flush=True)
        try:
            facts = part(folder=folder)
        except Exception as error:
            print_exc()
            facts = {name: {"error": str(error)[-200:]}}
        draft = file.with_suffix(".draft")
        draft.write_text(json.dumps(facts))
        draft.rename(file)


def part_file(folder: Path, name: str) -> Path:
    """Return the file with the facts of a part."""
    return folder / "parts" / f"{digest(name)}.json"


def machine() -> dict[str, str]:
    """Return the properties of this machine that may change the last bit of a number."""
    cpu = next((line for line in Path("/proc/cpuinfo").read_text().splitlines() if "model name" in line), "unknown")
    return {
        "cpu": platform.machine() + cpu,
        **{name: version(name) for name in ("lerobot", "mujoco", "numpy", "torch")},
    }


def read_record(file: Path) -> dict[str, Any]:
    """Return net -> machine and facts; empty without a record."""
    return dict(json.loads(gzip.decompress(file.read_bytes()))) if file.exists() else {}


def write_record(net: str, facts: Facts, file: Path) -> None:
    """Write the facts of a net into the record, with sorted keys and one fact per line."""
    record = read_record(file) | {net: {"machine": machine(), "facts": facts}}
    text = json.dumps(record, indent=0, sort_keys=True, ensure_ascii=False)
    file.write_bytes(gzip.compress(text.encode(), mtime=0))


def differences(recorded: Facts, found: Facts, same_machine: bool) -> list[str]:
    """Return the lines of each field that went, came or changed: how often, and its first subjects."""
    fields: dict[str, list[str]] = defaultdict(list)
    for subject in sorted({*recorded, *found}):
        old, new = recorded.get(subject, {}), found.get(subject, {})
        for field in sorted({*old, *new}):
            if field not in new:
                fields[f"{field}: went"].append(f"{subject}: {old[field]!r}")
            elif field not in old:
                fields[f"{field}: came"].append(f"{subject}: {new[field]!r}")
            elif not equal(field, old[field], new[field], same_machine):
                fields[f"{field}: changed"].append(f"{subject}: {old[field]!r} -> {new[field]!r}")
    found_lines = (
        [f"{name}, {len(each)} times", *(f"  {one}" for one in each[:EXAMPLES])] for name, each in fields.items()
    )
    return [line for lines in found_lines for line in lines]


def equal(field: str, old: Any, new: Any, same_machine: bool) -> bool:
    """Return whether two values of a field are equal, on another machine within the tolerance."""
    if same_machine or old == new:
        return bool(old == new)
    if field.endswith(BITS):
        return True
    return all(type(one) is float for one in (old, new)) and isclose(old, new, rel_tol=TOLERANCE, abs_tol=TOLERANCE)
