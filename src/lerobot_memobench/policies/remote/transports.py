"""Which ways to a policy server are there?"""

from __future__ import annotations

from lerobot_memobench.policies.remote.rest import Act, ProcessFrame, Rest
from lerobot_memobench.policies.remote.websocket import Websocket

TRANSPORTS: dict[str, type[Websocket] | type[Rest]] = {
    "websocket": Websocket,
    "act": Act,
    "process_frame": ProcessFrame,
}
