"""Figures for papers: charts of runs as Matplotlib axes, which one can change, and as files.

from marlyap import plot
axes = plot(["runs/mine"], "learning")
axes.set_title("mine")
axes.figure.savefig("fig.pdf")
"""

import io
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, cast

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from marlyap.errors import UserError
from marlyap.report.charts import KINDS, Chart, Kind, Line, Told, charts, learning_curve, teams
from marlyap.report.measuring import logged, measured
from marlyap.runs.run import Run, expand
from marlyap.statistics import mean_interval
from marlyap.storage.store import write_bytes_atomic


BANDS = ("range", "interval")
OF_LOGS = ("learning", "return")  # kinds that need no evaluation
DASHES = ("-", (0, (5, 2)), (0, (1.2, 1.6)), (0, (5, 2, 1.2, 2)), (0, (8, 2)), (0, (3, 1.5)))
STYLE: dict[Any, Any] = {
    "font.family": "sans-serif",
    "font.size": 8,
    "axes.labelsize": 8,
    "legend.fontsize": 7,
    "xtick.labelsize": 7,
    "ytick.labelsize": 7,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "pdf.fonttype": 42,  # TrueType, embedded: text stays text
    "ps.fonttype": 42,
    "svg.fonttype": "none",
}
FORMATS = ("pdf", "svg", "eps", "png")


def plot(
    runs: Sequence[Run | Path | str],
    kind: str = "learning",
    axes: Axes | None = None,
    *,
    band: str = "range",
    episodes: int = 500,
    seed: int = 0,
    width: float = 3.5,
) -> Axes:
    """One chart of runs: a line and a band for each configuration.

    Args:
        runs: runs, or their directories.
        kind: "learning" and "return" are of the logs; "radius", "distance" and "cost" evaluate.
        axes: where to draw; by default a new figure.
        band: of a learning curve over several seeds: "range" is the lowest and the highest of them,
            "interval" the 95 % interval for the expectation over seeds (`mean_interval`).
        episodes: held-out starts of an evaluation.
        seed: of those starts.
        width: of a new figure (inches); 3.5 is a column of IEEE's.

    Returns the axes. Raises UserError for an unknown kind or band, and where nothing is known.
    """
    if kind not in KINDS:
        raise UserError(f"what: there is no chart called '{kind}'; take {', '.join(KINDS)}.")
    if band not in BANDS:
        raise UserError(f"band: there is no band called '{band}'; take range or interval.")
    opened = [run if isinstance(run, Run) else Run.open(run) for run in _each(runs)]
    shown = _shown(opened, cast(Kind, kind), band, episodes, seed)
    with styled():
        at = axes if axes is not None else _new(width)
        _draw(at, shown)
    return at


def _each(runs: Sequence[Run | Path | str]) -> list[Run | Path]:
    """Every run, a directory of several standing for those in it."""
    made: list[Run | Path] = []
    for run in runs:
        made += [run] if isinstance(run, Run) else expand([run])
    return made


def _shown(runs: Sequence[Run], kind: Kind, band: str, episodes: int, seed: int) -> Chart:
    """The chart, its runs of one game or, of a learning curve, of several."""
    if kind in OF_LOGS:
        trained, groups = logged(runs), ()
    else:
        found = measured(runs, episodes, seed)
        trained, groups = found.trained(), found.grouped()
    made = charts(trained, groups, [kind])
    if not made:
        raise UserError(f"what: nothing is known for the chart {kind} of these runs.")
    if len(made) > 1:
        games = " and ".join(dict.fromkeys(chart.game for chart in made))
        raise UserError(f"runs: they are of {games}; a figure shows one game, name its runs.")
    chart = made[0]
    if band == "interval" and kind == "learning":
        lines = [_interval(line, Told(trained, groups)) for line in chart.lines]
        return Chart(**{**vars(chart), "lines": tuple(lines)})
    return chart


def _interval(line: Line, told: Told) -> Line:
    """A group's line with the interval for the expectation over seeds instead of their range."""
    if line.member is not None:
        return line
    group = teams(told.runs)[line.team]
    curves = [learning_curve(run, "success") for run in told.runs if run.group == group]
    rates = np.array([np.interp(line.x, *curve) for curve in curves if len(curve[0])])
    ends = np.array([mean_interval(list(at), 0.95) for at in rates.T])
    return Line(**{**vars(line), "low": 100 * ends[:, 0], "high": 100 * ends[:, 1]})


@contextmanager
def styled() -> Iterator[None]:
    """The style of these figures; nothing of it stays behind."""
    with matplotlib.rc_context(STYLE):
        yield


def _new(width: float) -> Axes:
    if not 1 <= width <= 20:
        raise UserError(f"width: {width:g} inches is out of range; take 1 to 20.")
    return Figure(figsize=(width, 0.68 * width), layout="constrained").subplots()


def _draw(axes: Axes, chart: Chart) -> None:
    """Thick lines with bands, told apart by colour and dashes; seeds of a group faintly."""
    several = any(line.member is None for line in chart.lines)
    dashes = iter(DASHES * (1 + len(chart.lines) // len(DASHES)))
    for line in chart.lines:
        minor = several and line.member is not None and line.low is None and _in_group(chart, line)
        look = {"linewidth": 0.6, "alpha": 0.35} if minor else {"linewidth": 1.4}
        name = line.label.removesuffix(": mean over the runs")
        said = {} if minor else {"label": name, "linestyle": next(dashes)}
        if line.low is not None and line.high is not None:
            shade = {"color": line.colour, "alpha": 0.18, "linewidth": 0}
            axes.fill_between(line.x, line.low, line.high, **shade)
        axes.plot(line.x, line.y, color=line.colour, **look, **said)
    axes.set(xlabel=chart.x_label, ylabel=chart.y_label)
    if chart.log_x:
        axes.set_xscale("log")
    if chart.y_span == (0.0, 100.0):
        axes.set_ylim(-2, 102)
    axes.grid(linewidth=0.4, alpha=0.4)
    axes.legend(frameon=False)


def _in_group(chart: Chart, line: Line) -> bool:
    """Whether the group of a run has a line of its own."""
    return any(o.member is None and o.team == line.team for o in chart.lines)


def save(figure: Any, path: Path) -> None:
    """Write a Matplotlib figure in the format that its name ends with, fonts embedded.

    Raises UserError for another ending, and where the file cannot be written.
    """
    kind = path.suffix.lstrip(".").lower()
    if kind not in FORMATS:
        raise UserError(f"out: {path.name} should end in .{', .'.join(FORMATS)}.")
    dated: dict[str, Any] = {"metadata": {"CreationDate": None}} if kind == "pdf" else {}
    text = io.BytesIO()
    with styled():
        figure.savefig(text, format=kind, dpi=300, **dated)
    write_bytes_atomic(path, lambda file: file.write(text.getvalue()))
