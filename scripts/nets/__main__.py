"""Record facts of the benchmark before a redesign, and compare them after each of its steps.

    python -m scripts.nets record  [--net NAME]... [--only TEXT] [--out FILE]
    python -m scripts.nets compare [--net NAME]... [--only TEXT] [--out FILE]
    python -m scripts.nets mutants [MUTANT]...

`compare` ends with status 1 if a fact differs from the record; ``--only`` runs the parts whose name contains a text.
Parts that have run on the same sources are not run again; delete ``outputs/nets`` to repeat them, and if a net changes.
`mutants` applies each patch of `mutants` in a copy, and names the net that notices it.
"""

import argparse
import json
import os
import subprocess
import sys
from importlib import import_module
from pathlib import Path

from scripts.nets import store

NETS = ("commands", "actions", "logs", "weights", "executions", "starts")
ENVIRONMENT = {
    **{"HF_HUB_OFFLINE": "1", "MEMOBENCH_PROMPT_CACHE": "off", "COLUMNS": "400", "NO_COLOR": "1"},
    **{"OMP_NUM_THREADS": "1", "MKL_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "CUDA_VISIBLE_DEVICES": ""},
    **{"OPENBLAS_CORETYPE": "Nehalem", "NPY_DISABLE_CPU_FEATURES": "AVX2 FMA3"},  # kernels of any processor
}


def run_net(net: str, only: str = "") -> store.Facts:
    """Run a net in a process of its own; return its facts."""
    command = [sys.executable, "-m", "scripts.nets", "run", "--net", net, "--only", only]
    paths = os.pathsep.join(map(str, (store.ROOT / "src", store.ROOT)))
    subprocess.run(command, cwd=store.ROOT, env={**os.environ, **ENVIRONMENT, "PYTHONPATH": paths}, check=True)
    names = (name for name in parts_of(net) if only in name)
    files = (store.part_file(store.work_folder(net), name) for name in names)
    return {subject: facts for file in files for subject, facts in json.loads(file.read_text()).items()}


def parts_of(net: str) -> store.Parts:
    """Return the parts of a net."""
    parts: store.Parts = import_module(f"scripts.nets.{net}").parts()
    return parts


def compare(net: str, only: str, file: Path) -> int:
    """Compare a net with the record and print the differences; return 1 if there are some."""
    recorded, found = store.read_record(file)[net], run_net(net, only)
    old = {subject: facts for subject, facts in recorded["facts"].items() if subject in found or not only}
    same = recorded["machine"] == store.machine()
    lines = store.differences(old, found, same)
    facts = sum(map(len, found.values()))
    print(f"{net}: {'changed' if lines else 'equal'}, {facts} facts{'' if same else ', another machine'}")
    print("".join(f"    {line}\n" for line in lines), end="", flush=True)
    return int(bool(lines))


def main() -> int:
    """Run the command line; return the exit status."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("action", choices=("record", "compare", "mutants", "run"))
    parser.add_argument("mutant", nargs="*")
    parser.add_argument("--net", action="append", choices=NETS, help="default: all")
    parser.add_argument("--only", default="", metavar="TEXT")
    parser.add_argument("--out", type=Path, default=store.RECORD, metavar="FILE", help="the record")
    args = parser.parse_args()
    nets = args.net or NETS
    match args.action:
        case "run":
            store.run_parts(parts_of(nets[0]), store.work_folder(nets[0]), args.only)
        case "record":
            for net in nets:
                kept = store.read_record(args.out).get(net, {}).get("facts", {}) if args.only else {}
                store.write_record(net, kept | run_net(net, args.only), args.out)
                print(f"{net}: recorded; {args.out.stat().st_size // 1024} KiB", flush=True)
        case "compare":
            return max([compare(net, args.only, args.out) for net in nets])
        case "mutants":
            from scripts.nets.mutants import report

            return report(args.mutant)
    return 0


if __name__ == "__main__":
    sys.exit(main())
