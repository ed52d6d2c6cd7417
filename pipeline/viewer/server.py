"""A small server of one page, for a browser on this machine: the page, the avatar, and the filmed frames.

It answers GET for five fixed paths and nothing else, reads no path from a request but a frame's number, and
where it listens on the loopback it refuses a request that was meant for another name: no page from elsewhere
can read it by a name that leads here.
"""

from __future__ import annotations

import ipaddress
import json
import socket
import threading
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

from pipeline.errors import UserError
from pipeline.viewer.page import viewer_page
from pipeline.viewer.source import AvatarSource, said_of

LOCAL_NAMES = ("localhost", "127.0.0.1", "[::1]")
HTML, JSON = "text/html; charset=utf-8", "application/json"
PICTURE, PACKED = "image/png", "application/octet-stream"


class LiveAvatar:
    """The avatar as the server has it, read anew when its file has changed."""

    def __init__(self, source: AvatarSource):
        """Reads it for the first time.

        Raises:
            UserError: there is no avatar, or it cannot be read.
        """
        self.source = source
        self._lock = threading.Lock()
        found = source.find()
        self._packed, self._stamp, self._refused = source.packed(found), found.stamp, ""

    def state(self) -> dict[str, str]:
        """The stamp of the avatar, and a sentence on it; the avatar is read anew where that is called for."""
        with self._lock:
            try:
                found = self.source.find()
                if found.stamp not in (self._stamp, self._refused):
                    self._refused = found.stamp  # a file that cannot be read is not tried again and again
                    self._packed, self._stamp = self.source.packed(found), found.stamp
                said = said_of(found) if found.stamp == self._stamp else f"{found.path.name} cannot be read."
            except (UserError, OSError) as error:
                said = f"This is the last that could be read: {error}"
            return {"stamp": self._stamp, "said": said}

    @property
    def packed(self) -> bytes:
        """The avatar as the page reads it."""
        with self._lock:
            return self._packed


class ViewServer(ThreadingHTTPServer):
    """The server of one subject's page."""

    daemon_threads = True

    def __init__(self, live: LiveAvatar, host: str, port: int):
        """Listens, and serves once ``serve_forever`` is called.

        Raises:
            UserError: the port is taken, or the address is not this machine's.
        """
        self.live = live
        self.page = viewer_page(live.source.subject, None).encode()
        self.address_family = socket.AF_INET6 if ":" in host else socket.AF_INET
        try:
            super().__init__((host, port), _Handler)
        except OSError as error:
            raise UserError(
                f"{host}:{port} cannot be listened on ({error.strerror or error}): choose another with port= "
                "(port=0: any that is free), or leave host= out"
            ) from None

    @property
    def local(self) -> bool:
        """Whether nothing but this machine can reach it."""
        return ipaddress.ip_address(str(self.server_address[0])).is_loopback

    @property
    def url(self) -> str:
        """The page's address for a browser on this machine."""
        host, port = self.server_address[:2]
        shown = str(host)
        if ipaddress.ip_address(shown).is_unspecified:
            shown = "127.0.0.1"
        return f"http://{f'[{shown}]' if ':' in shown else shown}:{port}/"

    def handle_error(self, request: Any, client_address: Any) -> None:
        """A browser that went away while it was answered is no trouble."""


class _Handler(BaseHTTPRequestHandler):
    """One request."""

    server: ViewServer
    server_version, sys_version = "FlexiAvatar", ""
    timeout = 30  # seconds until a connection that says nothing is closed

    def do_GET(self) -> None:
        """Answers one of the five paths."""
        live, path = self.server.live, self.path.partition("?")[0]
        if self.server.local and self.headers.get("Host", "").rsplit(":", 1)[0] not in self._names():
            self._answer(b"this name does not lead here", "text/plain", HTTPStatus.FORBIDDEN)
        elif path == "/":
            self._answer(self.server.page, HTML)
        elif path == "/state":
            self._answer(json.dumps(live.state()).encode(), JSON)
        elif path == "/avatar":
            self._answer(live.packed, PACKED)
        elif path.startswith("/frame/") and path[7:].isascii() and path[7:].isdigit() and len(path) < 20:
            self._frame(int(path[7:]))
        else:
            self._answer(b"there is nothing here", "text/plain", HTTPStatus.NOT_FOUND)

    def _names(self) -> tuple[str, ...]:
        return (*LOCAL_NAMES, str(self.server.server_address[0]))

    def _frame(self, number: int) -> None:
        try:
            self._answer(self.server.live.source.frame(number), PICTURE)
        except (UserError, OSError) as error:
            self._answer(str(error).encode(), "text/plain", HTTPStatus.NOT_FOUND)

    def _answer(self, content: bytes, kind: str, status: HTTPStatus = HTTPStatus.OK) -> None:
        self.send_response(status)
        self.send_header("Content-Type", kind)
        self.send_header("Content-Length", str(len(content)))
        self.send_header("Cache-Control", "no-store")
        self.send_header("X-Content-Type-Options", "nosniff")
        self.end_headers()
        self.wfile.write(content)

    def log_message(self, format: str, *args: Any) -> None:
        """Says nothing."""
