"""Results of evaluations: log -> metrics -> comparison -> documents.

`records` reads evaluations, `metrics` counts. `comparison` pairs two evaluations and tests their difference
(`statistics`); `controls` and `evidence` are controls of memory. `tables` defines tables and their formats,
`report_tables` the tables of a report, `report` assembles it; `plots` draws, `html` is the page for the browser.
"""
