"""Which of two evaluations is better, and what do the paper's controls tell?

`pairing` finds the episodes that two evaluations share. `differences` compares them with the tests of `paired_tests`;
`differences_report` writes that down. The controls are `oracle_memory`, `shuffled_memory` and `granularity`, each with
its report; `estimates` and `control_tables` are what they share.
"""
