"""Whether a policy remembers as it should: the same in training as in a rollout, each row by itself.

`checks` says what is asked, `subject` drives a policy, `streams` makes what it observes, `pytest_class` asks within
somebody's own tests. A policy is asked through LeRobot's interface alone, so any kind of memory can be.
"""
