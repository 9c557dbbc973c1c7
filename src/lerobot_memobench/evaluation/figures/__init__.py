"""Figures of evaluations and of the paper's tables, in the style of a paper: one module per figure.

Each has a function ``draw`` that returns a matplotlib figure; ``style.save`` writes it as PDF and PNG.
"""
