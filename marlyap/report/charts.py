"""Curves as pictures: what training and evaluation found, for the page and for PNG."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from marlyap.report.data import Figures, Trained
from marlyap.report.scene import INK, ink
from marlyap.report.words import DASH, number, pair


Curve = tuple[np.ndarray, np.ndarray]
Key = Literal["success", "total"]


@dataclass(frozen=True, eq=False)
class Line:
    """One curve of a chart."""

    x: np.ndarray
    y: np.ndarray
    colour: str
    thick: bool = False
    low: np.ndarray | None = None  # of a band around it
    high: np.ndarray | None = None
    notes: tuple[str, ...] = ()  # said of each point, which is dotted then


@dataclass(frozen=True, eq=False)
class Chart:
    """Curves in a frame."""

    caption: str
    x_label: str
    y_label: str
    lines: tuple[Line, ...]
    x_span: tuple[float, float]
    y_span: tuple[float, float]


def charts(runs: Sequence[Trained]) -> list[Chart]:
    """What is known of success by radius, and of learning."""
    made = [by_radius(runs), learning(runs, "success"), learning(runs, "total")]
    return [chart for chart in made if chart is not None]


def legend(runs: Sequence[Trained]) -> list[str]:
    """What each colour stands for: a configuration, or a run where there is one configuration."""
    groups = _groups(runs)
    if len(groups) <= 1:
        return [name(run) for run in runs]
    sizes = [sum(run.group == group for run in runs) for group in groups]
    seeds = [f" ({n} seed{'s' * (n != 1)})" for n in sizes]
    return [group + said for group, said in zip(groups, seeds, strict=True)]


def name(run: Trained) -> str:
    return run.label or run.name or DASH


def colours(runs: Sequence[Trained]) -> list[int]:
    """One colour per configuration when there are several, else one per run."""
    groups = _groups(runs)
    several = len(groups) > 1
    return [groups.index(run.group) if several else k for k, run in enumerate(runs)]


def _groups(runs: Sequence[Trained]) -> list[str]:
    """The configurations, in order of appearance."""
    return list(dict.fromkeys(run.group for run in runs))


def learning_curve(run: Trained, key: Key) -> Curve:
    """What the log of a run says of `key` against environment steps, without the gaps."""
    points = [(number(row.steps), number(getattr(row, key))) for row in run.log]
    known = np.array([point for point in points if None not in point], dtype=float).reshape(-1, 2)
    return known[:, 0], known[:, 1]


def mean_curve(curves: Sequence[Curve]) -> Curve:
    """The mean over several curves where all of them reach, on the steps of the first."""
    curves = [curve for curve in curves if len(curve[0])]
    if not curves:
        return np.zeros(0), np.zeros(0)
    low, high = max(x[0] for x, _ in curves), min(x[-1] for x, _ in curves)
    grid = curves[0][0][(curves[0][0] >= low) & (curves[0][0] <= high)]
    return grid, np.mean([np.interp(grid, x, y) for x, y in curves], axis=0)


def learning(runs: Sequence[Trained], key: Key) -> Chart | None:
    """Thin a line per run, thick the mean of each configuration; None where nothing is known."""
    scale = 100 if key == "success" else 1
    curves = [(x, scale * y) for x, y in (learning_curve(run, key) for run in runs)]
    if not any(len(x) for x, _ in curves):
        return None
    x_all, y_all = (np.concatenate(values) for values in zip(*curves, strict=True))
    tints = colours(runs)
    lines = [Line(x, y, ink(tint)) for (x, y), tint in zip(curves, tints, strict=True)]
    for group in _groups(runs):
        own = [k for k, run in enumerate(runs) if run.group == group]
        if len(own) > 1:
            colour = ink(tints[own[0]]) if len(_groups(runs)) > 1 else INK
            lines.append(Line(*mean_curve([curves[k] for k in own]), colour, thick=True))
    seeds = ", one thin line per run, thick the mean" if len(runs) > 1 else ""
    title = {"success": "Success during training (%)", "total": "Return of an episode"}[key]
    caption = title + ("" if key == "success" else " (sum of rewards)") + seeds
    span = (0.0, 100.0) if key == "success" else (float(y_all.min()), float(y_all.max()))
    return Chart(caption, "environment steps", title, tuple(lines), (0.0, float(x_all.max())), span)


def by_radius(runs: Sequence[Trained]) -> Chart | None:
    """Success against how near is near enough."""
    known, lines = [within(run) for run in runs], []
    if not any(known):
        return None
    units = {run.unit for run in runs}
    unit = units.pop() if len(units) == 1 else ""
    for rows, tint in zip(known, colours(runs), strict=True):
        if rows:
            radius, rate, low, high = np.array(rows).T * [[1], [100], [100], [100]]
            notes = tuple(
                f"{q:.3g} % within {p:g} {unit}" for p, q in zip(radius, rate, strict=True)
            )
            lines.append(Line(radius, rate, ink(tint), False, low, high, notes))
    most = max(row[-1][0] for row in known if row)
    asked = f" ({unit})" if unit else ""
    caption = f"Success (%) against the radius asked{asked}, bands of 95 %"
    axis = f"radius{asked}"
    return Chart(caption, axis, "success (%)", tuple(lines), (0.0, most), (0.0, 100.0))


def within(run: Figures) -> list[tuple[float, float, float, float]]:
    """What is known of success by radius: radius, rate, and the ends of the interval."""
    known = []
    for part in run.radii:
        radius, rate = number(part.radius), number(part.success_rate)
        if radius is not None and rate is not None:
            known.append((radius, rate, *(pair(part.interval) or (rate, rate))))
    return sorted(known)
