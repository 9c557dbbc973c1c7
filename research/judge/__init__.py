"""Test the judge: near misses of every task and their verdicts."""
