"""Regression nets of a redesign: facts of the benchmark, recorded once and compared after each step (`__main__`).

Each module holds one net. It uses commands, gymnasium ids, LeRobot's functions and written files; `access` has the
exceptions.
"""
