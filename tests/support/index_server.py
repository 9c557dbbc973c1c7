"""A small package index on this machine: a static simple index (PEP 503), and the uploads of twine.

Writing needs the token of `hub_server`. A file that is there may be sent again; other content of its name is refused.
"""

from __future__ import annotations

import base64
from email import message_from_bytes
from functools import partial
from http.server import SimpleHTTPRequestHandler
from pathlib import Path

from tests.support.hub_server import TOKEN, LocalServer


class Index(LocalServer):
    def __init__(self, folder: Path) -> None:
        super().__init__(partial(Handler, directory=str(folder)))


class Handler(SimpleHTTPRequestHandler):
    def log_message(self, *_: object) -> None:
        pass

    def do_POST(self) -> None:
        body = self.rfile.read(int(self.headers["Content-Length"]))
        if self.headers.get("Authorization") != f"Basic {base64.b64encode(f'__token__:{TOKEN}'.encode()).decode()}":
            return self.send_error(403, "Invalid or non-existent authentication information")
        form = message_from_bytes(b"Content-Type: " + self.headers["Content-Type"].encode() + b"\r\n\r\n" + body)
        parts = {part.get_param("name", header="content-disposition"): part for part in form.get_payload()}
        name = parts["name"].get_payload().replace("_", "-")
        file, content = parts["content"].get_filename(), parts["content"].get_payload(decode=True)
        place = Path(self.directory, "simple", name, file)
        if place.exists() and place.read_bytes() != content:
            return self.send_error(400, "File already exists")
        place.parent.mkdir(parents=True, exist_ok=True)
        place.write_bytes(content)
        self.send_response(200)
        self.send_header("Content-Length", "0")
        return self.end_headers()
