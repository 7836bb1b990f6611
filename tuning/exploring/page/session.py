"""One tab of the page: answers what it asks, and keeps what it shows."""

from __future__ import annotations

import json
import logging
import math
import threading
from collections.abc import Callable, Mapping
from contextlib import suppress
from functools import partial
from typing import Any

from bokeh.core.properties import String
from bokeh.document import Document
from bokeh.model import DataModel

from tuning.exploring.bench import Bench
from tuning.exploring.page.export import exported
from tuning.exploring.page.pictures import HELD, Look, MapPicture, Pictures, Sent, ground
from tuning.exploring.scenes import Scene
from tuning.exploring.view import View

WIDTHS = (200, 4000)  # of a picture, in points
MOST_TRIALS = 10_000
log = logging.getLogger(__name__)


class Wire(DataModel):
    """What the page and the server say to each other, as JSON."""

    asked = String(default="")
    told = String(default="")


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
