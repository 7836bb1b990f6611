"""The server of the page, loopback only, and a session for each tab, which answers its questions.

Access is decided before any handler is chosen, for pages, scripts and websockets alike (`Guarded`):

    path    begins with the random token, compared in constant time
    Host    is this server's own address, so that another name that leads here does not reach it (DNS rebinding)
    Origin  where a browser sends one, is this server's own; a websocket must send it

Anything else gets one empty answer, 404, whether the token is nearly right or not.
"""

from __future__ import annotations

import asyncio
import base64
import io
import json
import logging
import math
import secrets
import threading
from collections.abc import Callable, Mapping
from contextlib import suppress
from functools import cache, partial
from hmac import compare_digest
from pathlib import Path
from typing import Any, NamedTuple

from bokeh.core.properties import String
from bokeh.document import Document
from bokeh.model import DataModel
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
from tuning.exploring.bench import SCENES, Bench, Scene
from tuning.exploring.page.pictures import DARK, HELD, Colours, Look, MapPicture, Pictures, Sent
from tuning.exploring.view import View, figure_of

KINDS = {
    "tuned": "tuned file",
    "python": "Python lines",
    "command": "command",
    "png": "PNG picture",
    "svg": "SVG picture",
}
WIDTHS = (200, 4000)  # of a picture, in points
MOST_TRIALS = 10_000
log = logging.getLogger(__name__)

# Of the server.
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
SEEDS = 8


class Wire(DataModel):
    """What the page and the server say to each other, as JSON."""

    asked = String(default="")
    told = String(default="")


LIGHT = Colours(ink="#1b1f24", axis="#4d5661", grid="#e3e6ea", estimate="#0b6bb8", band="#0b6bb8")


def ground(dark: bool) -> Colours:
    """Those of the ground that the page has."""
    return DARK if dark else LIGHT


class File(NamedTuple):
    """A file for the browser to keep: text, or if it is none, bytes in base 64."""

    name: str
    type: str
    text: str | None
    base64: str | None = None


def exported(bench: Bench, values: Mapping[str, float], view: View, run: int, kind: str) -> File:
    """A file of what is seen.

    Raises:
        ValueError: for another kind than those of `KINDS`.
    """
    if kind == "tuned":
        return File("tuned.json", "application/json", bench.tuned_file(values))
    if kind == "python":
        return File("explored.py", "text/x-python", bench.python_lines(values))
    if kind == "command":
        return File("command.txt", "text/plain", bench.command(values))
    if kind not in KINDS:
        raise ValueError(f"kind must be one of {', '.join(KINDS)}, but got {kind}")
    drawn = io.BytesIO()
    figure_of(bench, view, run).savefig(drawn, format=kind, dpi=150)
    if kind == "svg":
        return File("explored.svg", "image/svg+xml", drawn.getvalue().decode())
    return File("explored.png", "image/png", None, base64.b64encode(drawn.getvalue()).decode())


class Session:
    """The state of one tab."""

    def __init__(self, document: Document, bench: Bench, seeds: int, scene: Scene | None = None):
        """Fill a document with empty pictures; the page asks for the rest."""
        self.document, self.bench, self.seeds = document, bench, seeds
        self.scene, self.dark, self.width = scene, False, 800
        self.values = bench.checked({} if scene is None else scene.steps[0].values)
        self.run, self.errors, self.what = 0, False, "score"
        self.view: View | None = None
        self.before: View | None = None  # what arrows compare with
        self.held: dict[int, tuple[Bench, dict[str, float]]] = {}
        self.trials: list[Any] = []
        self._stopped, self._gone = threading.Event(), False
        self.sent = Sent()
        self.pictures = Pictures(bench, self.sent)
        self.map = MapPicture(bench.knobs, self._clicked, self.sent)
        self.wire = Wire(name="wire")
        self.map.figure.tags = [self.wire]
        self.wire.on_change("asked", self._asked)
        document.on_session_destroyed(self._left)
        for figure in (*self.pictures.figures, self.map.figure):
            document.add_root(figure)
        self._paint()

    def _asked(self, _: str, __: str, text: str) -> None:
        """Answer a question; what goes wrong is said on the page in one line, and the page lives on."""
        number = None
        try:
            question = json.loads(text)
            number = question.get("number")
            answer = getattr(self, f"do_{question['do']}")(question) or {}
        except (ValueError, ArithmeticError) as error:
            answer = {"error": str(error)}
        except Exception as error:
            log.debug("a question that failed", exc_info=True)
            answer = {"error": f"{type(error).__name__}: {error}"}
        self.tell({**answer, "answers": number})

    def tell(self, message: Mapping[str, Any]) -> None:
        """Say something to the page, and what is to be drawn."""
        drawn = self.sent.take()
        message = {**message, "drawn": drawn} if drawn else message
        self.wire.told = json.dumps(_plain(message), allow_nan=False)

    def do_hello(self, question: Mapping[str, Any]) -> dict[str, Any]:
        """The beginning: what there is to set."""
        self._seen(question)
        self._paint()
        self._look()
        return {"spec": self._spec(), **self._numbers()}

    def do_ground(self, question: Mapping[str, Any]) -> None:
        """Dark or light."""
        self._seen(question)
        self._paint()

    def do_view(self, question: Mapping[str, Any]) -> dict[str, Any]:
        """New values."""
        self._seen(question)
        self.values = self.bench.checked(self.values | dict(question["values"]))
        self._look()
        return self._numbers()

    def do_filter(self, question: Mapping[str, Any]) -> dict[str, Any]:
        """Another filter: values of knobs that both have stay."""
        if question["filter"] not in self.bench.filters:
            raise ValueError(
                f"filter must be one of {', '.join(self.bench.filters)}, but got {question['filter']}"
            )
        return self._changed(question["filter"], self.values)

    def do_step(self, question: Mapping[str, Any]) -> dict[str, Any]:
        """A setting of the scene."""
        steps = () if self.scene is None else self.scene.steps
        index = int(question["step"])
        if not 0 <= index < len(steps):
            raise ValueError(f"step must be one of {len(steps)}, but got {index}")
        return self._changed(steps[index].filter, steps[index].values)

    def _changed(self, name: str, values: Mapping[str, float]) -> dict[str, Any]:
        """Go on with another filter, or the same one, at what it knows of some values."""
        self._stopped.set()
        bench = self.bench if name == self.bench.filter else self.bench.with_filter(name)
        known = {knob.name: knob for knob in bench.knobs}
        clipped = {
            key: min(max(at, known[key].low), known[key].high) for key, at in values.items() if key in known
        }
        self.bench, self.values, self.trials = bench, bench.checked(clipped), []
        self.map.set_knobs(bench.knobs)
        self._look()
        return {"spec": self._spec(), **self._numbers()}

    def do_plotted(self, question: Mapping[str, Any]) -> dict[str, Any]:
        """Which states are drawn, of which run, and whether as errors."""
        self.pictures.choose([int(index) for index in question["states"]])
        self.run, self.errors = max(0, int(question["run"])), bool(question["errors"])
        self._look()
        for slot in self.held:
            self._draw_held(slot)
        return self._numbers()

    def do_map(self, question: Mapping[str, Any]) -> None:
        """Draw the map over two knobs, beside the loop, so that sliders go on; the page is told."""
        x, y = question["x"], question["y"]
        known = [knob.name for knob in self.bench.knobs]
        if x not in known or y not in known or x == y:
            raise ValueError(f"a map must have two of {', '.join(known)}, but got {x} and {y}")
        self.what = "nis" if question.get("what") == "nis" else "score"
        bench, values = self.bench, dict(self.values)
        self._in_background(lambda: bench.map(values, x, y), self._mapped)

    def do_study(self, question: Mapping[str, Any]) -> None:
        """Run a study from here; its trials appear as they end."""
        trials = int(question["trials"])
        if not 1 <= trials <= MOST_TRIALS:
            raise ValueError(f"trials must be from 1 to {MOST_TRIALS}, but got {trials}")
        self._stopped.set()
        self._stopped = stopped = threading.Event()
        self.trials = []
        bench, values = self.bench, dict(self.values)

        def work() -> None:
            for trial in bench.study(values, trials):
                self._later(partial(self._tried, trial, trials, stopped))
                if stopped.is_set():
                    return

        self._in_background(work, lambda _: self.tell({"study": {"done": True}}))

    def do_stop(self, _: Mapping[str, Any]) -> None:
        """End the study after the trial that runs."""
        self._stopped.set()

    def do_hold(self, _: Mapping[str, Any]) -> dict[str, Any]:
        """Keep what is seen, in a colour."""
        free = [slot for slot in range(len(HELD)) if slot not in self.held]
        if not free:
            raise ValueError(f"at most {len(HELD)} configurations are held: drop one first")
        self.held[free[0]] = (self.bench, dict(self.values))
        self._draw_held(free[0])
        assert self.view is not None
        figures = {name: figure.value for name, figure in self.view.figures.items()}
        source = {"filter": self.bench.filter, "values": self.values, "figures": figures}
        return {"held": {"slot": free[0], "colour": HELD[free[0]], **source}}

    def do_drop(self, question: Mapping[str, Any]) -> None:
        """Forget a held configuration."""
        if self.held.pop(int(question["slot"]), None):
            self.pictures.drop(int(question["slot"]))

    def do_export(self, question: Mapping[str, Any]) -> None:
        """What is seen, as a file or text; a tuned file is evaluated first, which takes seconds."""
        assert self.view is not None
        arguments = self.bench, dict(self.values), self.view, self.run, str(question["kind"])
        self._in_background(lambda: exported(*arguments), lambda file: self.tell({"file": file._asdict()}))

    def _seen(self, question: Mapping[str, Any]) -> None:
        width, least, most = float(question.get("width", self.width)), *WIDTHS
        self.width = int(min(max(width, least), most)) if math.isfinite(width) else least
        self.dark = bool(question.get("dark", self.dark))

    @property
    def _look_at(self) -> Look:
        return self.width, self.run, self.errors

    def _look(self) -> None:
        self.view = self.bench.view(self.values, self.seeds)
        if self.before is None:
            self.before = self.view
        self.pictures.show(self.view, self._look_at)
        self.map.mark(self.values)

    def _numbers(self) -> dict[str, Any]:
        assert self.view is not None and self.before is not None
        start = {name: figure.value for name, figure in self.before.figures.items()}
        figures = {
            name: {**figure._asdict(), "start": start.get(name)} for name, figure in self.view.figures.items()
        }
        return {"figures": figures, "values": self.values}

    def _spec(self) -> dict[str, Any]:
        bench = self.bench
        return {
            "knobs": [{**knob._asdict(), "marks": dict(knob.marks)} for knob in bench.knobs],
            "title": bench.title,
            "start": dict(bench.start),
            "filter": bench.filter,
            "filters": list(bench.filters),
            "states": [state.name for state in bench.states],
            "shown": list(self.pictures.chosen),
            "steps": [step.label for step in self.scene.steps] if self.scene else [],
            "axes": list(self.scene.knobs[:2]) if self.scene else [],
            "truth": bench.has_truth,
            "seeds": 0 if self.view is None else len(self.view.estimate),
        }

    def _paint(self) -> None:
        colours = ground(self.dark)
        self.pictures.paint(colours)
        self.map.paint(colours)

    def _draw_held(self, slot: int) -> None:
        bench, values = self.held[slot]
        self.pictures.hold(slot, bench.view(values, self.seeds), self._look_at)

    def _clicked(self, values: dict[str, float]) -> None:
        self.values = self.bench.checked(self.values | values)
        self._look()
        self.tell(self._numbers())

    def _mapped(self, computed: Any) -> None:
        self.map.show(computed, self.what)
        self.map.mark(self.values)
        self.map.points(self.trials)
        self.tell({"map": True})

    def _tried(self, trial: Any, trials: int, stopped: threading.Event) -> None:
        if stopped.is_set():
            return
        self.trials.append(trial)
        self.map.points(self.trials)
        best = min(self.trials, key=lambda trial: trial.score if math.isfinite(trial.score) else math.inf)
        self.tell({"study": {"done": False, "trial": len(self.trials), "trials": trials, "best": best._asdict()}})

    def _in_background(self, work: Callable[[], Any], then: Callable[[Any], None]) -> None:
        """Do work in a thread, then go on with its result in the document's; an error is told."""

        def run() -> None:
            try:
                result = work()
            except Exception as error:
                text = str(error) if isinstance(error, ValueError) else f"{type(error).__name__}: {error}"
                self._later(lambda: self.tell({"error": text, "study": {"done": True}}))
                return
            self._later(lambda: then(result))

        threading.Thread(target=run, daemon=True).start()

    def _left(self, _: Any) -> None:
        self._gone = True
        self._stopped.set()

    def _later(self, call: Callable[[], None]) -> None:
        with suppress(AttributeError):  # the tab was closed meanwhile: Bokeh has taken its document to pieces
            if not self._gone:
                self.document.add_next_tick_callback(call)


def _plain(value: Any) -> Any:
    """What JSON holds: None for NaN and infinities."""
    if isinstance(value, Mapping):
        return {str(name): _plain(entry) for name, entry in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(entry) for entry in value]
    if value is None or isinstance(value, str | bool):
        return value
    number = float(value)
    if not math.isfinite(number):
        return None
    return int(number) if number.is_integer() and abs(number) < 2**53 else number


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
