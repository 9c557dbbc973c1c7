"""``python -m research.update_interval``: evaluate policies at several plan intervals, memory fed in two ways."""

from __future__ import annotations

import os
import re
import sys
import tempfile
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import typer

from lerobot_memobench.cli.console import say
from lerobot_memobench.commands.command_line import load_plugins
from lerobot_memobench.envs.evaluation_file import POLICY
from lerobot_memobench.envs.observations import obs_type_of
from lerobot_memobench.errors import MemobenchError
from lerobot_memobench.evaluation.comparison import compare_evaluations
from lerobot_memobench.evaluation.plots import legend_below, new_figure, paper_style
from lerobot_memobench.evaluation.records import Run, read_run
from lerobot_memobench.evaluation.tables import percent_text, with_interval
from lerobot_memobench.io import draft_of, file_name, write_file
from lerobot_memobench.policies.checkpoint import WEIGHTS_FILE, local_folder
from research import kept as store
from research.command import run
from research.memory_study.commands import run_once
from research.memory_study.tables import EMPTY, table_of

INTERVALS = (1, 5, 10, 16)
FED = (STEPS, PLANS) = ("each step", "each plan")
"""When the policy observes the execution. A policy that plans at each step does both, and is run once."""
STYLES = {STEPS: {"color": "#0072b2", "fmt": "o-"}, PLANS: {"color": "#d55e00", "fmt": "s--"}}
NAME = re.compile(rf"([^/]+)/(?:{STEPS}|{PLANS}), \d+")
"""Name of a kept evaluation of a sweep."""
FED_AT_PLANS = "fed_at_plans"
AT_PLANS = (f"policy={FED_AT_PLANS}", "policy.discover_packages_path=research.update_interval.at_plans")
HEADER = (
    *("policy", "plan interval", "memory fed at", "memory interval in training", "in rollouts"),
    *("SR", "follows evidence", "SR, change from each step", "rollouts"),
)


class Place(NamedTuple):
    """A policy's name, its plan interval, and when its memory is fed."""

    policy: str
    replan: int
    fed: str

    @property
    def name(self) -> str:
        """Path of the evaluation's folder, in that of the sweep."""
        return f"{self.policy}/{self.fed}, {self.replan}"


Runs = Mapping[Place, Run]


def sweep(
    out: Annotated[Path, typer.Option(help="Folder of all results; the same command resumes.")],
    policy: Annotated[list[str] | None, typer.Option(help="NAME=FOLDER of a trained policy; repeatable.")] = None,
    settings: Annotated[list[str] | None, typer.Argument(help="Settings of every evaluation: tasks=object.")] = None,
    replan: Annotated[list[int] | None, typer.Option(help="A plan interval; 1, 5, 10 and 16 if omitted.")] = None,
    keep: Annotated[Path | None, typer.Option(help="Add the evaluations to the Parquet tables here.")] = None,
    kept: Annotated[
        Path | None, typer.Option(help="Make table and figure of the Parquet tables here, without any other option.")
    ] = None,
) -> None:
    """Evaluate every policy at every plan interval, then print and write the table and the figure."""
    if (kept is None) is not bool(policy) or (kept is not None and (settings or replan or keep)):
        raise MemobenchError("expected --policy NAME=FOLDER, or --kept alone; give one of them")
    if kept is not None:
        with tempfile.TemporaryDirectory() as folder:
            names = [name for name in store.restore(kept, Path(folder)) if NAME.fullmatch(name)]
            if not names:
                raise MemobenchError(f"{kept} holds no evaluation of a sweep; give a folder that --keep has written")
            show(Path(folder), names, out)
        return
    checkpoints, intervals = dict(map(read_policy, policy or [])), sorted({*(replan or INTERVALS)})
    if len(checkpoints) < len(policy or []):
        raise MemobenchError(f"found two policies of one name in --policy {' '.join(policy or [])}; name each once")
    for name, (_, config) in checkpoints.items():
        if intervals[-1] > config.chunk_size:
            raise MemobenchError(
                f"found a plan interval of {intervals[-1]} and chunks of {config.chunk_size} actions of {name}; name "
                "intervals up to that by --replan"
            )
    places = [
        Place(name, steps, fed) for name in checkpoints for steps in intervals for fed in FED[: 1 if steps == 1 else 2]
    ]
    for place in places:
        words = [*words_of(place, *checkpoints[place.policy]), *(settings or []), f"output_dir={out / place.name}"]
        run_once(words, out / f"{place.name}.log", how=["resume=true"])
    names = [place.name for place in places]
    if keep is not None:
        store.keep(out, names, keep)
    show(out, names, out)


def show(source: Path, names: Iterable[str], out: Path) -> None:
    """Print the table of the evaluations of these names in ``source``; write it and the figure."""
    runs = runs_of(source, names)
    text = table_of(HEADER, [row(place, runs) for place in runs])
    out.mkdir(parents=True, exist_ok=True)
    write_file(out / "interval.md", f"{text}\n")
    draw(runs, out / "interval.png")
    say(text)


def runs_of(source: Path, names: Iterable[str]) -> Runs:
    """Return the evaluations of these names in ``source``; plan interval and feeding are those of their cards."""
    found, hashes = {}, dict[str, Any]()
    for name in names:
        run = read_run(source / name)
        policy, here = name.partition("/")[0], run.card[POLICY].get("sha256")
        if here is not None and hashes.setdefault(policy, here) != here:
            raise MemobenchError(
                f"{source / name} is of other weights of {policy} than an earlier evaluation; delete it"
            )
        fed = PLANS if run.card[POLICY]["type"] == FED_AT_PLANS else STEPS
        found[Place(policy, run.protocol["replan_steps"], fed)] = run
    return {place: found[place] for place in sorted(found, key=lambda each: (*each[:2], FED.index(each.fed)))}


def read_policy(word: str) -> tuple[str, tuple[Path, Any]]:
    """Return name, checkpoint folder and configuration of ``NAME=FOLDER``."""
    from lerobot.configs import PreTrainedConfig

    load_plugins()
    name, _, text = word.partition("=")
    if (folder := local_folder(text) if text else None) is None:
        raise MemobenchError(f"found --policy {word!r}; expected NAME=FOLDER with the folder of a trained policy")
    config = PreTrainedConfig.from_pretrained(str(folder))
    return file_name(name, "the policy's name"), (Path(os.path.relpath(folder)), config)


def words_of(place: Place, checkpoint: Path, config: Any) -> Iterator[str]:
    """Yield the words of an evaluation; by the clock of published tasks `memobench_mem` refuses omitted frames."""
    yield from ("lerobot", "eval", "env=memobench", "suite=strict", f"replan={place.replan}")
    if place.fed == PLANS:
        yield from (*AT_PLANS, f"policy.weights={checkpoint / WEIGHTS_FILE}")
    else:
        yield f"policy={checkpoint}"
    if (obs_type := obs_type_of(config)) is not None:
        yield f"obs_type={obs_type}"


def row(place: Place, runs: Runs) -> list[str]:
    """Return a row of the table; the memory interval is that of the policy fed at each step, by its card."""
    found, base = runs[place], runs[place._replace(fed=STEPS)]
    rate, evidence = found.summary.average["SR"], found.evidence
    follows = None if evidence is None or evidence.average is None else evidence.average.rates["follows"]
    settings = base.card[POLICY]["settings"]
    trained = settings.get("memory_stride", settings.get("stride"))  # of memobench_mem, of the plug-in example
    change, acted = EMPTY, trained
    if place.fed == PLANS:
        success = compare_evaluations(base, found, permutations=100).contrasts[0]
        low, high = map(percent_text, success.interval)
        change = f"{percent_text(success.value, sign=True)} [{low} to {high}]"
        acted = None if trained is None else trained * place.replan
    return [
        *(place.policy, str(place.replan), "both" if place.replan == 1 else place.fed),
        *(EMPTY if steps is None else str(steps) for steps in (trained, acted)),
        EMPTY if rate.interval is None else with_interval(rate.value, *rate.interval),
        EMPTY if follows is None else with_interval(follows.value, follows.low, follows.high),
        *(change, str(len(found.records))),
    ]


def draw(runs: Runs, path: Path) -> None:
    """Draw success over the plan interval, a panel for each policy, with Wilson's intervals."""
    names, handles = list(dict.fromkeys(place.policy for place in runs)), dict[str, Any]()
    with paper_style(), draft_of(path) as draft:
        figure = new_figure(3.0 + 1.5 * len(names), 2.4)
        axes = figure.subplots(1, len(names), squeeze=False, sharey=True)[0]
        for name, axis in zip(names, axes, strict=True):
            for fed, style in STYLES.items():
                mine = {p.replan: r for p, r in runs.items() if p.policy == name and (p.fed == fed or p.replan == 1)}
                rates = [run.summary.average["SR"] for run in mine.values()]
                values = [100 * (rate.value or 0.0) for rate in rates]
                ends = [[100 * end for end in rate.interval or (0.0, 0.0)] for rate in rates]
                pairs = zip(values, ends, strict=True)  # at 0 and 100 an end may differ from the rate by rounding
                bars = [(max(value - low, 0.0), max(high - value, 0.0)) for value, (low, high) in pairs]
                shown = axis.errorbar([*mine], values, [*zip(*bars, strict=True)], ms=3.5, capsize=2, **style)
                handles[f"memory fed at {fed}"] = shown
            axis.set_title(name)
            axis.set_xticks(sorted({place.replan for place in runs}))
            axis.set_xlabel("plan interval, control steps")
        axes[0].set_ylim(0, 102)
        axes[0].set_ylabel("success, %")
        legend_below(figure, handles, 2)
        figure.savefig(draft, dpi=200)


if __name__ == "__main__":
    sys.exit(run("update_interval", sweep))
