"""Pictures as PNG files."""

import math
from collections.abc import Sequence
from pathlib import Path

from matplotlib.figure import Figure

from marlyap.errors import UserError
from marlyap.report import charts, plot
from marlyap.report.data import Film, Trained
from marlyap.report.scene import INK, SOFT, scenes
from marlyap.storage.store import write_bytes_atomic


MOST_SHOWN = 12


def trajectories_png(films: Sequence[Film], path: str | Path) -> None:
    """The paths of several episodes side by side.

    Raises UserError if there is no film, or the file cannot be written.
    """
    shown = scenes(films)[:MOST_SHOWN]
    if not shown:
        raise UserError("films: there is no film to draw.")
    columns, rows = min(len(shown), 3), math.ceil(len(shown) / 3)
    height = 0.25 + 3.6 * max(sum(plot.heights(scene)) for scene in shown)
    figure = plot.figure(3.6 * columns, rows * height)
    spaces = figure.subfigures(rows, columns, squeeze=False).ravel()
    for space, scene in zip(spaces, shown, strict=False):
        plot.whole(space, scene)
        title = "\n".join(_wrapped(part) for part in (scene.label, scene.detail))
        space.suptitle(title, fontsize=8, color=INK, x=0.02, ha="left")
    _save(figure, path)


def _wrapped(text: str, most: int = 62) -> str:
    return text if len(text) <= most else text[: most - 1] + "…"


def learning_curves_png(runs: Sequence[Trained], path: str | Path) -> None:
    """Success and return against environment steps: a line per run, and each group's mean.

    Raises UserError if the file cannot be written.
    """
    told = charts.Told(runs, ())
    both = charts.learning(told, "success"), charts.learning(told, "total")
    known = [chart for chart in both if chart is not None]
    figure = plot.figure(8.4, 3.4)
    for axes, chart in zip(figure.subplots(1, 2), known, strict=False):
        plot.chart(axes, chart)
        axes.set_ylabel(chart.y_label, color=SOFT, fontsize=8)
    plot.legend(figure, charts.legend(runs))
    _save(figure, path)


def _save(figure: Figure, path: str | Path) -> None:
    write_bytes_atomic(Path(path), lambda file: figure.savefig(file, format="png"))
