"""A rollout belongs to the thread that began it."""

from __future__ import annotations

import threading

from lerobot_memobench.errors import MemobenchError


class OneThread:
    """Notices when several threads act with one policy, whose histories and plans they would mix.

    ``env.max_parallel_tasks`` above 1 makes LeRobot do so. Rollouts one after the other may come from any thread.
    """

    def __init__(self) -> None:
        self._owner: int | None = None

    def begin(self) -> None:
        """Begin a rollout in this thread."""
        self._owner = threading.get_ident()

    def forget(self) -> None:
        """Leave it open to whichever thread acts first."""
        self._owner = None

    def check(self) -> None:
        """Refuse to act in another thread than the one that began.

        Raises:
            MemobenchError: this is another.
        """
        if self._owner is None:
            self.begin()
        if self._owner != threading.get_ident():
            raise MemobenchError(
                "Two threads act with one memobench_mem policy, whose memory of one rollout would then enter the "
                "other; evaluate with --env.max_parallel_tasks=1, and more rows per task by --eval.batch_size."
            )
