"""Feature cache: frozen features that a memory policy would recompute for every sample, made once beside the dataset.

It holds the pooled tokens of the frozen visual encoder for every ``stride``-th frame of one camera, the embedding of
every subgoal text, and per frame its phase and subgoal. Everything large is memory-mapped, so training gathers 32
frames of history without decoding a video (delta timestamps are fixed offsets and cannot say "spread over the episode
so far"). For a policy that reads pictures through the encoder, all tokens of every picture are a cache, too.
"""
