"""A film as a picture: what to draw and where, the same for the page, PNG, GIF and player.

A picture has panels, views of the bodies, and strips, curves over time. In the plane there is one
panel, seen from above; in space two, from above and from the side, at one scale; on a road each
body has its own lane. A game without a map has strips alone.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from marlyap.report.data import Film, Frames, Number, Pairs
from marlyap.report.words import decimal, plain


# The colours of Okabe and Ito, one per agent or run; one is kept for what should not happen.
PALETTE = ("#0072b2", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#7a7d85")
ALARM = "#d55e00"
PAPER, INK, SOFT, RULE, FAINT = "#ffffff", "#1c1d20", "#5e6169", "#dddcd6", "#ecebe6"

TRAIL = 1.5  # s, for which a body's trail is drawn strongly
RISE = 1e-3  # of the largest value: a smaller rise is not marked
FLAT = 0.4  # least height of a view from above where its width is 1, and the scene is a row
MOST_STRIPS = 8
MOST_PLAYED = 300  # times of a film in the page; of a longer one every so many are left out


def ink(number: int) -> str:
    """The colour of an agent, a run or a group."""
    return PALETTE[number % len(PALETTE)]


@dataclass(frozen=True)
class Panel:
    """A view of the bodies: two of their coordinates in a rectangle."""

    axes: tuple[int, int]  # of `Scene.places`
    labels: tuple[str, str]
    window: tuple[float, float, float, float]  # left, right, bottom, top
    lanes: bool = False  # a road: a lane for each body, and another scale across

    @property
    def height(self) -> float:
        """Of a picture that is 1 wide."""
        left, right, bottom, top = self.window
        return (
            min(1.0, 0.16 + 0.07 * (top - bottom))
            if self.lanes
            else _over(top - bottom, right - left)
        )


@dataclass(frozen=True, eq=False)
class Strip:
    """Values over time, one line or one for each agent."""

    name: str  # with its unit
    lines: np.ndarray  # [line time]
    span: tuple[float, float]
    mark: Number = None  # a dashed line
    rises: bool = False  # rises are drawn in the colour of alarm
    agents: bool = False  # a line for each agent, in its colour


@dataclass(frozen=True, eq=False)
class Scene:
    """A film made regular."""

    film: Film
    places: np.ndarray  # [time body 2 or 3]; no bodies where there is no map
    angles: np.ndarray | None  # [time body], rad
    goals: np.ndarray  # [time goal 2 or 3]; one goal where all agents share theirs
    leaders: tuple[bool, ...]  # of each body
    panels: tuple[Panel, ...]
    strips: tuple[Strip, ...]

    @property
    def label(self) -> str:
        return self.film.label

    @property
    def times(self) -> np.ndarray:
        return self.film.frames.times

    @property
    def dt(self) -> float:
        return self.film.frames.dt

    @property
    def edge(self) -> float:
        return float(self.film.frames.edge or 0.0)

    @property
    def every_second(self) -> slice:
        """The times at which a path is dotted."""
        every = max(round(1 / self.dt), 1, len(self.times) // 60)
        return slice(every, -1, every)

    @property
    def detail(self) -> str:
        """Where it ended and where it came from, in a few words."""
        film, parts = self.film, []
        if film.distance is not None:
            parts.append(f"final distance {decimal(film.distance[-1], 3, film.unit)}")
        parts += [f"start {film.start}"] * bool(film.start)
        return " · ".join(parts)

    @property
    def who(self) -> str:
        """Who drives."""
        return self.film.run or self.film.label

    @property
    def ended(self) -> str:
        """How it ended, in a few words."""
        film, end = self.film, {None: "", True: "success", False: "failure"}[self.film.success]
        far = ""
        if film.distance is not None:
            far = f"final distance {decimal(film.distance[-1], 3, film.unit)}"
        return " · ".join(part for part in (end, far) if part)

    @property
    def outcome(self) -> str:
        """Whose episode it is, where that is said, and how it went."""
        end = {None: "", True: "success", False: "failure"}[self.film.success]
        return " · ".join(part for part in (self.film.run, self.detail, end) if part)

    @property
    def has_goals(self) -> bool:
        return self.goals.shape[1] > 0

    @property
    def own_goals(self) -> bool:
        """Whether each agent has a goal of its own."""
        return self.goals.shape[1] > 1

    @property
    def tints(self) -> list[int]:
        """The number of each body's colour."""
        joined = {b: a for a, b in self.film.frames.rods}
        return [joined.get(body, body) for body in range(self.places.shape[1])]

    def body_ink(self, body: int) -> str:
        return ink(self.tints[body])

    def goal_ink(self, number: int) -> str:
        return ink(number) if self.own_goals else INK

    def links(self, k: int) -> Pairs:
        """The links at time `k` whose two ends are known."""
        every = self.film.frames.links
        if not every or not self.places.size:
            return ()
        known = np.isfinite(self.places[k]).all(-1)
        pairs = every[k if len(every) > 1 else 0]
        return tuple((i, j) for i, j in pairs if max(i, j) < len(known) and known[i] and known[j])


def scenes(films: Sequence[Film]) -> list[Scene]:
    """Films as pictures, drawn to one scale unless they differ too much in size for that."""
    made = [_scene(film) for film in films]
    flat = [
        scene.panels[0].window
        for scene in made
        if len(scene.panels) == 1 and not scene.panels[0].lanes
    ]
    sides = [right - left for left, right, _, _ in flat]
    if len(flat) < len(made) or not sides or max(sides) > 2.5 * min(sides):
        return made
    return [framed(scene, max(sides)) for scene in made]


@dataclass(frozen=True, eq=False)
class Shot:
    """Films of one start, which can be seen side by side."""

    label: str
    scenes: tuple[Scene, ...]

    @property
    def told(self) -> str:
        """The start, and how the first of them ended."""
        first = self.scenes[0]
        start = f"start {first.film.start}" if first.film.start else ""
        many = f"{len(self.scenes)} controllers" if len(self.scenes) > 1 else ""
        return " · ".join(part for part in (start, many or first.film.run, first.ended) if part)


def shots(films: Sequence[Film]) -> list[Shot]:
    """Films by their start, those of one start drawn to one scale."""
    groups: dict[str, list[Scene]] = {}
    for k, scene in enumerate(scenes(films)):
        groups.setdefault(scene.film.shot or f"alone {k}", []).append(scene)
    return [
        Shot(those[0].film.title or those[0].label, aligned(those)) for those in groups.values()
    ]


def aligned(those: Sequence[Scene]) -> tuple[Scene, ...]:
    """Scenes with the same windows, and their strips at one scale, those that all have first."""
    if len({len(scene.panels) for scene in those}) > 1:
        return tuple(those)
    windows = [_around(same) for same in zip(*(scene.panels for scene in those), strict=True)]
    spans: dict[str, tuple[float, float]] = {}
    for strip in (strip for scene in those for strip in scene.strips):
        low, high = spans.get(strip.name, strip.span)
        spans[strip.name] = (min(low, strip.span[0]), max(high, strip.span[1]))
    shared = set.intersection(*({strip.name for strip in scene.strips} for scene in those))
    in_order = lambda scene: sorted(scene.strips, key=lambda strip: strip.name not in shared)
    return tuple(
        replace(
            scene,
            panels=tuple(replace(p, window=w) for p, w in zip(scene.panels, windows, strict=True)),
            strips=tuple(replace(strip, span=spans[strip.name]) for strip in in_order(scene)),
        )
        for scene in those
    )


def _around(panels: Sequence[Panel]) -> tuple[float, float, float, float]:
    """A window that shows all of several; square where each of them is."""
    low, high = (pick([panel.window for panel in panels], axis=0) for pick in (np.min, np.max))
    left, right, bottom, top = (float(v) for v in (low[0], high[1], low[2], high[3]))
    if any(panel.lanes or abs(panel.height - 1) > 1e-6 for panel in panels):
        return left, right, bottom, top
    half, x, y = max(right - left, top - bottom) / 2, (left + right) / 2, (bottom + top) / 2
    return x - half, x + half, y - half, y + half


def framed(scene: Scene, side: float) -> Scene:
    """A scene in the plane, shown as wide as this side."""
    left, right, bottom, top = scene.panels[0].window
    x, y, tall = (left + right) / 2, (bottom + top) / 2, side * scene.panels[0].height
    window = x - side / 2, x + side / 2, y - tall / 2, y + tall / 2
    return replace(scene, panels=(replace(scene.panels[0], window=window),))


def _scene(film: Film) -> Scene:
    frames = film.frames
    time, d = len(frames.times), 0 if frames.positions is None else frames.positions.shape[2]
    bodies = 0 if frames.positions is None else frames.positions.shape[1]
    places = np.zeros((time, 0, 2)) if frames.positions is None else frames.positions
    goals = places[:, :0] if frames.goals is None or not bodies else frames.goals
    if d == 1:
        places, goals = _on_lanes(places), _on_lanes(goals)
    elif goals.shape[1] > 1 and np.array_equal(
        goals, np.broadcast_to(goals[:, :1], goals.shape), equal_nan=True
    ):
        goals = goals[:, :1]
    angles = None
    if frames.headings is not None and bodies and d > 1:
        angles = np.arctan2(frames.headings[..., 1], frames.headings[..., 0])
    return Scene(
        film=film,
        places=places,
        angles=angles,
        goals=goals,
        leaders=(*map(bool, frames.leaders), *[False] * bodies)[:bodies],
        panels=_panels(places, goals, d, frames),
        strips=_strips(film),
    )


def _on_lanes(x: np.ndarray) -> np.ndarray:
    """Places on a road and the lane of each body, the first on top."""
    lane = np.broadcast_to(-np.arange(x.shape[1], dtype=float)[None, :, None], x.shape)
    return np.concatenate([x, lane], axis=2)


def _panels(places: np.ndarray, goals: np.ndarray, d: int, frames: Frames) -> tuple[Panel, ...]:
    if d == 0:
        return ()
    radius = float(frames.edge or 0.0)
    name = lambda axis: f"{axis} ({frames.unit})" if frames.unit else axis
    corners = [places, goals - radius, goals + radius]
    cloud = np.concatenate([part.reshape(-1, part.shape[-1]) for part in corners])
    cloud = cloud[np.isfinite(cloud).all(-1)]
    if not len(cloud):
        cloud = np.array([[-1.0] * places.shape[-1], [1.0] * places.shape[-1]])
    low, high = cloud.min(0), cloud.max(0)
    middle, extent = (low + high) / 2, high - low
    if d == 1:
        side = 1.12 * max(float(extent[0]), 6 * radius, 1e-3)
        x = float(middle[0])
        window = x - side / 2, x + side / 2, 0.3 - places.shape[1], 0.7
        return (Panel((0, 1), (name("x"), "body"), window, lanes=True),)
    side = 1.12 * max(float(extent[:2].max()), 6 * radius, 1e-3)
    tall = side if d > 2 or extent[1] > FLAT * extent[0] else FLAT * side
    half = [side / 2, tall / 2, max(float(extent[-1]) / 2 + 0.07 * side, side / 8)]
    view = lambda a, b: (
        *(float(middle[a] - half[a]), float(middle[a] + half[a])),
        *(float(middle[b] - half[b]), float(middle[b] + half[b])),
    )
    pairs = [(0, 1), (0, 2)][: d - 1]
    return tuple(Panel((a, b), (name("xyz"[a]), name("xyz"[b])), view(a, b)) for a, b in pairs)


def _strips(film: Film) -> tuple[Strip, ...]:
    frames, made = film.frames, []
    if film.level is not None:
        name = f"{film.level_name} (Lyapunov)" if film.rises else film.level_name
        made.append(Strip(name, film.level[None], _span(film.level), rises=film.rises))
    if film.distance is not None:
        name = f"largest distance ({film.unit})" if film.unit else "largest distance"
        most = _span(np.append(film.distance, film.edge or 0.0))
        made.append(Strip(name, film.distance[None], most, mark=film.edge))
    if film.cost is not None:
        made.append(Strip("cost", film.cost[None], _span(film.cost)))
    for name, values in frames.signals.items():
        made.append(Strip(name, values.T, _span(values, zero=False), agents=True))
    return tuple(made[:MOST_STRIPS])


def _span(values: np.ndarray, zero: bool = True) -> tuple[float, float]:
    """The range of a strip, from 0 where `zero`; never empty."""
    known = values[np.isfinite(values)]
    if not len(known):
        return 0.0, 1.0
    low, high = (0.0 if zero else float(known.min())), float(known.max())
    if not zero and high - low < 1e-9 * max(abs(high), abs(low), 1e-300):
        return low - 0.5 * (abs(low) or 1.0), high + 0.5 * (abs(high) or 1.0)
    return low, high if high > low else low + 1.0


def rising(strip: Strip) -> np.ndarray:
    """Whether the first line of a strip rises noticeably into each time but the first."""
    values = strip.lines[0]
    return (
        np.diff(values) > RISE * strip.span[1] if strip.rises else np.zeros(len(values) - 1, bool)
    )


def ticks(low: float | int, high: float | int, about: int = 5) -> list[float]:
    """Round numbers from `low` to `high`, roughly `about` of them."""
    if not high > low:
        return [float(low)]
    rough = (high - low) / about
    power = 10.0 ** math.floor(math.log10(rough))
    step = power * next(m for m in (1, 2, 5, 10) if m * power >= rough * 0.8)
    return [
        k * step for k in range(math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9) + 1)
    ]


def _over(a: float, b: float) -> float:
    return a / b if b else 1.0


def played(scene: Scene) -> dict[str, Any]:
    """What the player of the page reads: numbers, rounded, with None for what is not finite."""
    stride = -(-len(scene.times) // MOST_PLAYED)
    moving = not np.array_equal(scene.goals, np.broadcast_to(scene.goals[:1], scene.goals.shape))
    links = scene.film.frames.links
    return {
        "label": scene.label,
        "who": scene.who,
        "ended": scene.ended,
        "dt": scene.dt * stride,
        "steps": len(scene.times[::stride]),
        "radius": scene.edge,
        "unit": scene.film.frames.unit,
        "goals": plain(scene.goals[::stride] if moving else scene.goals[:1]),
        "positions": plain(scene.places[::stride]),
        "headings": None if scene.angles is None else plain(scene.angles[::stride], 3),
        "leaders": scene.leaders,
        "rods": scene.film.frames.rods,
        "tints": scene.tints,
        "edges": (links[::stride] if len(links) > 1 else links) or ((),),
        "panels": [vars(panel) for panel in scene.panels],
        "strips": [vars(strip) | {"lines": _rounded(strip, stride)} for strip in scene.strips],
    }


def _rounded(strip: Strip, stride: int) -> list[list[Number]]:
    """Four digits: of each value where the axis begins at 0, else of the axis."""
    low, high = strip.span
    lines = strip.lines[:, ::stride]
    if not low:
        return plain(lines, significant=True)
    return plain(lines, 4 - math.floor(math.log10(high - low)))
