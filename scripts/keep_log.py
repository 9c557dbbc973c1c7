"""Keep the log of an evaluation beside the research notes, compressed, and print the figures of its row.

``python scripts/keep_log.py FOLDER NAME`` writes ``docs/research/logs/NAME``. ``tests/test_docs.py`` holds the rows of
README and results that link a log to these figures.
"""

from __future__ import annotations

import gzip
import sys
from pathlib import Path

from lerobot_memobench.envs.episode_log import MERGED_FILE
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.evaluation.metrics import METRICS, Rate, percent
from lerobot_memobench.evaluation.records import CARD_FILE, read_runs
from lerobot_memobench.evaluation.report import write_report
from lerobot_memobench.io import file_bytes, packed, write_file

LOGS = Path(__file__).parents[1] / "docs" / "research" / "logs"


def figures(folder: Path) -> dict[str, str]:
    """Return the average's metrics, and the number of rollouts, as documents write them."""
    (run,) = read_runs([folder])
    rates = {metric: in_words(run.summary.average[metric]) for metric in METRICS}
    return {**rates, "rollouts": f"{run.summary.rollouts:,}"}


def in_words(rate: Rate) -> str:
    """Return a rate as documents write it: ``97.9 [96.9–98.5]``; 0 and 100 without a decimal."""
    if rate.value is None or rate.interval is None:
        return "–"
    parts = [percent(part) for part in (rate.value, *rate.interval)]
    value, low, high = (f"{part:.0f}" if part in (0, 100) else f"{part:.1f}" for part in parts)
    return f"{value} [{low}–{high}]"


def main() -> None:
    """Compress the log and the card of an evaluation, and print its row."""
    folder, kept = Path(sys.argv[1]), LOGS / sys.argv[2]
    write_report(folder)  # merges the workers' files
    kept.mkdir(parents=True, exist_ok=True)
    for name in (MERGED_FILE, CARD_FILE):
        write_file(packed(kept / name), gzip.compress(file_bytes(folder / name), mtime=0))
    row = figures(kept)
    if row != figures(folder):
        raise MemobenchError(f"the log in {kept} does not tell what the one in {folder} does")
    print(f"| {' | '.join(row.values())} | [log](../research/logs/{kept.name}/{packed(Path(MERGED_FILE))}) |")


if __name__ == "__main__":
    main()
