"""What was run, read back from the folders of evaluations."""
