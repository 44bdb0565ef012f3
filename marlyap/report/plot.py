"""Matplotlib: scenes and charts, drawn once for SVG, PNG and GIF.

One colour per body, leaders filled and ringed, followers hollow, the goal's ring to scale, a
Lyapunov function in vermilion where it rises. In an SVG every colour is a variable of the page's
style, so that it follows the reader's dark or light theme.
"""

import io
import re
from collections.abc import Iterator, Mapping, Sequence
from html import escape
from typing import Any, Literal
from xml.etree import ElementTree

import matplotlib
import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection
from matplotlib.colors import to_rgba
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Circle, Rectangle
from matplotlib.path import Path

from marlyap.report.charts import Chart
from marlyap.report.scene import (
    ALARM,
    FAINT,
    INK,
    PALETTE,
    PAPER,
    RULE,
    SOFT,
    TRAIL,
    Panel,
    Scene,
    Strip,
    ink,
    rising,
    ticks,
)
from marlyap.report.words import short


VARIABLES = {colour: f"var(--c{k})" for k, colour in enumerate(PALETTE)}
VARIABLES |= {ALARM: "var(--alarm)", PAPER: "var(--raised)", INK: "var(--ink)"}
VARIABLES |= {SOFT: "var(--soft)", RULE: "var(--rule)", FAINT: "var(--faint)"}
HREF, SVG = "{http://www.w3.org/1999/xlink}href", "{http://www.w3.org/2000/svg}"
NUMBERS, COLOURS = re.compile(r"-?\d+\.\d+(?:e-?\d+)?"), re.compile(r"#[0-9a-f]{6}\b")
PLAIN = ("font-family", "stroke-linejoin", "stroke-linecap", "stroke-dashoffset")  # the page's own
ARROW = np.array([[1.2, 0.0], [-0.8, 0.75], [-0.8, -0.75], [1.2, 0.0]])  # heading along x
STRIP = 0.26  # height of a strip where the picture is 1 wide


def figure(
    width: float,
    height: float,
    dpi: int = 160,
    layout: Literal["constrained"] | None = "constrained",
) -> Figure:
    """A figure of its own, so that nobody's Matplotlib state is touched."""
    made = Figure(figsize=(width, height), dpi=dpi, facecolor=PAPER, layout=layout)
    FigureCanvasAgg(made)
    return made


# ---- a film ----


def heights(scene: Scene) -> list[float]:
    """Of the panels of a scene, or of its strips where it has no map; 1 is its width."""
    return [panel.height for panel in scene.panels] or [STRIP + 0.1] * len(scene.strips)


def whole(space: Any, scene: Scene) -> list[Axes]:
    """A whole episode in a figure or a part of one: the paths, or the signals without a map."""
    rows = space.subplots(len(heights(scene)), 1, squeeze=False, height_ratios=heights(scene))
    axes = [row[0] for row in rows]
    for at, panel in zip(axes, scene.panels, strict=False):
        ground(at, scene, panel)
        path(at, scene, panel)
        for artist in moment(scene, panel, len(scene.times) - 1, trail=False):
            at.add_artist(artist)
        at.set_ylabel(panel.labels[1], fontsize=8, color=SOFT)
    for at, strip in zip(axes, () if scene.panels else scene.strips, strict=False):
        band(at, scene, strip)
        curves(at, scene, strip)
    axes[-1].set_xlabel(
        scene.panels[-1].labels[0] if scene.panels else "time (s)", fontsize=8, color=SOFT
    )
    return axes


def ground(axes: Axes, scene: Scene, panel: Panel) -> None:
    """What stands still: the frame and the grid."""
    left, right, bottom, top = panel.window
    axes.set(xlim=(left, right), ylim=(bottom, top), xticks=ticks(left, right))
    if panel.lanes:
        bodies = scene.places.shape[1]
        shown = range(0, bodies, -(-bodies // 12))
        axes.set_yticks([-k for k in shown], [str(k) for k in shown])
    else:
        axes.set(aspect="equal", yticks=ticks(bottom, top, 5 if panel.height > 0.6 else 3))
        axes.yaxis.set_major_formatter(lambda value, _: short(value))
    axes.xaxis.set_major_formatter(lambda value, _: short(value))
    quiet(axes)


def path(axes: Axes, scene: Scene, panel: Panel) -> None:
    """The way of each body from its start, a small circle, with a dot every second."""
    for k in range(scene.places.shape[1]):
        way, colour = scene.places[:, k][:, panel.axes], scene.body_ink(k)
        axes.plot(*way.T, color=colour, linewidth=1.4, solid_capstyle="round")
        axes.plot(*way[scene.every_second].T, ".", color=colour, markersize=3.5)
        known = way[np.isfinite(way).all(1)][:1]
        axes.plot(*known.T, "o", color=colour, markersize=5, fillstyle="none")


def moment(scene: Scene, panel: Panel, k: int, trail: bool, size: int = 9) -> Iterator[Artist]:
    """What moves, at time `k`: goals, links, trails, bodies."""
    spots = scene.places[k][:, panel.axes]
    yield from _goals(scene, panel, k)
    segments = [spots[list(link)] for link in scene.links(k)]
    yield LineCollection(segments, colors=SOFT, linewidths=0.7, alpha=0.6)
    if trail:
        yield from (_trail(scene, panel, body, k) for body in range(len(spots)))
    rods = scene.film.frames.rods
    inks = [scene.body_ink(body) for body, _ in rods]
    yield LineCollection([spots[[*rod]] for rod in rods], colors=inks, linewidths=2.4)
    for body, spot in enumerate(spots):
        if np.isfinite(spot).all():
            yield from _body(scene, panel, body, k, spot, size)


def _goals(scene: Scene, panel: Panel, k: int) -> Iterator[Artist]:
    left, right, _, _ = panel.window
    radius = max(scene.edge, 0.008 * (right - left))
    for number, goal in enumerate(scene.goals[k][:, panel.axes]):
        if not np.isfinite(goal).all():
            continue
        colour = scene.goal_ink(number)
        look: Any = {"facecolor": to_rgba(colour, 0.07), "edgecolor": colour}
        look |= {"linestyle": (0, (3, 2)), "linewidth": 1}
        if panel.lanes:  # a stretch of the lane
            yield Rectangle(goal - (radius, 0.35), 2 * radius, 0.7, **look)
        else:
            yield Circle(goal, radius, **look)


def _trail(scene: Scene, panel: Panel, body: int, k: int) -> Artist:
    """The whole way so far, fading into a thin line."""
    way = scene.places[: k + 1, body][:, panel.axes]
    fresh = np.clip(1 - (scene.times[k] - scene.times[1 : k + 1]) / TRAIL, 0, 1)
    colours = np.tile(to_rgba(scene.body_ink(body)), (len(fresh), 1))
    colours[:, 3] = 0.3 + 0.7 * fresh
    pieces = np.stack([way[:-1], way[1:]], axis=1)
    return LineCollection(list(pieces), colors=colours, linewidths=1 + 1.6 * fresh)


def _body(
    scene: Scene, panel: Panel, body: int, k: int, spot: np.ndarray, size: int
) -> Iterator[Artist]:
    """An arrow where the heading is known and seen, else a disc; a leader is filled and ringed."""
    leads, colour = scene.leaders[body], scene.body_ink(body)
    x, y = [spot[0]], [spot[1]]
    seen = scene.angles is not None and panel.axes == (0, 1)
    angle = float(scene.angles[k, body]) if seen else np.nan  # pyright: ignore[reportOptionalSubscript]
    look: Any = {
        "color": colour,
        "linestyle": "none",
        "markerfacecolor": colour if leads else PAPER,
        "markeredgewidth": 1.3,
    }
    if np.isfinite(angle):
        turn = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
        yield Line2D(x, y, marker=Path(ARROW @ turn, closed=True), markersize=1.5 * size, **look)
    else:
        yield Line2D(x, y, marker="o", markersize=0.85 * size, **look)
    if leads:
        ring: Any = {
            "marker": "o",
            "linestyle": "none",
            "fillstyle": "none",
            "markeredgewidth": 1.0,
        }
        yield Line2D(x, y, color=colour, markersize=2 * size, **ring)


def band(axes: Axes, scene: Scene, strip: Strip) -> None:
    """The frame of a strip: its name above, its range, its mark."""
    low, high = strip.span
    room = 0.06 * (high - low)
    axes.set(xlim=(scene.times[0], scene.times[-1] + 1e-9), ylim=(low - room, high + room))
    axes.set_yticks(ticks(low, high, 3))
    axes.set_xticks(ticks(scene.times[0], scene.times[-1]))
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_formatter(lambda value, _: short(value))
    axes.set_title(strip.name, fontsize=8, color=SOFT, loc="left", pad=3)
    quiet(axes)
    if strip.mark is not None:
        axes.axhline(strip.mark, color=SOFT, linewidth=0.8, linestyle=(0, (4, 3)))


def curves(axes: Axes, scene: Scene, strip: Strip, alpha: float = 1.0) -> None:
    """All lines of a strip, its rises marked."""
    for artist in until(scene, strip, len(scene.times) - 1, alpha):
        axes.add_artist(artist)


def until(scene: Scene, strip: Strip, k: int, alpha: float = 1.0) -> Iterator[Artist]:
    """The lines of a strip up to time `k`, its rises marked."""
    times = scene.times[: k + 1]
    for number, values in enumerate(strip.lines):
        colour, width = (ink(number), 1.2) if strip.agents else (INK, 1.4)
        yield Line2D(times, values[: k + 1], color=colour, linewidth=width, alpha=alpha)
    if (up := np.flatnonzero(rising(strip)[:k])).size:
        points = np.stack([times, strip.lines[0][: k + 1]], axis=1)
        pieces = [points[n : n + 2] for n in up]
        yield LineCollection(pieces, colors=ALARM, linewidths=2.4, alpha=alpha)


# ---- charts ----


def chart(axes: Axes, shown: Chart) -> None:
    """The curves of a chart, with bands."""
    low, high = shown.y_span
    room = 0.04 * (high - low or 1.0)
    axes.set(ylim=(low - room, high + room), yticks=ticks(low, high))  # both ends are seen whole
    right = shown.x_span[1] or 1.0
    axes.set(xlim=(shown.x_span[0], 1.02 * right), xticks=ticks(shown.x_span[0], right))
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_formatter(lambda value, _: short(value))
    for line in shown.lines:
        if line.low is not None and line.high is not None:
            axes.fill_between(
                line.x, line.low, line.high, color=line.colour, alpha=0.12, linewidth=0
            )
        axes.plot(line.x, line.y, color=line.colour, linewidth=2.4 if line.thick else 1.2)
    axes.set_xlabel(shown.x_label, color=SOFT, fontsize=8)
    quiet(axes)


def legend(shown: Figure, names: Sequence[str]) -> None:
    """Colours and what they stand for, below the figure."""
    marks = [Line2D([], [], color=ink(k), linewidth=2.4) for k in range(len(names))]
    shown.legend(
        marks,
        names,
        loc="outside lower center",
        ncols=2,
        frameon=False,
        fontsize=8,
        labelcolor=SOFT,
    )


def quiet(axes: Axes) -> None:
    """A light grid, no tick marks, a thin frame."""
    axes.grid(color=FAINT, linewidth=0.8)
    axes.set_axisbelow(True)
    axes.tick_params(colors=SOFT, length=0, labelsize=7)
    for spine in axes.spines.values():
        spine.set_color(RULE)


# ---- SVG ----


def svg(shown: Figure, title: str, prefix: str) -> str:
    """A figure as an element of a page; `prefix` keeps its ids apart from those of others."""
    for artist in shown.findobj():
        artist.set_clip_on(False)  # a clip would be a reference to a URL
    shown.patch.set_visible(False)
    for axes in shown.axes:
        axes.patch.set_visible(False)
        for axis in (axes.xaxis, axes.yaxis):
            axis.set_tick_params(bottom=False, left=False, top=False, right=False)
    file = io.StringIO()
    nothing = dict.fromkeys(("Creator", "Date", "Format", "Type"))
    with matplotlib.rc_context({"svg.fonttype": "none", "svg.hashsalt": prefix}):
        shown.savefig(file, format="svg", metadata=nothing)
    root = ElementTree.fromstring(file.getvalue())
    used = dict.fromkeys(node.attrib[HREF] for node in root.iter() if HREF in node.attrib)
    names = {old.removeprefix("#"): f"{prefix}{k}" for k, old in enumerate(used)}
    body = "".join(_element(node, names) for node in root)
    view = f'viewBox="{root.attrib["viewBox"]}" role="img" aria-label="{escape(title)}"'
    return f"<svg {view}>{body}</svg>"


def _element(node: ElementTree.Element, names: Mapping[str, str]) -> str:
    """An element without what a page has already, such as fonts, and ids that none refers to."""
    tag = node.tag.removeprefix(SVG)
    inner = escape((node.text or "").strip(), quote=False)
    inner += "".join(_element(child, names) for child in node)
    if tag in ("metadata", "style") or (tag in ("g", "defs") and not inner):
        return ""
    if tag == "g" and not set(node.attrib) - {"id"}:
        return inner
    written = "".join(_attribute(key, value, names) for key, value in node.attrib.items())
    return f"<{tag}{written}>{inner}</{tag}>" if inner else f"<{tag}{written}/>"


def _attribute(key: str, value: str, names: Mapping[str, str]) -> str:
    if key == "id":
        return f' id="{names[value]}"' if value in names else ""
    if key == HREF:
        return f' href="#{names[value.removeprefix("#")]}"'
    if key == "transform" and value.startswith("rotate(-0 "):
        return ""
    value = NUMBERS.sub(lambda mark: _short(float(mark[0])), value)
    if key == "d":
        value = re.sub(r"\s*([A-Za-z])\s*", r"\1", value)
    if key == "style":
        rules = [rule for rule in value.split("; ") if not rule.startswith(PLAIN)]
        value = ";".join(rule.replace(": ", ":") for rule in rules)
        value = COLOURS.sub(lambda mark: VARIABLES.get(mark[0], mark[0]), value)
    return f' {key}="{escape(value)}"'


def _short(value: float) -> str:
    shown = f"{value:.{1 if abs(value) >= 10 else 2}f}"
    return shown.rstrip("0").rstrip(".") if "." in shown else shown
