"""The server of the page: loopback only, and nothing is answered without the random token in its path.

Who may talk to it is decided before any handler is chosen, for pages, scripts and websockets alike (`Guarded`):

    path    begins with the token, compared in constant time
    Host    is this server's own address, so that another name that leads here does not reach it (DNS rebinding)
    Origin  where a browser sends one, is this server's own; a websocket must send it

Everything else is one empty answer, 404, whether the token is nearly right or not.
"""

from __future__ import annotations

import asyncio
import logging
import secrets
import threading
from collections.abc import Callable
from hmac import compare_digest
from typing import Any

from bokeh.document import Document
from bokeh.resources import Resources
from bokeh.server.server import BaseServer
from bokeh.server.tornado import BokehTornado
from bokeh.server.util import bind_sockets
from tornado.httpserver import HTTPServer
from tornado.httputil import HTTPHeaders, HTTPServerRequest
from tornado.ioloop import IOLoop, PeriodicCallback
from tornado.web import ErrorHandler, OutputTransform

LOOPBACK = "127.0.0.1"
NAMES = (LOOPBACK, "localhost")
LEFT_FOR = 6.0  # [s] without an open page, after which the server ends; a page that is loaded anew takes less
LOOK_EVERY = 500  # [ms]
MOST_SENT = 2**20  # bytes of a request, which are read before its token is; the page asks by websocket
HEADERS = {
    "Referrer-Policy": "no-referrer",  # the token stands in the address
    "X-Content-Type-Options": "nosniff",
    "Cache-Control": "no-store",
    "Cross-Origin-Resource-Policy": "same-site",
    "Content-Security-Policy": "default-src 'self' 'unsafe-inline' 'unsafe-eval' data: blob:; form-action 'none'",
}


class Careful(OutputTransform):
    """Each answer with the headers above; the page loads nothing from elsewhere, and tells nobody its address."""

    def transform_first_chunk(self, status: int, headers: HTTPHeaders, chunk: bytes, finishing: bool):
        """Add them."""
        for name, value in HEADERS.items():
            headers[name] = value
        return status, headers, chunk


class Guarded(BokehTornado):
    """Bokeh's application, which answers those alone who know the token."""

    def __init__(self, page: Callable[[Document], None], token: str, hosts: frozenset[str]):
        """Make it of what fills a document; `hosts` are the addresses that it is reached by."""
        self._token, self._hosts = token.encode(), hosts
        super().__init__(
            {"/": page},
            prefix=token,
            extra_websocket_origins=sorted(hosts),
            secret_key=secrets.token_bytes(32),
            sign_sessions=True,
            use_index=False,
            ico_path="none",
            check_unused_sessions_milliseconds=LOOK_EVERY,
            unused_session_lifetime_milliseconds=int(1e3 * LEFT_FOR),
        )

    def admits(self, request: HTTPServerRequest) -> bool:
        """Whether a request has the token, and comes from a page of this server or from no page."""
        first = request.path.lstrip("/").partition("/")[0].encode()
        known = compare_digest(first, self._token)
        here = request.headers.get("Host", "").lower() in self._hosts
        origin = request.headers.get("Origin")
        upgrade = "upgrade" in request.headers.get("Connection", "").lower() or request.path.endswith("/ws")
        ours = not upgrade if origin is None else origin.lower() in {f"http://{host}" for host in self._hosts}
        return known and here and ours

    def find_handler(self, request: HTTPServerRequest, **kwargs: Any) -> Any:
        """The handler of a request; that of an error for those who are not admitted."""
        if not self.admits(request):
            return self.get_handler_delegate(request, ErrorHandler, {"status_code": 404})
        return super().find_handler(request, **kwargs)

    def resources(self, absolute_url: str | bool | None = None) -> Resources:
        """Bokeh's scripts, from this server, without their warnings that a picture is still empty."""
        resources = super().resources(absolute_url)
        resources.log_level = "error"
        return resources

    def log_request(self, handler: Any) -> None:
        """Log nothing: addresses hold the token."""


class Server:
    """A page on a port of this machine, from `start` to `stop`.

    Attributes:
        url: where the page is, with its token.
        port: of 127.0.0.1, chosen by the system unless one is given.
    """

    def __init__(self, page: Callable[[Document], None], *, port: int = 0, ends_when_left: bool = True):
        """Bind the port; `page` fills the document of each tab."""
        try:
            sockets, self.port = bind_sockets(LOOPBACK, port)
        except OSError as error:
            rule = "port must be free, or 0 for one that the system chooses"
            raise ValueError(f"{rule}, but {port} is not: {error.strerror}") from None
        self._sockets, self._page, self._ends = sockets, page, ends_when_left
        self._token = secrets.token_urlsafe(32)
        self.url = f"http://{LOOPBACK}:{self.port}/{self._token}/"
        self._loop: IOLoop | None = None
        self._thread: threading.Thread | None = None
        self._started = threading.Event()

    def run(self) -> None:
        """Serve until `stop`, the last page is left, or Ctrl-C."""
        logging.getLogger("bokeh").setLevel(logging.CRITICAL)  # a tab that is closed in mid-sentence is no event
        asyncio.set_event_loop(asyncio.new_event_loop())
        self._loop = IOLoop.current()
        hosts = frozenset(f"{name}:{self.port}" for name in NAMES)
        app = Guarded(self._page, self._token, hosts)
        app.add_transform(Careful)
        app.settings["default_handler_class"] = ErrorHandler
        app.settings["default_handler_args"] = {"status_code": 404}
        http = HTTPServer(app, max_header_size=MOST_SENT, max_body_size=MOST_SENT, max_buffer_size=MOST_SENT)
        http.add_sockets(self._sockets)
        server = BaseServer(self._loop, app, http)
        server.start()
        if self._ends:
            PeriodicCallback(self._watch(app), LOOK_EVERY).start()
        self._loop.add_callback(self._started.set)
        try:
            self._loop.start()
        finally:
            server.stop()
            http.stop()
            self._loop.close(all_fds=True)

    def start(self) -> Server:
        """Serve in a thread of its own."""
        self._thread = threading.Thread(target=self.run, daemon=True)
        self._thread.start()
        self._started.wait(30.0)
        return self

    def stop(self) -> None:
        """End what `start` began, and wait until the port is closed."""
        if self._loop is not None:
            self._loop.add_callback(self._loop.stop)
        if self._thread is not None:
            self._thread.join(30.0)

    def _watch(self, app: BokehTornado) -> Callable[[], None]:
        """What looks whether the last page was left a while ago."""
        last_visit = {"page": False, "since": 0.0}

        def look() -> None:
            assert self._loop is not None
            now = self._loop.time()
            if any(session.connection_count for session in app.get_sessions("/")):
                last_visit.update(page=True, since=now)
            elif last_visit["page"] and now - last_visit["since"] > LEFT_FOR:
                self._loop.stop()

        return look
