"""What a policy has learned, and how that is written down: log -> metrics -> comparison, controls -> documents.

`records` reads evaluations, `metrics` counts. `comparison` pairs two evaluations and tests their difference
(`statistics`); `controls` and `memory_controls` are the paper's controls. `tables` is what a report is made of and its
formats, `report_tables` what stands in it, `report` puts it together; `figures` are those of the paper, `html` is the
page for the browser.
"""
