"""The server of the page: loopback only, and nothing is answered without the random token in its path.

Who may talk to it is decided before any handler is chosen, for pages, scripts and websockets alike (`Guarded`):

    path    begins with the token, compared in constant time
    Host    is this server's own address, so that another name that leads here does not reach it (DNS rebinding)
    Origin  where a browser sends one, is this server's own; a websocket must send it

Everything else is one empty answer, 404, whether the token is nearly right or not.

The document of a tab: the template around the pictures.
"""

from __future__ import annotations

import asyncio
import logging
import secrets
import threading
from collections.abc import Callable
from functools import cache
from hmac import compare_digest
from pathlib import Path
from typing import Any

from bokeh.document import Document
from bokeh.resources import Resources
from bokeh.server.server import BaseServer
from bokeh.server.tornado import BokehTornado
from bokeh.server.util import bind_sockets
from jinja2 import Environment, FileSystemLoader, Template
from markupsafe import Markup
from tornado.httpserver import HTTPServer
from tornado.httputil import HTTPHeaders, HTTPServerRequest
from tornado.ioloop import IOLoop, PeriodicCallback
from tornado.web import ErrorHandler, OutputTransform

from thruster_env.model.quantities import Quantity
from tuning.exploring.bench import Bench
from tuning.exploring.page.export import KINDS
from tuning.exploring.page.session import Session
from tuning.exploring.scenes import SCENES

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


HERE = Path(__file__).parent
SEEDS = 8


@cache
def template() -> Template:
    """The page, whose texts are escaped where they are put in."""
    return Environment(autoescape=True, loader=FileSystemLoader(HERE)).get_template("page.html")


@cache
def asset(name: str) -> Markup:
    """A style or script of the page."""
    return Markup((HERE / name).read_text(encoding="utf-8"))


def signals(bench: Bench) -> list[tuple[str, str, str]]:
    """Name, title and description of each picture over time."""
    rows = []
    for i, quantity in enumerate(bench.states):
        named = _named(quantity)
        rows.append((f"state{i}", named, f"{named} over time, with the 95 % band of its estimate"))
    for i, quantity in enumerate(bench.measurements):
        named = f"Innovation of {_named(quantity)}"
        rows.append((f"innovation{i}", named, f"{named} over time, with its 95 % band"))
    rows.append(("nis", "NIS", "Normalised innovation squared over time, with the interval of its mean over runs"))
    if bench.has_truth:
        rows.append(("nees", "NEES", "Normalised estimation error squared over time, with its interval"))
    rows.append(("autocorrelation", "Autocorrelation of innovations", "Autocorrelation over lags, with its band"))
    return rows


def _named(quantity: Quantity) -> str:
    return f"{quantity.name} [{quantity.unit}]" if quantity.unit else quantity.name


def page_of(bench: Bench, seeds: int = SEEDS) -> Callable[[Document], None]:
    """What fills the document of each new tab: with a bench, or with the scene that the address names."""

    def fill(document: Document) -> None:
        scene = SCENES.get(_asked(document))
        here = bench if scene is None else scene.bench()
        document.title = f"{here.title}: explore"
        document.template = template()
        document.template_variables.update(
            heading=here.title,
            css=asset("page.css"),
            js=asset("page.js"),
            kinds=list(KINDS.items()),
            signals=signals(here),
            scenes=[(scene_.name, scene_.title) for scene_ in SCENES.values()],
            scene=scene,
            has_truth=here.has_truth,
        )
        Session(document, here, seeds, scene)

    return fill


def _asked(document: Document) -> str:
    """The scene that the address asks for; empty if none."""
    context = document.session_context
    arguments = getattr(context.request, "arguments", {}) if context is not None else {}
    return b"".join(arguments.get("scene", [])[:1]).decode(errors="replace")
