"""A control step of `lerobot eval`, beside the bare environment and robosuite in LeRobot's loop: JSON lines.

    python benchmarks/eval_loop.py [rounds]

`ours` and `theirs` are LeRobot's evaluation of this environment and of stock robosuite's PickPlace, `bare` our vector
environment alone, which draws as many pictures; `over_bare` is what the loop adds. Start-up and resets are apart.
"""

import sys

from lerobot_memobench.jobs.threads import ACTING, use_threads

if __name__ == "__main__":
    use_threads(ACTING)  # as `lerobot eval` does, before torch is loaded
    from lerobot_memobench.bench.evaluation import eval_loop

    for line in eval_loop(rounds=int(sys.argv[1]) if len(sys.argv) > 1 else 5):
        print(line.json(), flush=True)
