"""Feature cache: what a memory policy would otherwise recompute for every sample, made once beside the dataset.

It holds the pooled tokens of the frozen vision tower for every ``stride``-th frame of one camera, the embedding of
every subgoal text, and per frame its phase and subgoal. Everything large is memory-mapped, so training gathers 32
frames of history without decoding a video (delta timestamps are fixed offsets and cannot say "spread over the episode
so far"). For a policy with eyes all tokens of every picture of a camera are a cache, too.
"""
