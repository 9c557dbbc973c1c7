"""What is in a picture? A small tower that sees the benchmark's things, trained on the simulator's own labels.

`tower` makes tokens of pictures and `weights` keeps it; both need torch alone, so that policies can look through it.
`heads` say in the tokens' words what is where, `finding` reads that off. `labels` are what a picture shows by the
simulator, `walk` and `scatter` make the moments, `pictures` keeps both; `targets` and `training` teach, `testing` and
`report` say how well it sees.
"""
