"""Check submitted results and compute the rows of the board.

`submission` reads the files of a row as untrusted data; `check` applies the rules of `lerobot_memobench.board.rules`
and searches for invented, edited and copied results; `page` computes the rows and writes their table.
"""
