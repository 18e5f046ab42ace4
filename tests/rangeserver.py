"""A web server of this machine: a folder, with HTTP ranges. It counts what it is asked, and can misbehave."""

from __future__ import annotations

import http.server
import re
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from urllib.parse import unquote

Answer = tuple[int, dict[str, str], bytes]


class Site:
    """url: of the folder. asked: (path, range or None) of each request. odd: path -> another answer, or None."""

    def __init__(self, folder: Path):
        self.folder, self.url, self.ranges = folder, "", True
        self.asked: list[tuple[str, str | None]] = []
        self.sent = 0
        self.odd: Callable[[str], Answer | None] = lambda path: None

    def answer(self, path: str, wanted: str | None) -> Answer:
        found = self.odd(path)
        if found is not None:
            return found
        file = self.folder / path
        if not file.is_file():
            return 404, {}, b""
        data = file.read_bytes()
        parts = re.fullmatch(r"bytes=(\d+)-(\d*)", wanted or "")
        if not self.ranges or parts is None:
            return 200, {}, data
        first, last = int(parts[1]), min(int(parts[2] or len(data) - 1), len(data) - 1)
        if first >= len(data):
            return 416, {"Content-Range": f"bytes */{len(data)}"}, b""
        return 206, {"Content-Range": f"bytes {first}-{last}/{len(data)}"}, data[first : last + 1]


@contextmanager
def serving(folder: Path) -> Iterator[Site]:
    """A server of a folder, at a port that is free."""
    site = Site(folder)

    class Handler(http.server.BaseHTTPRequestHandler):
        protocol_version = "HTTP/1.1"

        def do_GET(self) -> None:
            path, wanted = unquote(self.path.split("?")[0]).lstrip("/"), self.headers.get("Range")
            status, headers, body = site.answer(path, wanted)
            site.asked.append((path, wanted))
            site.sent += len(body)
            self.send_response(status)
            for name, value in {**headers, "Content-Length": str(len(body))}.items():
                self.send_header(name, value)
            self.end_headers()
            self.wfile.write(body)

        def log_message(self, format: str, *args: object) -> None:
            pass

    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    server.daemon_threads = True
    thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01}, daemon=True)
    thread.start()
    site.url = f"http://127.0.0.1:{server.server_port}"
    try:
        yield site
    finally:
        server.shutdown()
        server.server_close()
        thread.join()
