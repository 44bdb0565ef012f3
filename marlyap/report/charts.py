"""Curves as charts: what training and evaluation found, for the page, for PNG and for papers."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from marlyap.report.data import Along, Figures, Group, Number, Trained
from marlyap.report.scene import INK, PALETTE, ink
from marlyap.report.words import DASH, number, pair


Curve = tuple[np.ndarray, np.ndarray]
Key = Literal["success", "total"]
Kind = Literal["learning", "return", "radius", "distance", "cost"]
KINDS: tuple[Kind, ...] = ("learning", "return", "radius", "distance", "cost")
MOST_POINTS = 160  # of a distribution or a strip
FLAT = 1e-6  # of the largest distance: what is nearer is drawn there on a logarithmic axis


@dataclass(frozen=True, eq=False)
class Line:
    """One curve of a chart."""

    x: np.ndarray
    y: np.ndarray
    colour: str
    thick: bool = False
    low: np.ndarray | None = None  # of a band around it
    high: np.ndarray | None = None
    label: str = ""
    team: int = 0  # the number of its group
    member: int | None = None  # the number of its run; None for a whole group


@dataclass(frozen=True, eq=False)
class Chart:
    """Curves in a frame."""

    kind: Kind
    caption: str
    x_label: str
    y_label: str
    lines: tuple[Line, ...]
    x_span: tuple[float, float]
    y_span: tuple[float, float]
    game: str = ""
    log_x: bool = False


def charts(
    runs: Sequence[Trained], groups: Sequence[Group] = (), kinds: Sequence[Kind] = KINDS
) -> list[Chart]:
    """What is known of success, distances, costs and learning, a set of charts for each game."""
    games = list(dict.fromkeys(run.game for run in runs))
    made = [DRAWN[kind](Told(runs, groups, game)) for game in games for kind in kinds]
    return [chart for chart in made if chart is not None]


# ---- who is who ----


def legend(runs: Sequence[Trained]) -> list[str]:
    """What each colour stands for: a configuration, or a run where there is one configuration."""
    groups = teams(runs)
    if len(groups) <= 1:
        return [name(run) for run in runs]
    sizes = [sum(run.group == group for run in runs) for group in groups]
    seeds = [f" ({n} seed{'s' * (n != 1)})" for n in sizes]
    return [group + said for group, said in zip(groups, seeds, strict=True)]


def name(run: Trained) -> str:
    return run.label or run.name or DASH


def colours(runs: Sequence[Trained]) -> list[int]:
    """One colour per configuration when there are several, else one per run."""
    groups = teams(runs)
    several = len(groups) > 1
    return [groups.index(run.group) if several else k for k, run in enumerate(runs)]


def teams(runs: Sequence[Trained]) -> list[str]:
    """The configurations, in order of appearance."""
    return list(dict.fromkeys(run.group for run in runs))


@dataclass(frozen=True)
class Told:
    """The runs of one game, with the colours that they have among all runs."""

    runs: Sequence[Trained]  # of every game
    groups: Sequence[Group]
    game: str | None = None  # None: of every game

    @property
    def those(self) -> list[int]:
        """The numbers of the runs of this game."""
        return [k for k, r in enumerate(self.runs) if self.game is None or r.game == self.game]

    @property
    def unit(self) -> str:
        """Of the distances, where all of these runs share it."""
        units = {self.runs[k].unit for k in self.those}
        return units.pop() if len(units) == 1 else ""

    @property
    def asked(self) -> str:
        return f" ({self.unit})" if self.unit else ""

    def lines(
        self,
        each: Callable[[Figures], Curve | None],
        band: Callable[[Figures], Curve | None],
        joined: Callable[[list[Curve]], tuple[Curve, Curve | None] | None] | None = None,
    ) -> tuple[Line, ...]:
        """A line for each run; where a group has several, a thick one with a band for the group.

        `each` is the curve of a run or a group, `band` its lower and upper ends, and `joined` makes
        a group's curve and band of those of its runs where its own figures do not tell.
        """
        made: list[Line] = []
        for team, group in enumerate(teams(self.runs)):
            own = [k for k in self.those if self.runs[k].group == group]
            alone = len(own) == 1
            curves = [(k, curve) for k in own if (curve := each(self.runs[k])) is not None]
            for k, (x, y) in curves:
                low, high = (band(self.runs[k]) if alone else None) or (None, None)
                tint = ink(colours(self.runs)[k])
                made.append(Line(x, y, tint, False, low, high, name(self.runs[k]), team, k))
            if not alone and curves:
                made += self._whole(group, team, [c for _, c in curves], each, band, joined)
        return tuple(made)

    def _whole(self, group, team, curves, each, band, joined) -> list[Line]:
        """The line of a group with several runs; none where nothing is known of it."""
        figures = next((g for g in self.groups if g.label == group), None)
        if joined is not None:
            found = joined(curves)
        else:
            curve = None if figures is None else each(figures)
            found = None if curve is None else (curve, None if figures is None else band(figures))
        if found is None:
            return []
        (x, y), ends = found
        low, high = ends or (None, None)
        colour = ink(team) if len(teams(self.runs)) > 1 else INK
        said = f"{group or 'all'}: mean over the runs"
        return [Line(x, y, colour, True, low, high, said, team)]

    def chart(
        self, kind: Kind, caption: str, axes: tuple[str, str], lines: Sequence[Line], **more
    ) -> Chart | None:
        """The lines in a frame; None where there are none."""
        if not any(len(line.x) for line in lines):
            return None
        ends = lambda parts: (float(np.min(parts)), float(np.max(parts)))
        x = ends(np.concatenate([line.x for line in lines]))
        tall = [v for line in lines for v in (line.y, line.low, line.high) if v is not None]
        span = {
            "x_span": (0.0, x[1]),
            "y_span": ends(np.concatenate(tall)),
            "game": self.game or "",
        }
        return Chart(kind, caption, *axes, tuple(lines), **span | more)


# ---- learning ----


def learning_curve(run: Trained, key: Key) -> Curve:
    """What the log of a run says of `key` against environment steps, without the gaps."""
    points = [(number(row.steps), number(getattr(row, key))) for row in run.log]
    known = np.array([point for point in points if None not in point], dtype=float).reshape(-1, 2)
    return known[:, 0], known[:, 1]


def mean_curve(curves: Sequence[Curve]) -> Curve:
    """The mean over several curves where all of them reach, on the steps of the first."""
    grid, values = _on_one_grid(curves)
    return (grid, values.mean(axis=0)) if len(values) else (grid, np.zeros(0))


def _on_one_grid(curves: Sequence[Curve]) -> tuple[np.ndarray, np.ndarray]:
    """Steps [time] that all curves reach, those of the first, and the values [curve time] there."""
    curves = [curve for curve in curves if len(curve[0])]
    if not curves:
        return np.zeros(0), np.zeros((0, 0))
    low, high = max(x[0] for x, _ in curves), min(x[-1] for x, _ in curves)
    grid = curves[0][0][(curves[0][0] >= low) & (curves[0][0] <= high)]
    return grid, np.array([np.interp(grid, x, y) for x, y in curves])


def _over_seeds(curves: list[Curve]) -> tuple[Curve, Curve] | None:
    """The mean of several curves, and the lowest and highest of them."""
    grid, values = _on_one_grid(curves)
    if not len(grid):
        return None
    return (grid, values.mean(axis=0)), (values.min(axis=0), values.max(axis=0))


def learning(told: Told, key: Key) -> Chart | None:
    """Thin a line per run, thick the mean of each configuration, in the range of its seeds."""
    scale = 100 if key == "success" else 1

    def each(run):
        steps, values = learning_curve(run, key)
        return (steps, scale * values) if len(steps) else None

    lines = told.lines(each, lambda run: None, _over_seeds)
    thick = any(line.thick for line in lines)
    seeds = "; thin a run, thick the mean, shaded the range of the seeds" if thick else ""
    title = {"success": "Success during training (%)", "total": "Return of an episode"}[key]
    caption = title + ("" if key == "success" else " (sum of rewards)") + seeds
    more = {"y_span": (0.0, 100.0)} if key == "success" else {}
    kind: Kind = "learning" if key == "success" else "return"
    return told.chart(kind, caption, ("environment steps", title), lines, **more)


# ---- evaluation ----


def by_radius(told: Told) -> Chart | None:
    """Success against how near is near enough."""
    rows = lambda run: np.array(within(run)).T * [[1], [100], [100], [100]]
    each = lambda run: tuple(rows(run)[:2]) if within(run) else None
    ends = lambda run: tuple(rows(run)[2:]) if within(run) else None
    caption = f"Success (%) against the radius asked{told.asked}, bands of 95 %"
    axes = f"radius{told.asked}", "success (%)"
    return told.chart("radius", caption, axes, told.lines(each, ends), y_span=(0.0, 100.0))


def within(run: Figures) -> list[tuple[float, float, float, float]]:
    """What is known of success by radius: radius, rate, and the ends of the interval."""
    known = []
    for part in run.radii:
        radius, rate = number(part.radius), number(part.success_rate)
        if radius is not None and rate is not None:
            known.append((radius, rate, *(pair(part.interval) or (rate, rate))))
    return sorted(known)


def distances(told: Told) -> Chart | None:
    """How near the worst agent ends: the share of the episodes that end within each distance."""
    lines = told.lines(_distribution, lambda run: None)
    caption = f"Episodes (%) whose worst agent ends within a distance{told.asked}"
    axes = f"final distance{told.asked}", "episodes (%)"
    edges = [x for line in lines for x in (line.x[0], line.x[-1])]
    span = {"x_span": (min(edges, default=0.0), max(edges, default=1.0)), "y_span": (0.0, 100.0)}
    return told.chart("distance", caption, axes, lines, log_x=True, **span)


def _distribution(run: Figures) -> Curve | None:
    """The distances in order, and the share of the episodes that end no farther."""
    known = np.sort([x for value in run.finals if (x := number(value)) is not None])
    if not len(known) or known[-1] <= 0:
        return None
    share = 100 * np.arange(1, len(known) + 1) / len(run.finals)
    picked = np.unique(np.linspace(0, len(known) - 1, MOST_POINTS).round().astype(int))
    return np.maximum(known, FLAT * known[-1])[picked], share[picked]


def costs(told: Told) -> Chart | None:
    """The cost of a step along the episode."""
    each = lambda run: None if run.along is None else (run.along.times, run.along.mean)
    ends = lambda run: None if run.along is None else (run.along.low, run.along.high)
    caption = "Cost of a step along the episode; shaded, where 90 % of the starts lie"
    return told.chart("cost", caption, ("time (s)", "cost of a step"), told.lines(each, ends))


def along(costs: np.ndarray, dt: Number) -> Along:
    """Costs [episode, time] as a strip."""
    stride = -(-costs.shape[1] // MOST_POINTS)
    low, high = np.nanquantile(costs, [0.05, 0.95], axis=0)
    times = np.arange(costs.shape[1]) * float(dt or 0.0)
    made = {"times": times, "mean": np.nanmean(costs, axis=0), "low": low, "high": high}
    return Along(**{name: values[::stride] for name, values in made.items()})


DRAWN: dict[Kind, Callable[[Told], Chart | None]] = {
    "learning": lambda told: learning(told, "success"),
    "return": lambda told: learning(told, "total"),
    "radius": by_radius,
    "distance": distances,
    "cost": costs,
}


def tint(colour: str) -> int:
    """The number of a colour in the palette; -1 for ink."""
    return PALETTE.index(colour) if colour in PALETTE else -1
