"""`ihbench view`: the site of some runs served to this machine alone, made anew when a run has finished; what runs do
that are not done is told every few seconds."""

from __future__ import annotations

import json
import math
import threading
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

from ihbench.errors import BadInput
from ihbench.metrics.identity import Identity
from ihbench.record.results import RunResult
from ihbench.reports.site.page import Site, policy
from ihbench.reports.site.tables import curve_json

HOST = "127.0.0.1"
EVERY = 3.0  # s between two looks at the run folders
NOTHING = "default-src 'none'"
KINDS = {".webp": "image/webp", ".png": "image/png"}

Read = Callable[[], tuple[list[RunResult], list[str]]]
Make = Callable[[Sequence[RunResult], Sequence[str], bool], Site]  # the last: with pictures and avatars


@dataclass
class Followed:
    """The site of what `read` gives, followed by one thread. First come the numbers alone, then the pictures."""

    read: Read
    make: Make
    site: Site | None = None
    version: int = 0
    results: list[RunResult] = field(default_factory=list)
    fault: str = ""
    _done: tuple[str, ...] | None = None
    _left_out: list[str] = field(default_factory=list)
    _read_at: float = -math.inf  # on the monotonic clock
    _reading: threading.Lock = field(default_factory=threading.Lock)

    def follow(self, stop: threading.Event) -> None:
        """Until `stop`."""
        while not stop.is_set():
            self.look()
            stop.wait(EVERY)

    def look(self) -> None:
        """Read the folders; make the site anew where other runs are there, or others are done."""
        if not self._refresh(0.0):
            return
        results, left_out = self.results, self._left_out
        done = tuple(sorted(f"{run.folder} {run.status} {_updated(run)}" for run in results))
        if done == self._done:
            return
        try:
            if self.site is None:
                self._show(self.make(results, left_out, False))
            self._show(self.make(results, left_out, True))
            self._done = done
        except (BadInput, OSError) as error:  # a folder that is being moved: the next look may find it whole
            self.fault = str(error)

    def _refresh(self, after: float) -> bool:
        """Read the folders unless that was done within `after` s; whether they could be read."""
        with self._reading:
            if time.monotonic() - self._read_at >= after:
                try:
                    self.results, self._left_out = self.read()
                    self.fault = ""
                except (BadInput, OSError) as error:
                    self.fault = str(error)
                self._read_at = time.monotonic()
            return not self.fault

    def _show(self, site: Site) -> None:
        self.site, self.version = site, self.version + 1

    def state(self) -> dict[str, Any]:
        """What a page asks for: the site's version, and how far runs have come that are not done. While the site is
        being made, too, which may take minutes."""
        self._refresh(EVERY)
        return {
            "version": self.version,
            "fault": self.fault,
            "runs": [_progress(run) for run in self.results if not ended(run)],
        }


def _updated(run: RunResult) -> str:
    """When a run that has ended did."""
    return f"{run.record.outcome.updated}" if ended(run) else ""


def ended(run: RunResult) -> bool:
    return run.status != "running"


def _progress(run: RunResult) -> dict[str, Any]:
    last = run.curve[-1] if run.curve else None
    words = ""
    if last is not None:
        first = _headline(run, list(last.scores))
        words = f"step {last.step}, {last.seconds:.0f} s of fitting"
        if first is not None:
            words += f", {first.display.head(first.region)} {first.display.text(float(last.scores[first]))}"
    return {
        "name": run.folder.name,
        "words": f"{run.method} on {run.scene}, seed {run.seed}: {run.status}{f', {words}' if words else ''}",
        "curve": curve_json(run),
    }


def _headline(run: RunResult, identities: Sequence[Identity]) -> Identity | None:
    own = [i for i in identities if i.region == run.headline] or list(identities)
    return own[0] if own else None


def serve_followed(followed: Followed, port: int, say: Callable[[str], None]) -> None:
    """Serve on the loopback address until interrupted. Raises `BadInput` for a port that cannot be had."""
    try:
        server = ThreadingHTTPServer((HOST, port), handler(followed))
    except OSError as error:
        raise BadInput(f"--port {port}: {error.strerror}; name another, or 0 for any that is free") from error
    stop = threading.Event()
    worker = threading.Thread(target=followed.follow, args=(stop,), daemon=True)
    worker.start()
    here = own_port(server)
    say(f"http://{HOST}:{here}/  (from elsewhere: ssh -L {here}:{HOST}:{here} THIS_MACHINE; Ctrl-C ends it)")
    try:
        server.serve_forever(poll_interval=0.2)
    finally:
        stop.set()
        server.server_close()


def own_port(server: Any) -> int:
    return int(server.server_address[1])


def handler(followed: Followed) -> type[BaseHTTPRequestHandler]:
    """Answers of a server of this site: the page, its pictures by their names, and the state. Nothing else is read,
    and nothing for a request that was not meant for this machine (a foreign name that points here)."""

    class Answer(BaseHTTPRequestHandler):
        server_version, sys_version = "ihbench", ""
        protocol_version = "HTTP/1.1"

        def do_GET(self) -> None:
            name, _, port = (self.headers.get("Host") or "").partition(":")
            if name not in (HOST, "localhost") or port not in ("", str(own_port(self.server))):
                return self._send(421, "text/plain", b"this server answers to 127.0.0.1 alone\n")
            path = self.path.partition("?")[0]
            if path == "/state":
                return self._send(200, "application/json", json.dumps(followed.state(), allow_nan=False).encode())
            for _ in range(100):  # while the first page is being made
                if followed.site is not None or followed.fault:
                    break
                time.sleep(0.1)
            site = followed.site
            if site is None:
                reason = followed.fault or "the page is being made; try again in a moment"
                return self._send(503, "text/plain", f"{reason}\n".encode(), retry=True)
            if path == "/":
                text = site.html(live={"version": followed.version})
                return self._send(200, "text/html; charset=utf-8", text.encode(), policy(live=True))
            content = site.files.get(path.removeprefix("/files/")) if path.startswith("/files/") else None
            if content is None:
                return self._send(404, "text/plain", b"there is no such file\n")
            kind = KINDS.get(path[path.rfind(".") :], "application/octet-stream")
            return self._send(200, kind, content)

        def _send(self, status: int, kind: str, content: bytes, rules: str = NOTHING, retry: bool = False) -> None:
            with suppress(ConnectionError):
                self.send_response(status)
                self.send_header("Content-Type", kind)
                self.send_header("Content-Length", str(len(content)))
                self.send_header("Content-Security-Policy", rules)
                self.send_header("X-Content-Type-Options", "nosniff")
                self.send_header("Cross-Origin-Resource-Policy", "same-origin")
                self.send_header("Cache-Control", "no-store")
                if retry:
                    self.send_header("Retry-After", "2")
                self.end_headers()
                self.wfile.write(content)

        def log_message(self, format: str, *args: Any) -> None:
            """Nothing: the terminal has better to say."""

    return Answer
