"""What an experiment found, in Markdown: outcomes, differences, costs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from lerobot_memobench.studies.learning.contrasts import Contrast
from lerobot_memobench.studies.learning.experiments import MEMORY
from lerobot_memobench.studies.learning.figure import SCOPES
from lerobot_memobench.studies.learning.outcomes import Outcome
from lerobot_memobench.studies.learning.running import Costs

COLUMNS = (
    *("", "rollouts", "success", "95 % interval", "training seeds"),
    *("wrong referent, order, place or count", "other failures"),
)


def outcomes_table(arms: Mapping[str, Mapping[str, Outcome]]) -> str:
    """Return a table of all arms and scopes; a mean over several tasks comes before its tasks."""
    scopes = list(next(iter(arms.values())))
    tasks = [scope for scope in scopes if scope not in SCOPES]
    told = tasks if len(tasks) == 1 else scopes
    rows = [[f"{scope}, {arm}", *_cells(arms[arm][scope])] for scope in told for arm in arms]
    return markdown(COLUMNS, rows)


def _cells(outcome: Outcome) -> list[str]:
    low, high = outcome.success.interval or (0.0, 0.0)
    value = outcome.success.value or 0.0
    seeds = ", ".join(f"{100 * each:.0f}" for each in outcome.of_seeds)
    rates = [f"{100 * value:.1f}", f"{100 * low:.1f}–{100 * high:.1f}"]
    return [str(outcome.success.n), *rates, seeds, str(outcome.wrong), str(outcome.others)]


def contrasts_table(found: Mapping[str, Contrast], seeds: int, reference: str = MEMORY) -> str:
    """Return a table of arms against the reference."""
    rows = [
        [
            f"{name} less {reference}",
            str(one.episodes),
            *(f"{100 * one.value:+.1f}", f"{100 * one.low:+.1f} to {100 * one.high:+.1f}", _probability(one.p)),
            "–" if one.detectable is None else f"{100 * one.detectable:.1f}",
        ]
        for name, one in found.items()
    ]
    trained = f"95 % interval, {seeds} training seed{'s' if seeds > 1 else ''}"
    return markdown(("", "episodes", "difference, points", trained, "p (Holm)", "detectable"), rows)


def _probability(p: float) -> str:
    return f"{p:.3f}" if p >= 0.001 else "< 0.001"


def costs_table(costs: Costs) -> str:
    """Return what each part took: minutes of the longest command of a part, and of processors in all."""
    rows = []
    for part, commands in costs.items():
        told = [cost for cost in commands if cost is not None]
        wall = max((cost.wall_s for cost in told), default=0.0)
        rows.append([part, str(len(told)), f"{wall / 60:.1f}", f"{sum(cost.cpu_s for cost in told) / 60:.1f}"])
    return markdown(("part", "commands", "longest, min", "CPU min in all"), rows)


def markdown(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Return a table."""
    return "\n".join("| " + " | ".join(cells) + " |" for cells in (header, ["---"] * len(header), *rows))
