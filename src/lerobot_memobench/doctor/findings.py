"""What the doctor finds: one thing looked at, whether it is well, what mends it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Literal

Status = Literal["ok", "warning", "failed"]


@dataclass(frozen=True)
class Finding:
    """One thing looked at.

    Attributes:
        status: ``failed`` keeps the benchmark from running, ``warning`` costs speed or a part of it.
        fix: what to do about it; empty when there is nothing to do.
    """

    what: str
    status: Status
    detail: str
    fix: str = ""

    def as_dict(self) -> dict[str, str]:
        """Return the finding for JSON."""
        return asdict(self)


def exit_status(findings: Sequence[Finding]) -> int:
    """Return 1 when something that is needed failed."""
    return int(any(finding.status == "failed" for finding in findings))
