"""The picture of a `Map`: score or NIS over two knobs, the study's trials on it, and the point where one is."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import numpy as np
from bokeh.events import Tap
from bokeh.models import BasicTicker, ColorBar, ColumnDataSource, CustomJSTickFormatter, LogColorMapper
from bokeh.palettes import Cividis256, RdBu11

from tuning.exploring.bench import Trial
from tuning.exploring.exported import Map
from tuning.exploring.knobs import Knob
from tuning.exploring.page.pictures import Colours, new_figure, paint
from tuning.exploring.page.sent import Sent, as_sent

HEIGHT = 330  # [px]
BAD = 5.0  # times the least score, where the scale of colours ends
TICKS = "const size = log ? 10**tick : tick; return size < 1e-2 || size >= 1e4 ? size.toExponential(log ? 0 : 1)"
TICKS += " : String(+size.toPrecision(3))"


class MapPicture:
    """Score or NIS over two knobs; a click takes their values."""

    def __init__(self, knobs: Sequence[Knob], on_click: Callable[[dict[str, float]], None], sent: Sent):
        """Make it empty.

        Args:
            knobs: all that may be an axis.
            on_click: called with the two values of a click.
            sent: takes where one is.
        """
        self.set_knobs(knobs)
        self._taken, self._sent = on_click, sent
        self.map: Map | None = None
        self.figure = new_figure("map", HEIGHT, tools="tap")
        self.image = ColumnDataSource({"image": [], "x": [], "y": [], "dw": [], "dh": []})
        self.trials, self.path = (ColumnDataSource({"x": [], "y": []}) for _ in range(2))
        self.here: dict[str, list[float]] = {}
        here = ColumnDataSource({"x": [], "y": []}, name="where one is")
        self.mapper = LogColorMapper(palette=Cividis256[::-1], low=1.0, high=BAD)
        draw = self.figure
        draw.image("image", "x", "y", "dw", "dh", source=self.image, color_mapper=self.mapper)
        top = {"level": "overlay"}  # on a canvas of its own: the map need not be drawn again
        draw.line("x", "y", source=self.path, line_width=2, name="trials", **top)
        draw.scatter(
            "x", "y", source=self.trials, size=7, fill_color="white", line_width=1.2, name="trials", **top
        )
        cross = {"source": here, "marker": "cross", **top}  # light around dark: it is seen on all colours
        draw.scatter("x", "y", size=20, line_color="white", line_width=6, **cross)
        draw.scatter("x", "y", size=18, line_color="#1b1f24", line_width=2.5, **cross)
        self.bar = ColorBar(color_mapper=self.mapper, width=12, padding=4, background_fill_color=None)
        self.bar.major_label_text_font_size = "12px"
        draw.add_layout(self.bar, "right")
        draw.on_event(Tap, self._click)
        for axis in (draw.xaxis[0], draw.yaxis[0]):
            axis.ticker = BasicTicker(desired_num_ticks=5, mantissas=[1, 2, 5])
            axis.formatter = CustomJSTickFormatter(args={"log": True}, code=TICKS)

    def set_knobs(self, knobs: Sequence[Knob]) -> None:
        """Begin anew with another filter's knobs."""
        self._knobs = {knob.name: knob for knob in knobs}
        self.map = None

    def paint(self, colours: Colours) -> None:
        """Colour it."""
        paint(self.figure, colours)
        self.bar.major_label_text_color = colours.axis

    def show(self, map_: Map, what: str) -> None:
        """Draw a map: its "score", or its "nis"."""
        self.map = map_
        values = np.array(map_.nis if what == "nis" else map_.score, dtype=float)
        values[~np.isfinite(values) | (values <= 0.0)] = np.nan
        if what == "nis":
            self.mapper.update(palette=RdBu11, low=0.1, high=10.0)
        else:
            least = float(np.nanmin(values)) if np.isfinite(values).any() else 1.0
            self.mapper.update(palette=Cividis256[::-1], low=least, high=BAD * least)
        (left, width), (bottom, height) = (
            self._extent(name, along) for name, along in ((map_.x, map_.xs), (map_.y, map_.ys))
        )
        self.image.data = {"image": [as_sent(values)], "x": [left], "y": [bottom], "dw": [width], "dh": [height]}
        for axis, name in ((self.figure.xaxis[0], map_.x), (self.figure.yaxis[0], map_.y)):
            knob = self._knobs[name]
            axis.axis_label = f"{knob.label} [{knob.unit}]" if knob.unit else knob.label
            axis.formatter.args = {"log": knob.log}
        self.figure.x_range.update(start=left, end=left + width)
        self.figure.y_range.update(start=bottom, end=bottom + height)

    def mark(self, values: Mapping[str, float]) -> None:
        """Draw where one is."""
        if self.map is None:
            return
        now = {"x": [self._place(self.map.x, values)], "y": [self._place(self.map.y, values)]}
        if self.here != now:
            self.here = now
            self._sent.columns("where one is", {axis: np.array(at) for axis, at in now.items()})

    def points(self, trials: Sequence[Trial]) -> None:
        """Draw a study's trials, and the path of the best one so far."""
        if self.map is None:
            return
        least, path = np.inf, []
        for trial in trials:
            if trial.score < least and not trial.pruned:
                least = trial.score
                path.append(trial)
        for source, points in ((self.trials, trials), (self.path, path)):
            source.data = {
                axis: np.array([self._place(name, trial.values) for trial in points], dtype=float)
                for axis, name in (("x", self.map.x), ("y", self.map.y))
            }

    def _place(self, name: str, values: Mapping[str, float]) -> float:
        value = values.get(name, np.nan)
        if not self._knobs[name].log:
            return value
        return float(np.log10(value)) if value > 0.0 else np.nan

    def _extent(self, name: str, along: np.ndarray) -> tuple[float, float]:
        """The beginning and the length of an axis, whose outermost points are the middles of their cells."""
        at = np.log10(along) if self._knobs[name].log else np.asarray(along, dtype=float)
        step = (at[-1] - at[0]) / (len(at) - 1)
        return float(at[0] - step / 2), float(at[-1] - at[0] + step)

    def _click(self, event: Tap) -> None:
        if self.map is None:
            return
        values = {}
        for name, at in ((self.map.x, event.x), (self.map.y, event.y)):
            knob = self._knobs[name]
            value = 10.0**at if knob.log else at
            value = min(max(value, knob.low), knob.high)
            values[name] = float(round(value)) if knob.integer else value
        self._taken(values)
