"""The process of one part of an evaluation: ``lerobot`` with the words after it, ended when standard input closes.

Started as ``python -m lerobot_memobench.cli.shard_process eval … shard=1/8``.
"""

from __future__ import annotations

import os
import sys
import threading

from lerobot_memobench.cli.lerobot import main


def end_with_the_parent() -> None:
    """End this process when standard input closes: the process that wanted the part is gone."""
    source = sys.stdin.fileno()

    def watch() -> None:
        while os.read(source, 1):
            pass
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


if __name__ == "__main__":
    end_with_the_parent()
    sys.exit(main(sys.argv[1:]))
