"""Policies without a memory on strict tasks.

`adversaries` tries to exceed the ceilings, `clock` computes ceilings with a clock, `limits` uses the limits of the
strict suite.
"""
