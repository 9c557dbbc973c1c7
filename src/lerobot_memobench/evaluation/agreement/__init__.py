"""Do annotators agree on the operation of a checkpoint?

`label_sheet` reads what raters filled in, `study` computes its figures with the statistics of `kappa`, `report` writes
them down; `published` recomputes the paper's from what it publishes.
"""
