"""Whether LeRobot finds this project as its plugin."""

from __future__ import annotations

from importlib import metadata

from lerobot_memobench.doctor.findings import Finding

DISTRIBUTION = "lerobot_policy_memobench"
WHAT = "LeRobot plugin"


def plugin() -> Finding:
    """Do what LeRobot does to find plugins; it logs an import error and goes on, this reports it."""
    if DISTRIBUTION not in [distribution.metadata.get("Name") for distribution in metadata.distributions()]:
        return Finding(
            WHAT,
            "failed",
            f"no installed distribution is named {DISTRIBUTION}, so LeRobot does not look for it",
            "install the project (`make setup`); a source folder on PYTHONPATH is not enough",
        )
    try:
        missing = not_registered()
    except Exception as error:
        reason = f"importing it fails: {type(error).__name__}: {error}"
        return Finding(WHAT, "failed", reason, "mend the import error; LeRobot only logs it")
    if missing:
        return Finding(WHAT, "failed", f"imported, but not registered: {', '.join(missing)}", "run `make setup`")
    return Finding(WHAT, "ok", "discovered: env memobench, policies memobench_mem, memobench_expert")


def not_registered() -> list[str]:
    """Import the plugin as LeRobot does; return what LeRobot still does not know of it."""
    __import__(DISTRIBUTION)
    from lerobot.configs.policies import PreTrainedConfig
    from lerobot.envs.configs import EnvConfig
    from lerobot.policies import factory as _factory  # noqa: F401 - importing it registers policies

    policies, environments = PreTrainedConfig.get_known_choices(), EnvConfig.get_known_choices()
    missing = [f"policy {name}" for name in ("memobench_mem", "memobench_expert") if name not in policies]
    return missing + [f"env {name}" for name in ("memobench",) if name not in environments]
