"""Charts that answer to a finger: hover, zoom and series to switch, drawn by Bokeh in the browser.

`embedded` makes one JSON document of all charts of a page; its library is `library()`, from the
package. Colours of the frame come from the page's style (`--bk-...`), those of the curves are set
by `charts.js` when the theme changes. Each glyph carries `[group, run, colour]` as its tags.
"""

import json
import re
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
from bokeh.document import Document
from bokeh.models import (
    BoxZoomTool,
    CDSView,
    ColumnDataSource,
    GlyphRenderer,
    HoverTool,
    Line as Curve,
    LogColorMapper,
    LogTicker,
    NumeralTickFormatter,
    PanTool,
    ResetTool,
    Scatter,
    VArea,
    WheelZoomTool,
)
from bokeh.plotting import figure
from bokeh.resources import Resources
from contourpy import contour_generator

from marlyap.report.charts import Chart, Line, tint
from marlyap.report.data import Slice
from marlyap.report.scene import INK, PALETTE
from marlyap.report.words import plain


HEIGHT = 270  # pixels
IDS = re.compile(r'"p(\d+)"')  # Bokeh numbers its objects over the life of a process
DOCUMENT = "charts"


@dataclass(frozen=True)
class Embedded:
    """What a page needs of its charts."""

    document: dict[str, Any]
    items: list[dict[str, Any]]  # which root goes into which element


@cache
def library() -> str:
    """The text of BokehJS, from the installed package."""
    return Resources("inline", components=["bokeh"]).js_raw[0]


def embedded(charts: Sequence[Chart], slices: Sequence[Slice]) -> Embedded:
    """Charts for the elements chart-0, chart-1, ... and level-0, level-1, ..."""
    document, roots = Document(), {}
    made = [(f"chart-{k}", _chart(chart)) for k, chart in enumerate(charts)]
    made += [(f"level-{k}", _level_sets(part)) for k, part in enumerate(slices)]
    with document.models.freeze():
        for element, root in made:
            document.add_root(root)
            roots[root.id] = element
    told = json.dumps({"document": document.to_json(deferred=False), "roots": roots})
    order: dict[str, str] = {}
    told = IDS.sub(lambda mark: f'"p{order.setdefault(mark[1], str(len(order)))}"', told)
    found = json.loads(told)
    item = {"docid": DOCUMENT, "roots": found["roots"], "root_ids": [*found["roots"]]}
    return Embedded({DOCUMENT: found["document"]}, [item])


def _chart(chart: Chart) -> Any:
    kinds = {"x_axis_type": "log"} if chart.log_x else {}
    low, high = chart.y_span
    room = 0.04 * (high - low or 1.0)
    ranges = {"x_range": _room(chart), "y_range": (low - room, high + room)}
    shown = _frame(chart.x_label, chart.y_label, **ranges, **kinds)
    drawn = [_line(line) for line in chart.lines]
    shown.renderers = [glyph for curve in drawn for glyph in curve]
    far = "@x{0,0.####}" if not chart.log_x else "@x{0.0000}"
    tips = [("", "$name"), (chart.x_label, far), (chart.y_label, "@y{0,0.[000]}")]
    if any(line.low is not None for line in chart.lines):
        tips.append(("band", "@low{0,0.[000]} – @high{0,0.[000]}"))
    shown.add_tools(HoverTool(renderers=[curve[-1] for curve in drawn], tooltips=tips))
    if chart.log_x:
        shown.xaxis.ticker = LogTicker(desired_num_ticks=4, mantissas=[1, 2, 5])
    else:
        shown.xaxis.formatter = NumeralTickFormatter(format="0.[00]a")
    return shown


def _room(chart: Chart) -> tuple[float, float]:
    """The ends of the axis: a little more than the data."""
    low, high = chart.x_span
    return (0.8 * low, 1.25 * high) if chart.log_x else (low, low + 1.02 * (high - low or 1.0))


def _frame(x_label: str, y_label: str, **more: Any) -> Any:
    """An empty figure with its tools, which follows the width of the page."""
    zoom, wheel, pan = BoxZoomTool(), WheelZoomTool(), PanTool()
    shown = figure(
        height=HEIGHT,
        sizing_mode="stretch_width",
        min_width=240,
        x_axis_label=x_label,
        y_axis_label=y_label,
        tools=[zoom, wheel, pan, ResetTool()],
        active_drag=zoom,
        active_scroll=None,
        toolbar_location=None,
        background_fill_color=None,
        border_fill_color=None,
        min_border_left=52,
        **more,
    )
    for axis in (*shown.xaxis, *shown.yaxis):
        axis.update(axis_label_text_font_style="normal", minor_tick_line_color=None)
        axis.update(axis_label_text_font_size="12px", major_label_text_font_size="11px")
        axis.update(major_tick_line_color=None, axis_label_standoff=6)
    return shown


def _line(line: Line) -> list[GlyphRenderer]:
    """A curve: its band where it has one, the line, and its points, which answer to the pointer.

    The three share one source. They are made one by one, because `figure.line` would make seven
    objects more for each, and Bokeh takes a millisecond for every object.
    """
    data = {"x": line.x, "y": line.y}
    if line.low is not None and line.high is not None:
        data |= {"low": line.low, "high": line.high}
    rounded = {k: plain(np.asarray(v), 5, significant=True) for k, v in data.items()}
    told = {"data_source": ColumnDataSource(rounded), "view": CDSView(), "name": line.label}
    tags = [line.team, -1 if line.member is None else line.member, tint(line.colour)]
    ink, glyphs = line.colour, []
    if "low" in data:
        shade = {"fill_color": ink, "fill_alpha": 0.16, "tags": tags}
        glyphs.append(GlyphRenderer(glyph=VArea(x="x", y1="low", y2="high", **shade), **told))
    width, alpha = (2.6, 1.0) if line.thick else (1.4, 0.85)
    look = {"line_color": ink, "line_width": width, "line_alpha": alpha, "tags": tags}
    glyphs.append(GlyphRenderer(glyph=Curve(x="x", y="y", **look), **told))
    spot = {"x": "x", "y": "y", "size": 9, "fill_color": ink, "line_color": None, "tags": tags}
    hover = Scatter(fill_alpha=1.0, **spot)
    glyphs.append(GlyphRenderer(glyph=Scatter(fill_alpha=0, **spot), hover_glyph=hover, **told))
    return glyphs


# ---- level sets ----


def _level_sets(part: Slice) -> Any:
    """Level sets of V around a goal, and in dashes the one that is certified."""
    unit = f" ({part.unit})" if part.unit else ""
    reach = (-part.reach, part.reach)
    shown = _frame(f"x{unit}", f"y{unit}", x_range=reach, y_range=reach)
    shown.update(sizing_mode="scale_width", aspect_ratio=1.0, height=None)
    values = np.asarray(part.values, np.float32)
    known = values[np.isfinite(values)]
    ground = _ground(shown, part, values, known)
    levels = np.unique(np.quantile(known, [0.03, 0.1, 0.25, 0.5, 0.75, 0.95]))
    lines = _contour(part, [v for v in levels if v > known.min()])
    look = {"line_color": PALETTE[0], "name": "level sets of V", "tags": [-1, -1, 0]}
    drawn = shown.multi_line("xs", "ys", source=ColumnDataSource(lines), line_width=1.4, **look)
    if part.level is not None:
        look = {"line_color": INK, "name": "certified level", "tags": [-1, -1, -1]}
        look |= {"line_dash": "dashed", "line_width": 2.0}
        certified = ColumnDataSource(_contour(part, [float(part.level)]))
        shown.multi_line("xs", "ys", source=certified, **look)
    ring = {"fill_color": None, "line_color": INK, "line_dash": [3, 2], "tags": [-1, -1, -1]}
    shown.circle(0, 0, radius=part.radius, name="target", **ring)
    shown.add_tools(
        HoverTool(renderers=[ground], tooltips=[("V", "@image"), ("", "$x{0.00}, $y{0.00}")])
    )
    shown.add_tools(HoverTool(renderers=[drawn], tooltips=[("V", "@level{0.[0000]}")]))
    return shown


def _ground(shown: Any, part: Slice, values: np.ndarray, known: np.ndarray) -> Any:
    """V as a tint of one colour, the stronger the larger V is."""
    shades = [f"{PALETTE[0]}{round(110 * k / 31):02x}" for k in range(32)]
    low = max(float(known.min()), 1e-4 * float(known.max()), 1e-12)
    mapper = LogColorMapper(palette=shades, low=low, high=max(float(known.max()), 2 * low))
    side = 2 * part.reach
    place = {"x": -part.reach, "y": -part.reach, "dw": side, "dh": side}
    return shown.image([values], color_mapper=mapper, name="V", tags=[-1, -1, -2], **place)


def _contour(part: Slice, levels: Sequence[float]) -> dict[str, list[Any]]:
    """The lines of each level, as columns."""
    grid = np.linspace(-part.reach, part.reach, len(part.values))
    values = np.ma.masked_invalid(part.values)
    found = contour_generator(grid, grid, values)
    drawn = [(level, line) for level in levels for line in map(np.asarray, found.lines(level))]
    return {
        "xs": [plain(line[:, 0], 3) for _, line in drawn],
        "ys": [plain(line[:, 1], 3) for _, line in drawn],
        "level": [plain(float(level), significant=True) for level, _ in drawn],
    }
