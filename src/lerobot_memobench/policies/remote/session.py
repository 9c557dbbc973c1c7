"""One environment's talk with its server: episodes begin anew, and survive a server that goes away and comes back."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.policies.freshness import PICTURE_STEP, require_fresh
from lerobot_memobench.policies.remote.answers import read_actions
from lerobot_memobench.policies.remote.configuration_remote import RemoteConfig
from lerobot_memobench.policies.remote.dialects import IMAGE, STATE
from lerobot_memobench.policies.remote.observations import Row, fit
from lerobot_memobench.policies.remote.transport import ServerAway, Transport
from lerobot_memobench.policies.remote.transports import TRANSPORTS

logger = logging.getLogger(__name__)

PAUSE = 0.5
"""Between two attempts to reach a server, s."""
FIRST_FRAME = "episode_first_frame"
RESET = {"reset": True}


@dataclass(frozen=True)
class Question:
    """What is sent to a server, and whether its memory then holds it."""

    content: dict[str, Any]
    remembered: bool


class Session:
    """A connection to one server on behalf of one environment.

    Args:
        config: the policy's.
        address: of the server.
    """

    def __init__(self, config: RemoteConfig, address: str) -> None:
        self.config, self.address = config, address
        self._dialect, self._keys = config.spoken, config.sent()
        self._transport: Transport = TRANSPORTS[self._dialect.transport](address, config.timeout)
        self._connected = False  # ever
        self._fresh = False  # the connection has served no episode yet
        self._begin_memory()

    def _begin_memory(self) -> None:
        self._told: list[Question] = []  # what a restarted server has to hear again
        self._frames: list[tuple[NDArray[np.uint8], NDArray[np.float32]]] = []  # for the next message to a buffer
        self._seen, self._execution_starts = 0, 0
        self._first = True

    # --- what the policy calls ---

    def connect(self) -> None:
        """Reach the server, so that one that is not there costs no simulation.

        Raises:
            MemobenchError: it does not answer within ``connect_timeout``.
        """
        if self._connected:
            return
        metadata = self._until(
            time.monotonic() + self.config.connect_timeout,
            self._transport.open,
            lambda reason: (
                f"no policy server answered at {self.address} within {self.config.connect_timeout:g} s ({reason}); "
                "start it, or give its address by host= and port="
            ),
            on_wait=lambda reason: logger.warning("waiting for the policy server at %s (%s)", self.address, reason),
        )
        self._connected = self._fresh = True
        logger.info("connected with the policy server at %s, which says: %s", self.address, metadata or "nothing")

    def begin(self) -> None:
        """Start an episode: a memory in the server, of the connection or of its own, forgets the last one."""
        self.connect()
        self._begin_memory()
        if not self._fresh:
            self._again(time.monotonic() + self.config.retry)
        elif self._dialect.buffers:
            self._deliver(Question(dict(RESET), remembered=False))

    def watch(self, row: Row) -> None:
        """Note a frame that is not asked about; a server that buffers frames gets it with the next question."""
        if self._dialect.buffers:
            require_fresh(row.scalar("step"), row.scalar(PICTURE_STEP))
            self._frames.append((self._image(row, IMAGE), np.asarray(row.get(STATE), np.float32)))

    def execution_starts(self) -> None:
        """Note that the frames so far showed the prompt."""
        self._execution_starts = self._seen + len(self._frames)

    def ask(self, row: Row) -> NDArray[np.float32]:
        """Return the server's actions for an observation, (H, 7).

        Raises:
            MemobenchError: the server failed, took too long, stays away, or answered something else.
        """
        if self._dialect.buffers:
            self.watch(row)
            self._deliver(self._buffer())
        question = self._observation(row)
        answer = self._deliver(Question(question, self.config.remembers and not self._dialect.buffers))
        return read_actions(answer, self.config, self.address)

    def close(self) -> None:
        """Hang up."""
        self._transport.close()

    # --- questions ---

    def _observation(self, row: Row) -> dict[str, Any]:
        found = {theirs: self._image(row, ours) for theirs, ours in self._keys.items()}
        if self._dialect.transport == "process_frame":
            found[FIRST_FRAME] = str(self._first)  # 'True' and 'False', as MemoryVLA reads them
            self._first = False
        return found

    def _image(self, row: Row, name: str) -> Any:
        value = row.get(name)
        if isinstance(value, np.ndarray) and value.ndim == 3:
            return fit(value, self.config.side, self.config.mirror)
        return value

    def _buffer(self) -> Question:
        images, states = zip(*self._frames, strict=True)
        self._frames = []
        self._seen += len(images)
        content = {
            "images": np.stack(images)[:, None],
            "state": np.stack(states),
            "add_buffer": True,
            "exec_start_idx": self._execution_starts,
        }
        return Question(content, self.config.remembers)

    # --- delivery ---

    def _deliver(self, question: Question) -> dict[str, Any]:
        """Send a question until it is answered; a server that went away is waited for and told the episode again."""
        deadline = 0.0
        while True:
            try:
                answer = self._transport.ask(question.content)
                break
            except ServerAway as error:
                if deadline:  # it came back and broke over the same question
                    time.sleep(PAUSE)
                deadline = deadline or time.monotonic() + self.config.retry
                logger.warning("the policy server at %s went away (%s); waiting for it", self.address, error)
                self._again(deadline, str(error))
        self._fresh = False
        if question.remembered:
            self._told.append(question)
        return answer

    def _again(self, deadline: float, reason: str = "") -> None:
        """Connect anew and bring the server to where the episode is.

        Raises:
            MemobenchError: it stays away until the deadline.
        """
        self._until(
            deadline,
            self._tell_again,
            lambda reason: (
                f"the policy server at {self.address} went away and did not come back within "
                f"{self.config.retry:g} s ({reason}); the episode that was running is not counted: start "
                "the server and go on with resume=true output_dir=<this run's folder>"
            ),
            reason=reason,
        )

    def _tell_again(self, patience: float) -> None:
        self._transport.open(patience)
        if self._dialect.buffers:
            self._transport.ask(dict(RESET))
        for question in self._told:
            self._transport.ask(question.content)
        self._fresh = not self._told

    def _until[Result](
        self,
        deadline: float,
        attempt: Callable[[float], Result],
        failed: Callable[[str], str],
        *,
        reason: str = "",
        on_wait: Callable[[str], None] | None = None,
    ) -> Result:
        """Return what ``attempt`` gives, called with the seconds left, as soon as the server is there for it.

        Args:
            failed: words for the last reason, when the deadline has passed. on_wait: told the first reason.
        """
        while True:
            left = deadline - time.monotonic()
            if left <= 0:
                raise MemobenchError(failed(reason))
            try:
                return attempt(left)
            except ServerAway as error:
                reason = str(error)
            if on_wait is not None:
                on_wait(reason)
                on_wait = None
            time.sleep(min(PAUSE, max(0.0, left)))
