"""Tasks, checkpoints, formulas and the catalogue, without simulator and torch."""
