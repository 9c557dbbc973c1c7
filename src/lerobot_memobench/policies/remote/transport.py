"""What a way to a policy server is, and what all of them say when it fails."""

from __future__ import annotations

from typing import Any, Protocol

from lerobot_memobench.errors import MemobenchError


class ServerAway(Exception):
    """The server cannot be reached, or went away; it may come back."""


class Transport(Protocol):
    """A connection to a server; it opens as often as it must."""

    def open(self, patience: float) -> dict[str, Any]:
        """Connect anew within ``patience`` seconds, return what the server says of itself; `ServerAway` if it fails."""
        ...

    def ask(self, question: dict[str, Any]) -> dict[str, Any]:
        """Send a question, return the answer.

        Raises:
            ServerAway: the connection broke.
            MemobenchError: the server failed, took too long, or is none of this kind.
        """
        ...

    def close(self) -> None:
        """Hang up."""
        ...


def last_line(text: str) -> str:
    """Return the line of a traceback that says what was wrong."""
    lines = [line.strip() for line in text.splitlines() if line.strip()]
    return lines[-1] if lines else "it does not say why"


def too_slow(address: str, timeout: float) -> MemobenchError:
    """Return the error of a server that thinks for too long."""
    return MemobenchError(
        f"the policy server at {address} took more than {timeout:g} s for an answer; give it longer by policy.timeout="
    )


def reason(error: BaseException) -> str:
    """Return what an error says, in one line."""
    return " ".join(str(error).split()) or type(error).__name__
