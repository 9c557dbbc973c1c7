"""Check the memory of a policy: equal in training and in rollouts, and separate for each row of a batch.

`checks` defines the checks, `subject` drives a policy, `streams` makes observations, `pytest_class` is a test class for
other packages. A policy is driven through LeRobot's interface alone, so its memory may be of any kind.
"""
