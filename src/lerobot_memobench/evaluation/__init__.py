"""Results of evaluations: log -> metrics -> comparison -> documents.

`records` reads evaluations, `metrics` counts. `comparison` pairs two evaluations and tests their difference
(`statistics`); `controls` and `evidence` are controls of memory. `tables` defines tables and their formats, `report`
assembles them after a first line of `headline`; `plots` draws, `html` writes the page for the browser.
"""
