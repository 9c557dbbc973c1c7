"""Check the board: ``python -m tools.board BOARD [CHANGED [AUTHOR]]``, and print a digest of each row.

CHANGED is a file with the paths that a pull request changes, separated by NUL (``git diff -z --name-only``). AUTHOR is
the account of its author; of a maintainer, it is left out. The exit status is 1 where a submission is refused.
"""

from __future__ import annotations

import sys
from pathlib import Path

from lerobot_memobench.board.submission import BOARD
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.jobs.processes import prepare_process
from tools.board.check import check_author, check_paths, read_board


def main(words: list[str]) -> int:
    """Check the board; print the names of its rows, or the reason of a refusal."""
    if not 1 <= len(words) <= 3:
        print(__doc__, file=sys.stderr)
        return 2
    try:
        if words[1:]:
            changed = check_paths(filter(None, Path(words[1]).read_bytes().decode(errors="replace").split("\0")))
            for author in words[2:]:
                check_author(author, changed, Path(words[0]), BOARD)
        rows = read_board(Path(words[0]))
    except (MemobenchError, OSError) as error:  # quoted lines could be commands of the workflow
        printable = "".join(letter if letter.isprintable() else " " for letter in str(error))
        print(f"refused: {printable}", file=sys.stderr)
        return 1
    for row in rows:
        print(f"accepted: {row.name} {row.digest}")
    return 0


if __name__ == "__main__":
    prepare_process()
    sys.exit(main(sys.argv[1:]))
