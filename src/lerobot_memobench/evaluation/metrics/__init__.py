"""From rollouts to rates and failures.

`rollouts` says what one did, `rates` counts it (SR, MSR, MUR, MCR and their intervals), `failures` names what went
wrong, `summary` holds all figures of a set of rollouts and ``report.json``.
"""
