"""How many parameters the memory adds at full size, by part, beside pi0.5's own; nothing is allocated.

    python benchmarks/memory_parameters.py

Counted on the meta device. The paper says "about 80M" for the modulator setting; the specification 85 to 95 million in
all. Prints one JSON line.
"""

from __future__ import annotations

import json

import torch
from policies import config

from lerobot_memobench.policies.memobench_mem.alignment import make_alignment
from lerobot_memobench.policies.memobench_mem.network import MemoryPI05


def main() -> None:
    """Count and print."""
    settings = config("pi05", device="cpu")
    dims = settings.dimensions
    with torch.device("meta"):
        model = MemoryPI05(settings)
        heads = {
            name: make_alignment(name, dims.vlm.width, dims.text_dim, settings.tokens_per_frame)
            for name in ("semantic", "contrastive", "framewise")
        }
    parts: dict[str, int] = {"encoder": 0, "memory_to_expert": 0, "modulators": 0}
    memory = model.memory_parameters()
    for name, parameter in memory.items():
        part = "modulators" if name.startswith("modulators.") else name.split(".")[0].replace("memory", "encoder", 1)
        parts["memory_to_expert" if name.startswith("memory_to_expert") else part] += parameter.numel()
    total = sum(parts.values())
    # The language heads are never asked, and on the meta device not even tied to the embeddings.
    used = [parameter for name, parameter in model.named_parameters() if "lm_head" not in name]
    backbone = sum(parameter.numel() for parameter in used) - total
    result = {
        "benchmark": "memory_parameters",
        "memory": parts,
        "memory_total": total,
        "heads": {name: sum(p.numel() for p in head.parameters()) for name, head in heads.items() if head is not None},
        "backbone": backbone,
        "ratio": round((total + backbone) / backbone, 4),
    }
    print(json.dumps(result))


if __name__ == "__main__":
    main()
