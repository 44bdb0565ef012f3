"""Learning curves as Matplotlib figures, to be changed and saved by whoever asked for them."""

from collections import defaultdict
from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.figure import Figure

from marlyap.errors import UserError
from marlyap.report import plot
from marlyap.report.charts import mean_curve
from marlyap.report.scene import SOFT, ink
from marlyap.sweeps import table
from marlyap.sweeps.folder import Sweep


Curve = tuple[np.ndarray, np.ndarray]  # environment steps, and the metric at them


def plot_sweep(sweep: Sweep, metric: str = "success") -> Figure:
    """A metric of the logs of a sweep: a thin line a job, and the mean over the seeds of each cell.

    `figure.axes[0]` is the plot; `figure.savefig(path)` writes it. Raises UserError where no log
    has the metric.
    """
    label = {
        cell.name: " ".join(f"{name}={cell.set.get(name)}" for name in sweep.plan.varied)
        for cell in sweep.cells
    }
    found: dict[tuple[str, int], list[tuple[float, float]]] = defaultdict(list)
    for row in table.curves(sweep.statuses()):
        if row["metric"] == metric:
            found[row["cell"], row["seed"]].append((row["steps"], row["value"]))
    groups: dict[str, list[Curve]] = defaultdict(list)
    for (cell, _), points in found.items():
        x, y = np.array(points).T
        groups[label[cell] or "all"].append((x, y))
    return _drawn(groups, metric)


def _drawn(groups: Mapping[str, Sequence[Curve]], metric: str) -> Figure:
    """One colour a group."""
    if not groups:
        raise UserError(f"metric: no log has '{metric}' yet; log.jsonl names what there is.")
    figure = plot.figure(6.0, 3.6)
    axes = figure.subplots()
    for k, curves in enumerate(groups.values()):
        for x, y in curves if len(curves) > 1 else ():
            axes.plot(x, y, color=ink(k), linewidth=0.7, alpha=0.5)
        axes.plot(*mean_curve(curves), color=ink(k), linewidth=2.0)
    axes.set_xlabel("environment steps", color=SOFT, fontsize=8)
    axes.set_ylabel(metric, color=SOFT, fontsize=8)
    plot.quiet(axes)
    plot.legend(figure, [*groups])
    return figure
