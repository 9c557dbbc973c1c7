"""A small Hugging Face hub: what huggingface_hub, datasets and LeRobot ask of one to write, load and stream files.

In memory, for one repository per name (dataset, model or space), with commits, tags, LFS and byte ranges. Writing needs
the token ``TOKEN``.
"""

from __future__ import annotations

import base64
import hashlib
import json
import re
import threading
from collections.abc import Callable
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from urllib.parse import unquote, urlsplit

TOKEN = "hf_of_the_test"


class LocalServer(ThreadingHTTPServer):
    """A server of this machine that answers from its construction on."""

    daemon_threads = True

    def __init__(self, handler: Callable[..., BaseHTTPRequestHandler]) -> None:
        super().__init__(("127.0.0.1", 0), handler)
        threading.Thread(target=self.serve_forever, daemon=True).start()

    def __exit__(self, *_: object) -> None:
        self.shutdown()
        self.server_close()

    @property
    def address(self) -> str:
        return f"http://127.0.0.1:{self.server_port}"


class Hub(LocalServer):
    def __init__(self) -> None:
        self.clear()
        super().__init__(Handler)

    def clear(self) -> None:
        """Forget all that was written and asked."""
        self.repos: dict[str, dict[str, bytes]] = {}
        self.kinds: dict[str, str] = {}
        self.large: dict[str, set[str]] = {}
        self.tags: dict[str, dict[str, str]] = {}
        self.blobs: dict[str, bytes] = {}
        self.requests: list[str] = []

    def commit_of(self, repo: str) -> str:
        names = sorted((name, hashlib.sha1(data).hexdigest()) for name, data in self.repos[repo].items())
        return hashlib.sha1(json.dumps(names).encode()).hexdigest()


class Handler(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"
    server: Hub

    def log_message(self, *_: object) -> None:
        pass

    def handle_one(self) -> None:
        body = self.rfile.read(int(self.headers.get("Content-Length") or 0))
        path = unquote(urlsplit(self.path).path)
        self.server.requests.append(f"{self.command} {path}")
        writing = self.command in ("POST", "PUT", "DELETE") and "paths-info" not in path and "/lfs/" not in path
        if writing and self.headers.get("Authorization") != f"Bearer {TOKEN}":
            return self.answer(401, {"error": "Invalid username or password."})
        for pattern, handler in ROUTES:
            found = re.fullmatch(pattern, f"{self.command} {path}")
            if found:
                words = found.groupdict()
                repo, kind = words.get("repo"), (words.pop("kind", None) or MODELS).strip("/")
                if repo is not None and (repo not in self.server.repos or kind != self.server.kinds.get(repo, kind)):
                    return self.answer(404, {"error": "no such repository"}, {"X-Error-Code": "RepoNotFound"})
                return handler(self, body, **words)
        return self.answer(404, {"error": f"{self.command} {path} is not known"})

    do_GET = do_HEAD = do_POST = do_PUT = do_DELETE = handle_one

    def answer(self, status: int, content: object = None, headers: dict[str, str] | None = None) -> None:
        data = content if isinstance(content, bytes) else json.dumps(content).encode()
        headers = {"Content-Length": str(len(data)), **(headers or {})}
        self.send_response(status)
        for name, value in headers.items():
            self.send_header(name, value)
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(data)

    # --- writing ---

    def create(self, body: bytes) -> None:
        asked = json.loads(body)
        repo, kind = f"{asked.get('organization') or 'somebody'}/{asked['name']}", f"{asked.get('type') or 'model'}s"
        url = {"url": f"{self.server.address}/{'' if kind == MODELS else kind + '/'}{repo}"}
        if repo in self.server.repos:
            return self.answer(409, url)
        self.server.repos[repo], self.server.large[repo], self.server.tags[repo] = {}, set(), {}
        self.server.kinds[repo] = kind
        return self.answer(200, url)

    def validate_yaml(self, body: bytes) -> None:
        self.answer(200, {"errors": [], "warnings": []})

    def preupload(self, body: bytes, repo: str, revision: str) -> None:
        def mode(name: str) -> str:
            return "lfs" if name.endswith((".parquet", ".mp4", ".hdf5", ".safetensors")) else "regular"

        asked = json.loads(body)
        ignored = tuple(line.strip("/") + "/" for line in asked.get("gitIgnore", "").split())  # of folders at the top
        known = [
            {"path": f["path"], "uploadMode": mode(f["path"]), "shouldIgnore": f["path"].startswith(ignored)}
            for f in asked["files"]
        ]
        self.answer(200, {"files": known})

    def batch(self, body: bytes, repo: str) -> None:
        objects = []
        for asked in json.loads(body)["objects"]:
            entry = dict(asked)
            if asked["oid"] not in self.server.blobs:
                entry["actions"] = {"upload": {"href": f"{self.server.address}/lfs/{asked['oid']}"}}
            objects.append(entry)
        self.answer(200, {"transfer": "basic", "objects": objects})

    def put_blob(self, body: bytes, oid: str) -> None:
        if hashlib.sha256(body).hexdigest() != oid:
            return self.answer(400, {"error": "wrong hash"})
        self.server.blobs[oid] = body
        return self.answer(200, {})

    def commit(self, body: bytes, repo: str, revision: str) -> None:
        for line in body.splitlines():
            operation = json.loads(line)
            value = operation["value"]
            if operation["key"] == "file":
                self.server.repos[repo][value["path"]] = base64.b64decode(value["content"])
            elif operation["key"] == "lfsFile":
                self.server.repos[repo][value["path"]] = self.server.blobs[value["oid"]]
                self.server.large[repo].add(value["path"])
            elif operation["key"] == "deletedFile":
                del self.server.repos[repo][value["path"]]
                self.server.large[repo].discard(value["path"])
        oid = self.server.commit_of(repo)
        self.answer(200, {"commitUrl": f"{self.server.address}/datasets/{repo}/commit/{oid}", "commitOid": oid})

    def add_tag(self, body: bytes, repo: str, revision: str) -> None:
        self.server.tags[repo][json.loads(body)["tag"]] = self.server.commit_of(repo)
        self.answer(200, {})

    def delete_tag(self, body: bytes, repo: str, revision: str) -> None:
        if self.server.tags[repo].pop(revision, None) is None:
            return self.answer(404, {"error": "no such tag"}, {"X-Error-Code": "RevisionNotFound"})
        return self.answer(200, {})

    # --- reading ---

    def refs(self, body: bytes, repo: str) -> None:
        tags = [
            {"name": name, "ref": f"refs/tags/{name}", "targetCommit": oid}
            for name, oid in self.server.tags[repo].items()
        ]
        main = {"name": "main", "ref": "refs/heads/main", "targetCommit": self.server.commit_of(repo)}
        self.answer(200, {"branches": [main], "tags": tags, "converts": []})

    def info(self, body: bytes, repo: str, revision: str = "main") -> None:
        if revision not in ("main", self.server.commit_of(repo), *self.server.tags[repo]):
            return self.answer(404, {"error": "no such revision"}, {"X-Error-Code": "RevisionNotFound"})
        siblings = [{"rfilename": name} for name in sorted(self.server.repos[repo])]
        sha = self.server.commit_of(repo)
        common = {"tags": [], "private": False, "downloads": 0, "likes": 0, "lastModified": "2026-01-01T00:00:00.000Z"}
        return self.answer(200, {"id": repo, "sha": sha, "siblings": siblings, **common})

    def entry(self, repo: str, name: str) -> dict[str, object]:
        data = self.server.repos[repo][name]
        oid = hashlib.sha1(data).hexdigest()
        found: dict[str, object] = {"type": "file", "oid": oid, "size": len(data), "path": name}
        if name in self.server.large[repo]:
            found["lfs"] = {"oid": hashlib.sha256(data).hexdigest(), "size": len(data), "pointerSize": 130}
        return found

    def tree(self, body: bytes, repo: str, revision: str, path: str | None) -> None:
        prefix = f"{path}/" if path else ""
        names = [name for name in sorted(self.server.repos[repo]) if name.startswith(prefix)]
        if prefix and not names:
            return self.answer(404, {"error": "no such folder"}, {"X-Error-Code": "EntryNotFound"})
        folders = sorted(
            {prefix + name[len(prefix) :].rsplit("/", 1)[0] for name in names if "/" in name[len(prefix) :]}
        )
        entries = [{"type": "directory", "oid": "0" * 40, "size": 0, "path": folder} for folder in folders]
        entries += [self.entry(repo, name) for name in names]
        if "recursive=true" not in self.path.lower():
            entries = [entry for entry in entries if "/" not in str(entry["path"])[len(prefix) :]]
            tops = sorted({prefix + name[len(prefix) :].split("/")[0] for name in names if "/" in name[len(prefix) :]})
            there = {entry["path"] for entry in entries}
            entries += [
                {"type": "directory", "oid": "0" * 40, "size": 0, "path": top} for top in tops if top not in there
            ]
        return self.answer(200, entries)

    def paths_info(self, body: bytes, repo: str, revision: str) -> None:
        asked = json.loads(body)["paths"] if body.startswith(b"{") else re.findall(r"paths=([^&]*)", body.decode())
        entries = []
        for path in map(unquote, asked):
            if path in self.server.repos[repo]:
                entries.append(self.entry(repo, path))
            elif any(name.startswith(f"{path}/") for name in self.server.repos[repo]):
                entries.append({"type": "directory", "oid": "0" * 40, "size": 0, "path": path})
        self.answer(200, entries)

    def resolve(self, body: bytes, repo: str, revision: str, path: str) -> None:
        data = self.server.repos[repo].get(path)
        if data is None:
            return self.answer(404, {"error": "no such file"}, {"X-Error-Code": "EntryNotFound"})
        headers = {
            "X-Repo-Commit": self.server.commit_of(repo),
            "ETag": f'"{hashlib.sha256(data).hexdigest()}"',
            "Accept-Ranges": "bytes",
        }
        found = re.fullmatch(r"bytes=(\d+)-(\d*)", self.headers.get("Range") or "")
        if not found:
            return self.answer(200, data, headers)
        start, stop = int(found[1]), min(int(found[2] or len(data) - 1), len(data) - 1)
        headers["Content-Range"] = f"bytes {start}-{stop}/{len(data)}"
        return self.answer(206, data[start : stop + 1], headers)


REPO = r"(?P<repo>[^/]+/[^/]+)"
REVISION = r"(?P<revision>[^/]+)"
MODELS = "models"
KIND = r"(?P<kind>datasets|models|spaces)"
PLACE = r"(?P<kind>datasets/|spaces/|)"
"""Before a repository's name in addresses of its files; a model has none."""
ROUTES = [
    (r"POST /api/repos/create", Handler.create),
    (r"POST /api/validate-yaml", Handler.validate_yaml),
    (rf"POST /api/{KIND}/{REPO}/preupload/{REVISION}", Handler.preupload),
    (rf"POST /{PLACE}{REPO}\.git/info/lfs/objects/batch", Handler.batch),
    (r"PUT /lfs/(?P<oid>\w+)", Handler.put_blob),
    (rf"POST /api/{KIND}/{REPO}/commit/{REVISION}", Handler.commit),
    (rf"POST /api/{KIND}/{REPO}/tag/{REVISION}", Handler.add_tag),
    (rf"DELETE /api/{KIND}/{REPO}/tag/{REVISION}", Handler.delete_tag),
    (rf"GET /api/{KIND}/{REPO}/refs", Handler.refs),
    (rf"GET /api/{KIND}/{REPO}", Handler.info),
    (rf"GET /api/{KIND}/{REPO}/revision/{REVISION}", Handler.info),
    (rf"GET /api/{KIND}/{REPO}/tree/{REVISION}(/(?P<path>.*))?", Handler.tree),
    (rf"POST /api/{KIND}/{REPO}/paths-info/{REVISION}", Handler.paths_info),
    (rf"(GET|HEAD) /{PLACE}{REPO}/resolve/{REVISION}/(?P<path>.*)", Handler.resolve),
]
