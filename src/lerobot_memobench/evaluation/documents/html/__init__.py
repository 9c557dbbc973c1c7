"""The report that a person opens in a browser: one folder, no server, no network.

``collect`` turns logs into what the page shows, ``videos`` finds and places the films, ``page`` assembles
``index.html`` from the template beside it, ``write`` makes the folder.
"""

from lerobot_memobench.evaluation.documents.html.write import PAGE, write_html

__all__ = ["PAGE", "write_html"]
