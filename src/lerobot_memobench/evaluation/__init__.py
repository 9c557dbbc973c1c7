"""Results of evaluations: log -> metrics -> comparison -> documents.

`records` reads evaluations and writes their headline, `metrics` counts. `comparison` pairs two evaluations, also as a
control of memory, and `statistics` tests their contrasts; `evidence` is a control within one evaluation. `tables`
defines tables and their formats, `report` assembles them; `plots` draws, `html` writes the page for the browser.
"""
