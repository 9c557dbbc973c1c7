"""What was run, read back from the folders of evaluations.

`protocol` says under which settings, `runs` holds rollouts, name and policy of each evaluation.
"""
