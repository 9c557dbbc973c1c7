"""Write a submission for the board of results, and check the rules that an honest evaluation may break.

`submission` defines and writes the files of a row; `rules` checks settings, extent and versions; `pull_request` writes
the text of a pull request. ``tools/board`` in the repository checks submissions of others.
"""
