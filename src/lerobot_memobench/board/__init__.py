"""The board of results: submissions as files, their check, rows of the board, and exports for other boards.

`submission` defines the files of a row and reads them as untrusted data; `check` holds the rules; `rows` computes the
figures of a row; `exports` writes a result in the formats of other tools. ``python -m lerobot_memobench.board`` is the
check of continuous integration.
"""
