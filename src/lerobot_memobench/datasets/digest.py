"""The hash of an episode: what manifest and HDF5 files hold to tell whether it is still the one that was written."""

from __future__ import annotations

import hashlib
import json
from dataclasses import fields

import numpy as np
from numpy.typing import NDArray

from lerobot_memobench.datasets.demonstration import Demonstration
from lerobot_memobench.datasets.labels import labels


def digest(demo: Demonstration) -> str:
    """Return the sha256 (hex) of an episode: identity, states, actions and the label columns.

    Images are left out: they follow from the states, and a renderer may differ in a pixel where physics does
    not. So are the objects that could be seen, and ``coarse_subgoal`` and ``subtask``, which the other columns and the
    task decide: they came later than the first datasets, and their hashes stay what they are.
    """
    found = labels(demo)
    identity = {
        "task": demo.task.name,
        "seed": demo.seed,
        "referent": demo.referent,
        "variant": demo.variant,
        "exec_start": demo.exec_start,
        "success": bool(demo.success),
    }
    columns: dict[str, NDArray | list[str]] = {"states": demo.states, "actions": demo.actions}
    if demo.executed is not None:
        columns["executed"] = demo.executed
    columns |= {f.name: getattr(found, f.name) for f in fields(found) if f.name not in ("coarse_subgoal", "subtask")}
    return digest_columns(identity, columns)


def digest_columns(identity: dict, columns: dict[str, NDArray | list[str]]) -> str:
    """Hash an identity and named columns; independent of byte order, memory layout and dictionary order."""
    sha = hashlib.sha256(json.dumps(identity, sort_keys=True).encode())
    for name in sorted(columns):
        column = columns[name]
        if isinstance(column, list):
            sha.update(json.dumps([name, column]).encode())
            continue
        flat = np.ascontiguousarray(column).astype(column.dtype.newbyteorder("<"), copy=False)
        sha.update(json.dumps([name, flat.dtype.str, list(flat.shape)]).encode())
        sha.update(flat.tobytes())
    return sha.hexdigest()
