"""Figures of evaluations and of the paper's tables, in the style of a paper; `style.save` writes PDF and PNG."""
