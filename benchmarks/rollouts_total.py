"""Hours that 1,500 rollouts with images take here, replanning every 5 steps, from a sample of all tasks: one JSON line.

python benchmarks/rollouts_total.py [tasks]
"""

import json
import sys

from lerobot_memobench.jobs.threads import ACTING, use_threads
from research.speed.evaluation import rollouts_total

if __name__ == "__main__":
    use_threads(ACTING)  # as `lerobot eval` does, before torch is loaded
    print(json.dumps(rollouts_total(*sys.argv[1:2])))
