"""The checks as tests of pytest: subclass `MemoryConformance` in the tests of a policy."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import ClassVar

import pytest

from lerobot_memobench.conformance.checks import CHECKS, FAILED, NO_MEMORY, NOT_CHECKED, Behaviour, run_check
from lerobot_memobench.conformance.subject import load_subject


class MemoryConformance:
    """One test for each check of a policy; a check that does not apply is skipped with its reason.

    Attributes:
        arguments: as `memobench conformance` takes them, ``("policy=mine", "policy.width=32")``.
    """

    arguments: ClassVar[Sequence[str]]

    @pytest.fixture(scope="class")
    @classmethod
    def behaviour(cls) -> Iterator[Behaviour]:
        """The actions of the policy, measured once for the class."""
        with TemporaryDirectory() as folder:
            yield Behaviour(load_subject(cls.arguments, Path(folder)))

    @pytest.mark.parametrize("check", CHECKS)
    def test_conformance(self, behaviour: Behaviour, check: str) -> None:
        """Run one check."""
        result = run_check(check, behaviour)
        if result.outcome in (NO_MEMORY, NOT_CHECKED):
            pytest.skip(result.sentence)
        if result.outcome == FAILED:
            pytest.fail(result.sentence, pytrace=False)
