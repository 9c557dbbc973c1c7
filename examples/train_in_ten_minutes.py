"""From no data to a memory policy and the same policy without a memory, by public commands only.

    python examples/train_in_ten_minutes.py --out outputs/bowl

Two CPU cores, no GPU, no images. The task: a demonstration prompt shows butter being put into one of three equal
bowls; afterwards all bowls look the same. `--smoke` runs the same in a minute, too short to learn.
The same command resumes.
"""

from __future__ import annotations

import argparse
import os
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

from lerobot_memobench.jobs.processes import adding_resume_hint

TASK = "put_the_butter_into_the_bowl_from_the_prompt_video"
POLICIES = {"memory": (), "no_memory": ("policy.memory=none",)}
"""Name -> settings of its training, in addition to the shared ones."""


def command(*arguments: str) -> list[str]:
    """Return a command of the environment that runs this script, and print it."""
    print(f"\n$ {shlex.join(arguments)}", flush=True)
    return [str(Path(sys.executable).with_name(arguments[0])), *arguments[1:]]


def main() -> None:
    """Generate, train both policies at once, evaluate, compare."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("outputs/bowl"))
    parser.add_argument("--smoke", action="store_true", help="2 demonstrations, 2 updates, 1 rollout")
    parser.add_argument("--episodes", type=int, default=120, help="demonstrations")
    parser.add_argument("--steps", type=int, default=1600, help="updates of each policy")
    parser.add_argument("--rollouts", type=int, default=50, help="rollouts of each policy")
    parser.add_argument("--workers", type=int, default=2, help="processes")
    chosen = parser.parse_args()
    if chosen.smoke:
        chosen.episodes, chosen.steps, chosen.rollouts, chosen.workers = 2, 2, 1, 1
    data, workers = chosen.out / "data", str(chosen.workers)

    generate = command(
        *("memobench", "generate", "--tasks", TASK, "--episodes", str(chosen.episodes), "--referent", "random"),
        *("--perturb", "--no-images", "--workers", workers, "--out", str(data)),
    )
    if subprocess.run(generate, check=False).returncode > 1:  # 1: the expert failed at some scenes
        sys.exit("no demonstrations; see the reason above")

    trainings: dict[Path, subprocess.Popen[bytes]] = {}
    for name, own in POLICIES.items():
        policy = chosen.out / name
        if not (policy / "checkpoints" / "last").exists():
            shutil.rmtree(policy, ignore_errors=True)  # of a training that was killed
            words = ("lerobot", "train", "policy=memobench_mem", "size=small", "perception=objects", f"dataset={data}")
            words += (f"steps={chosen.steps}", f"output_dir={policy}", *own)
            words += ("batch_size=12", "num_workers=0") if chosen.smoke else ()
            # Both at once, each with its share of the cores; both would write one progress bar over the other.
            environment = {**os.environ, "OMP_NUM_THREADS": str(max(1, (os.cpu_count() or 1) // len(POLICIES)))}
            log = chosen.out / f"{name}.log"
            with log.open("w") as file:
                trainings[log] = subprocess.Popen(command(*words), env=environment, stdout=file, stderr=file)
            print(f"(see {log})", flush=True)
    failed = [str(log) for log, training in trainings.items() if training.wait()]
    if failed:
        sys.exit(f"training failed; see {' and '.join(failed)}")

    evaluations = [str(chosen.out / f"{name}_rollouts") for name in POLICIES]
    for name, rollouts in zip(POLICIES, evaluations, strict=True):
        words = ("lerobot", "eval", "env=memobench", f"policy={chosen.out / name}", f"tasks={TASK}", "referent=random")
        words += (f"episodes={chosen.rollouts}", "videos=0", f"output_dir={rollouts}", "resume=true")
        words += (f"shards={workers}", f"workers={workers}") if chosen.workers > 1 else ()
        words += ("env.horizon=20",) if chosen.smoke else ()
        subprocess.run(command(*words), check=True)

    subprocess.run(command("memobench", "compare", *evaluations), check=True)


if __name__ == "__main__":
    with adding_resume_hint("train_in_ten_minutes", lambda: "the same command resumes"):  # SIGTERM ends the children
        main()
