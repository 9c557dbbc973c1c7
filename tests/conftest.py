"""What every test starts from: no network, one thread, and the same examples on every run in CI."""

from __future__ import annotations

import os

# Before torch or LeRobot is imported by any test. Two cores are shared by the tests' own worker processes.
os.environ.setdefault("HF_HUB_OFFLINE", "1")
os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("TOKENIZERS_PARALLELISM", "false")

from hypothesis import settings

settings.register_profile("memobench", deadline=None, derandomize=bool(os.environ.get("CI")))
settings.load_profile("memobench")
