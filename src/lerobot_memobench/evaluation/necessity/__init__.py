"""Which tasks need a memory, and how far can a policy come without one?

`question` is what is asked of a task, `study` answers it scene by scene (`pieces`: in several processes), `verdicts`
sums up, `report`, `twins` and `aliased_pairs` write the answers down. In the demonstrated order: `demonstrations`
photographs the expert's decisions from the execution's `starts` on, `scene` finds those that look the same (`pictures`,
with the arm at `home`), `aliasing` says how far a policy without memory comes. In any order: `exploration` tries all
answers in the `laboratory` and makes a `graph`, on which `best_map` and `best_probabilities` are looked for;
`any_order` puts these together.
"""
