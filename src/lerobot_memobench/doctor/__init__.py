"""Check whether this machine can run the benchmark, and suggest fixes."""
