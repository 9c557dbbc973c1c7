"""How are results written down?

`tables` is what a report is made of: cells, tables, sections. What stands in it: `evaluation_tables` and `sentences` of
one evaluation, `wide_tables` and `replan_sweep` of several, `beside_paper`. What it is written as: `terminal`,
`markdown`, `latex`, gathered in `formats`; `report_json` and `report_csv` for programs. `report` puts them together.
`figures` are those of a paper, `html` is the page for the browser.
"""
