"""What did a policy learn, and what do the tasks ask of it?

Rooms, each importing only from those before it: `metrics` (rollouts to rates), `records` (evaluations read back),
`documents` (tables, reports, figures, the page for the browser), and three studies that do not know one another:
`comparison` of evaluations, `agreement` of annotators, `necessity` of a memory.
"""
