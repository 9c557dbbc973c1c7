"""``index.html``: the template beside this module with style, script and data put in.

Everything is inside the page, because a browser lets a page from disk read no other file. Its content security policy
allows this style, this script and videos from its own place, and nothing else: the page cannot reach the network.
"""

from __future__ import annotations

import base64
import hashlib
import json
import re
from collections.abc import Mapping
from html import escape
from importlib import resources
from typing import Any

TEMPLATE, STYLE = "index.html", "style.css"
SCRIPTS = ("dom", "address", "filter", "overview", "list", "lanes", "timeline", "player", "panel", "detail", "main")
"""Parts of the one script, in ``script/``; a later part uses earlier ones."""
MARK = "memobench html"
"""What the page's ``generator`` says; by it a folder is known as a report."""


def page(data: Mapping[str, Any], title: str) -> str:
    """Return the page that shows ``data`` (see ``collect.page_data``)."""
    style, script = _read(STYLE), _script()
    parts = {
        "title": escape(title),
        "generator": escape(f"{MARK} {data['version']}"),
        "policy": escape(content_policy(style, script)),
        "style": style,
        "script": script,
        "data": inline_json(data),
    }
    # In one pass, so that what is put in is never taken for a place to put something.
    return re.sub(r"\{\{(\w+)\}\}", lambda found: parts[found[1]], _read(TEMPLATE))


def inline_json(value: Any) -> str:
    """Return JSON that may stand inside ``<script type="application/json">``.

    Nothing in it can end the element or open a comment: ``<``, ``>`` and ``&`` are written as escapes.
    """
    text = json.dumps(value, ensure_ascii=False, separators=(",", ":"), allow_nan=False)
    return text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")


def content_policy(style: str, script: str) -> str:
    """Return the content security policy for a page with this style and this script."""
    return f"default-src 'none'; style-src {_hash(style)}; script-src {_hash(script)}; media-src 'self'; img-src data:"


def _script() -> str:
    """The parts as one script, in a scope of its own."""
    data = 'const DATA = JSON.parse(document.getElementById("data").textContent);\n'
    parts = [_read(f"script/{name}.js") for name in SCRIPTS]
    return '"use strict";\n(() => {\n' + data + "\n".join(parts) + "})();\n"


def _hash(text: str) -> str:
    return f"'sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}'"


def _read(name: str) -> str:
    return resources.files(__package__).joinpath(name).read_text(encoding="utf-8")
