"""A server for one browser on this machine: a few texts in memory, behind a secret address.

It is bound to 127.0.0.1, and the first part of each path is a token that only who has seen the
address knows. No file is ever opened for a request.
"""

from __future__ import annotations

import hmac
import secrets
from collections.abc import Mapping
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from socketserver import TCPServer
from typing import Any
from urllib.parse import urlsplit

from .. import __version__
from ..errors import OptionError

HOST = "127.0.0.1"
NAMES = (HOST, "localhost")  # by which a browser may ask for it: no page of another name, which an
# attacker's name server points here (DNS rebinding)
TOKEN_BYTES = 24
TYPES = {"": "text/html; charset=utf-8", ".js": "text/javascript; charset=utf-8"}
HEADERS = {
    "Cache-Control": "no-store",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
}


class PageServer(ThreadingHTTPServer):
    """Serves texts by their path behind the token, "" for the page; all else is not found.

    Parameters
    ----------
    texts : dict
        Text by path.
    port : int
        0: any that is free.

    Raises
    ------
    OptionError
        If the port is taken or may not be used.
    """

    daemon_threads = True

    def __init__(self, texts: Mapping[str, str], port: int = 0) -> None:
        self.texts = {path: text.encode("utf-8") for path, text in texts.items()}
        self.token = secrets.token_urlsafe(TOKEN_BYTES)
        try:
            super().__init__((HOST, port), Handler)
        except OSError as error:
            reason = error.strerror or error
            raise OptionError(f"--port {port} cannot be used: {reason}; give another") from error

    def server_bind(self) -> None:
        """Bind the socket without asking a name server for the name of this machine."""
        TCPServer.server_bind(self)
        self.server_name, self.server_port = HOST, self.server_address[1]

    @property
    def address(self) -> str:
        """The address of the page."""
        return f"http://{HOST}:{self.server_port}/{self.token}/"

    def find(self, host: str, target: str) -> tuple[str, bytes] | None:
        """Return type and text for a request's host and path, None if there is nothing."""
        if host not in {f"{name}:{self.server_port}" for name in NAMES}:
            return None
        _, _, rest = urlsplit(target).path.partition("/")
        token, slash, path = rest.partition("/")
        is_known = hmac.compare_digest(token.encode("utf-8"), self.token.encode("utf-8"))
        if not (is_known and slash and path in self.texts):
            return None
        return TYPES[".js" if path.endswith(".js") else ""], self.texts[path]

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Say nothing of a browser that went away in the middle of an answer."""


class Handler(BaseHTTPRequestHandler):
    """Answers GET and HEAD."""

    server: PageServer
    server_version = f"super-sdf/{__version__}"
    sys_version = ""

    def do_GET(self) -> None:
        """Send a text with its headers."""
        self.answer(with_text=True)

    def do_HEAD(self) -> None:
        """Send the headers of a text."""
        self.answer(with_text=False)

    def answer(self, *, with_text: bool) -> None:
        """Send what was asked for, or that it is not found."""
        found = self.server.find(self.headers.get("Host", ""), self.path)
        kind, text = found or ("text/plain; charset=utf-8", b"not found\n")
        self.send_response(200 if found else 404)
        for name, value in HEADERS.items():
            self.send_header(name, value)
        self.send_header("Content-Type", kind)
        self.send_header("Content-Length", str(len(text)))
        self.end_headers()
        if with_text:
            self.wfile.write(text)

    def log_message(self, format: str, *args: Any) -> None:
        """Print nothing for a request: the address has the token."""
