"""Write a submission for the board of results, and check the rules that an honest evaluation may break.

`submission` defines and writes the files of a row and the text of its pull request; `rules` checks settings, extent and
versions. ``tools/board`` in the repository checks submissions of others.
"""
