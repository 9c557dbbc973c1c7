"""Python in processes that have imported LeRobot already: forks of one that imports it once.

A fresh interpreter takes four to ten seconds of a core until LeRobot is there; a fork takes none.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import traceback
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any


class ForkServer:
    """A process that waits with imported modules and forks itself for each piece of code.

    Args:
        modules: imported before the first fork.
        environment: of the process; what a module reads while it is imported must be in it.
    """

    def __init__(self, modules: Sequence[str], environment: Mapping[str, str] | None = None) -> None:
        self._process = subprocess.Popen(
            [sys.executable, "-m", __name__, *modules],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            env=None if environment is None else dict(environment),
            cwd=Path(__file__).parents[2],
        )

    def close(self) -> None:
        self._process.communicate()

    def start(self, code: str, output: Path, errors: Path | None = None, **environment: str) -> Fork:
        """Run code in a fork and return at once.

        Args:
            output: file to which the fork's standard output is added, and its errors too without ``errors``.
            environment: variables that the fork has besides.
        """
        asked = {"code": code, "output": str(output), "errors": str(errors or output), "environment": environment}
        return Fork(self, self._ask({**asked, "folder": os.getcwd()}))

    def run(self, code: str, folder: Path, **environment: str) -> subprocess.CompletedProcess[str]:
        """Run code in a fork to its end; its output lies in the folder meanwhile."""
        output, errors = folder / "stdout.txt", folder / "stderr.txt"
        for file in (output, errors):
            file.unlink(missing_ok=True)
        status = self.start(code, output, errors, **environment).wait()
        return subprocess.CompletedProcess([code], status, output.read_text(), errors.read_text())

    def _ask(self, asked: dict[str, Any]) -> Any:
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._process.stdin.write(json.dumps(asked) + "\n")
        self._process.stdin.flush()
        return json.loads(self._process.stdout.readline())


class Fork:
    def __init__(self, server: ForkServer, pid: int) -> None:
        self.server, self.pid, self.status = server, pid, None

    def poll(self) -> int | None:
        """Return the exit status, None while it runs; negative for the signal that ended it."""
        if self.status is None:
            self.status = self.server._ask({"wait": self.pid, "options": os.WNOHANG})
        return self.status

    def wait(self) -> int:
        if self.status is None:
            self.status = self.server._ask({"wait": self.pid, "options": 0})
        return self.status

    def kill(self) -> bool:
        """Kill it; return whether it still ran."""
        os.kill(self.pid, signal.SIGKILL)  # nobody has waited for it, so the number is still its own
        return self.wait() == -signal.SIGKILL


def serve() -> None:
    """Answer a line that holds code with the number of the process that runs it, and one that waits with its status."""
    for module in sys.argv[1:]:
        __import__(module)
    for line in sys.stdin:
        asked = json.loads(line)
        if "wait" in asked:
            found, status = os.waitpid(asked["wait"], asked["options"])
            answer = os.waitstatus_to_exitcode(status) if found else None
        elif not (answer := os.fork()):
            run(asked)
        print(json.dumps(answer), flush=True)


def run(asked: dict[str, Any]) -> None:
    """Run the code of a line and end this process."""
    os.setsid()
    for stream, name in ((0, os.devnull), (1, asked["output"]), (2, asked["errors"])):
        os.dup2(os.open(name, os.O_RDWR | os.O_CREAT | os.O_APPEND, 0o644), stream)
    os.chdir(asked["folder"])
    os.environ.update(asked["environment"])
    status = 70
    try:
        exec(compile(asked["code"], "<fork>", "exec"), {"__name__": "__main__"})
        status = 0
    except SystemExit as end:
        status = end.code if isinstance(end.code, int) else int(end.code is not None)
    except BaseException:
        traceback.print_exc()
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(status)


if __name__ == "__main__":
    serve()
