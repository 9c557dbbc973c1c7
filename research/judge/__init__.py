"""Test the judge: near misses of every task, their verdicts, and mutants of the code that gives them."""
