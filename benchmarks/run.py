"""Run all benchmarks, or those named as arguments: a JSON line each as it is measured, then a table of them all."""

import sys

from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.jobs.threads import ACTING, use_threads


def main(names: list[str]) -> int:
    """Return the exit status."""
    use_threads(ACTING)  # as `memobench bench` does, before numpy is loaded
    from lerobot_memobench.bench.claims import run
    from lerobot_memobench.bench.line import Line, table

    lines: list[Line] = []
    try:
        for line in run(names):
            print(line.json(), flush=True)
            lines.append(line)
    except MemobenchError as error:
        print(error, file=sys.stderr)
        return 2
    print(f"\n{table(lines)}")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
