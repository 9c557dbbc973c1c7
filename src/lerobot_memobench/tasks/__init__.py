"""What is the benchmark? Tasks, checkpoints, formulas and the catalogue. No simulator, no torch."""
