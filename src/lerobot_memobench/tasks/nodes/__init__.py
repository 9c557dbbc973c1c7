"""What does each operator mean over time? One node per place in a formula's tree, with what it remembers.

``docs/formulas.md`` has the same on one page.
"""
