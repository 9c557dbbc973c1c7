"""The report that a person opens in a browser: one folder, no server, no network.

`data` turns logs into what the page shows; `write` finds and places the videos, assembles ``index.html`` from the
template beside it, and makes the folder.
"""
