"""Measure time and memory of the full-size policy on a GPU, part by part.

    python benchmarks/gpu.py --out outputs/gpu.jsonl            # one 80 GB card, under eight minutes
    python benchmarks/gpu.py --size tiny --device cpu --out …   # a trial of the script

Needs no weights, dataset or network. Weights and batches are random; the batches have the preprocessor's shapes: two
cameras, 32 memory frames, prompts of 200 tokens, chunks of 50 actions. Each part appends a JSON line to ``--out``, and
parts with a line are skipped, so an interrupted run can be repeated. A failed part logs its error, and the next part
starts. Prints a table of all lines.
"""

from __future__ import annotations

import argparse
import gc
import json
import statistics
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import torch
from policies import MEMORY_FRAMES, config, observation, training_batch
from random_weights import random_policy
from torch import Tensor
from torch.nn.parallel import DistributedDataParallel

from lerobot_memobench.policies.memobench_mem import losses
from lerobot_memobench.policies.memobench_mem.modeling_memobench_mem import MemobenchMemPolicy
from lerobot_memobench.training.loop import WeightAverage

WARM_UP, BATCH = 3, 16
Part = Callable[[str, str, int], dict[str, Any]]


def main() -> None:
    """Measure the missing parts and print all."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--size", default="pi05")
    parser.add_argument("--device", default="cuda")
    parser.add_argument("--out", type=Path, default=Path("outputs/gpu.jsonl"))
    parser.add_argument("--parts", nargs="+", choices=list(PARTS), default=list(PARTS))
    parser.add_argument("--steps", type=int, default=10, help="timed plans or updates per part")
    parser.add_argument("--minutes", type=float, default=8.0, help="start no part after this time")
    args = parser.parse_args()
    torch.backends.cuda.matmul.allow_tf32 = True  # as LeRobot trains and evaluates
    args.out.parent.mkdir(parents=True, exist_ok=True)
    context = {"size": args.size, "device": args.device, "torch": torch.__version__}
    context["card"] = torch.cuda.get_device_name() if args.device == "cuda" else "CPU"
    began = time.monotonic()
    for part in args.parts:
        done = [line["part"] for line in lines(args.out) if line["size"] == args.size and "error" not in line]
        if part in done or time.monotonic() - began > 60 * args.minutes:
            continue
        started = time.monotonic()
        try:
            result = PARTS[part](args.size, args.device, args.steps)
        except Exception as error:  # the next part may succeed
            result = {"error": f"{type(error).__name__}: {str(error)[:300]}"}
        line = {"part": part, **context, **result, "took_s": round(time.monotonic() - started, 1)}
        with args.out.open("a", encoding="utf-8") as file:
            print(json.dumps(line), file=file)
        print(json.dumps(line), flush=True)
        gc.collect()
        if torch.cuda.is_available():
            torch.cuda.empty_cache()
    table([line for line in lines(args.out) if line["size"] == args.size])


def lines(file: Path) -> list[dict[str, Any]]:
    """Return the lines of earlier runs, without a truncated last line."""
    parsed = []
    for line in file.read_text(encoding="utf-8").splitlines() if file.exists() else []:
        try:
            parsed.append(json.loads(line))
        except ValueError:
            continue
    return parsed


# -- parts ------------------------------------------------------------------------------------------------------------


def equal(size: str, device: str, steps: int) -> dict[str, Any]:
    """Compare loss and actions of a tiny policy on the device and on the CPU, in float32."""
    results = []
    for place in ("cpu", device):
        torch.manual_seed(0)
        policy = random_policy(config("tiny", device="cpu"))
        for modulator in policy.model.modulators:
            modulator.modulation.reset_parameters()  # not zero, so that actions depend on the memory
        policy.config.device = place
        policy = policy.to(place).eval()
        batch = {key: value.to(place) for key, value in training_batch(policy.config, 2).items()}
        noise = torch.randn(2, policy.config.chunk_size, 32, generator=torch.Generator().manual_seed(1))
        actions = policy.predict_action_chunk(batch, noise=noise).float().cpu()
        torch.manual_seed(2)
        losses.sample_noise = cpu_noise  # a GPU generates different random numbers
        loss, _ = policy.forward(batch)
        results.append((actions, loss.item()))
    (actions, loss), (device_actions, device_loss) = results
    return {
        "largest_difference": float((actions - device_actions).abs().max()),
        "largest_action": float(actions.abs().max()),
        "loss_difference": abs(loss - device_loss),
    }


def cpu_noise(shape: tuple[int, ...], device: torch.device) -> Tensor:
    """Return noise that does not depend on the device."""
    return torch.randn(shape).to(device)


def planning(rows: int, change: Callable[[Any], None] = lambda model: None, **fields: Any) -> Part:
    """Return the part that fills the memories of ``rows`` environments, then times frames and plans.

    ``frame_ms`` is of a frame encoded alone, ``frames_ms`` of `MEMORY_FRAMES` encoded together. ``change`` is made to
    the model first; ``changed_by`` is its effect on the actions, as a share of the largest one.
    """

    def part(size: str, device: str, steps: int) -> dict[str, Any]:
        torch.manual_seed(0)
        dtype = "float32" if device == "cpu" else "bfloat16"  # which a CPU emulates
        policy = random_policy(config(size, device=device, dtype=dtype, **fields)).eval()
        batch = {key: value.to(device) for key, value in observation(policy.config, rows).items()}
        noise = torch.randn(rows, policy.config.chunk_size, policy.config.max_action_dim)

        def observe(frames: int) -> None:
            for _ in range(frames):
                policy.observe(batch)
            policy.write_kept()

        def plan() -> Tensor:
            with torch.no_grad():
                return policy.plan(batch, [*range(rows)], noise)

        started = time.perf_counter()
        observe(MEMORY_FRAMES)
        unchanged = plan()
        first = time.perf_counter() - started
        change(policy.model)
        effect = (plan() - unchanged).abs().max() / unchanged.abs().max()
        peak()
        parts = {"plan_ms": plan, "frame_ms": lambda: observe(1), "frames_ms": lambda: observe(MEMORY_FRAMES)}
        seconds: dict[str, list[float]] = {name: [] for name in parts}
        for _ in range(steps + WARM_UP):
            for name, call in parts.items():
                seconds[name].append(timed(call))
        median = {name: round(1e3 * statistics.median(taken[WARM_UP:]), 2) for name, taken in seconds.items()}
        return {**median, "changed_by": round(float(effect), 6), "first_s": round(first, 1), "peak_gib": peak()}

    return part


def compile_denoising(model: Any) -> None:
    """Compile a step of denoising; on a GPU it is captured in a CUDA graph."""
    on_gpu: dict[str, Any] = {"mode": "reduce-overhead"}
    options = on_gpu if next(model.parameters()).is_cuda else {"backend": "aot_eager"}  # without a compiler of C++
    model.velocity = torch.compile(model.velocity, fullgraph=True, **options)


def narrow_tower(model: Any) -> None:
    """Let the image tower compute in bfloat16."""
    perception = model.paligemma_with_expert.perception
    narrow = torch.bfloat16

    def prefix(observed: Tensor) -> Tensor:
        states = perception.tower.to(narrow)(observed.to(narrow)).last_hidden_state
        return perception.projector.to(narrow)(states).to(observed.dtype)  # type: ignore[no-any-return]

    perception.prefix = prefix


def updating(ddp: bool, **fields: Any) -> Part:
    """Return the part that times updates on batches of 16, as in `config=train_paper`."""

    def part(size: str, device: str, steps: int) -> dict[str, Any]:
        settings = config(size, device=device, dtype="bfloat16", gradient_checkpointing=True, **fields)
        policy = random_policy(settings).train()
        optimizer = settings.get_optimizer_preset().build(policy.get_optim_params())
        module: Any = policy
        if ddp:
            backend = "nccl" if device == "cuda" else "gloo"
            place = "tcp://127.0.0.1:29511"
            torch.distributed.init_process_group(backend, init_method=place, rank=0, world_size=1)
            module = DistributedDataParallel(policy, find_unused_parameters=True)
        batch = {key: value.to(device) for key, value in training_batch(settings, BATCH).items()}
        try:
            average = WeightAverage(policy.trained_parameters(), policy.config.ema_decay)
            seconds = [timed(update, module, policy, optimizer, average, batch) for _ in range(steps + WARM_UP)]
        finally:
            if ddp:
                torch.distributed.destroy_process_group()
        return {"update_s": round(statistics.median(seconds[WARM_UP:]), 3), "peak_gib": peak()}

    return part


def update(
    module: Any, policy: MemobenchMemPolicy, optimizer: Any, average: WeightAverage, batch: Mapping[str, Tensor]
) -> None:
    """Make one update, as training does."""
    loss, _ = module(batch)
    loss.backward()
    torch.nn.utils.clip_grad_norm_(policy.parameters(), policy.config.optimizer_grad_clip_norm)
    optimizer.step()
    optimizer.zero_grad()
    average.update()


PARTS: dict[str, Part] = {
    "equal": equal,
    "plan": planning(1),
    "plan, 8 environments": planning(8),
    "plan, no memory": planning(1, memory="none"),
    "plan, compiled": planning(1, compile_denoising),
    "plan, bfloat16 tower": planning(1, narrow_tower),
    "update": updating(ddp=False),
    "update, DDP of one": updating(ddp=True),
}


# -- measuring --------------------------------------------------------------------------------------------------------


def timed(function: Callable[..., Any], *args: Any) -> float:
    """Return the seconds of a call, with its work on the GPU."""
    synchronise()
    started = time.perf_counter()
    function(*args)
    synchronise()
    return time.perf_counter() - started


def synchronise() -> None:
    """Wait for the GPU."""
    if torch.cuda.is_available():
        torch.cuda.synchronize()


def peak() -> float:
    """Return the peak allocated GPU memory since the last call, GiB."""
    synchronise()
    gib = torch.cuda.max_memory_allocated() / 2**30
    if torch.cuda.is_available():
        torch.cuda.reset_peak_memory_stats()
    return round(gib, 2)


def table(measured: list[dict[str, Any]]) -> None:
    """Print all parts as a Markdown table."""
    names = list(dict.fromkeys(name for line in measured for name in line if name not in ("size", "device", "torch")))
    for cells in (names, ["---"] * len(names), *([str(line.get(name, "")) for name in names] for line in measured)):
        print(f"| {' | '.join(cells)} |")


if __name__ == "__main__":
    main()
