"""Results of an evaluation for the page of a model on the Hugging Face hub."""

from __future__ import annotations

from lerobot_memobench.evaluation.headline import headline
from lerobot_memobench.evaluation.metrics import METRICS, Rate, percent
from lerobot_memobench.evaluation.records import Run

FILE = ".eval_results/memobench.yaml"
"""Place in the model's repository."""


def huggingface_yaml(run: Run, dataset: str) -> str:
    """Return the content of `FILE`: an entry per metric, with the headline of the report as its notes.

    Args:
        dataset: repository of the benchmark's dataset on the hub, as ``user/name``.
    """
    import yaml
    from huggingface_hub import EvalResultEntry, eval_result_entries_to_yaml

    suite = run.protocol["suite"]
    conditions = "; ".join([headline([run]), *([run.missing] if run.missing else [])])
    entries = [
        EvalResultEntry(
            dataset_id=dataset,
            task_id=f"{suite}_{metric.lower()}",
            value=percent(rate.value),
            date=str(run.card["written"])[:10] if "written" in run.card else None,
            notes=f"{conditions}{_interval(rate)}",
        )
        for metric in METRICS
        if (rate := run.summary.average[metric]).value is not None
    ]
    return yaml.safe_dump(eval_result_entries_to_yaml(entries), sort_keys=False, allow_unicode=True)


def _interval(rate: Rate) -> str:
    return "" if rate.interval is None else "; 95 % interval {} to {}".format(*map(percent, rate.interval))
