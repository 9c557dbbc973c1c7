"""Estimate the hours of all 1,500 rollouts with images on this machine, from short rollouts of each task.

    python benchmarks/rollouts_total.py [TASKS]

Actions are replanned every 5 steps. Prints one JSON line.
"""

import json
import sys

from lerobot_memobench.jobs.threads import ACTING, use_threads
from research.speed.evaluation import rollouts_total

if __name__ == "__main__":
    use_threads(ACTING)  # as `lerobot eval` does, before torch is loaded
    print(json.dumps(rollouts_total(*sys.argv[1:2])))
