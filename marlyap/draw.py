"""The report's pictures as files: PNG by Matplotlib, GIF by Pillow, both imported late.

The films and runs are those of `marlyap.report`, whose colours and signs are used here too: one
colour per robot, leaders filled and ringed, followers hollow, the target's ring to scale, L in the
strip beneath and in vermilion where it rises.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from types import ModuleType
from typing import Any, Literal

import numpy as np

from marlyap.errors import UserError
from marlyap.report import (
    ALARM,
    PALETTE,
    Film,
    Run,
    Scene,
    learning_curve,
    mean_curve,
    scenes,
    ticks,
)
from marlyap.store import write_bytes_atomic


PAPER, INK, SOFT, RULE, FAINT = "#ffffff", "#1c1d20", "#5e6169", "#dddcd6", "#ecebe6"
Key = Literal["success", "return"]
SHARP = 2  # drawn so many times larger, then reduced, for smooth lines
TRAIL = 1.5  # s
MOST_FRAMES = 120

# -------------------------------------------------------------------------------------------------
# PNG
# -------------------------------------------------------------------------------------------------


def trajectories_png(films: Sequence[Film], path: str | Path) -> None:
    """The paths of several episodes side by side."""
    shown = _regular(films)
    figure = _figure(3.6 * min(len(shown), 3), 3.6 * math.ceil(len(shown) / 3))
    for k, scene in enumerate(shown):
        axes = figure.add_subplot(math.ceil(len(shown) / 3), min(len(shown), 3), k + 1)
        _paths(axes, scene)
        axes.set_title(f"{scene.label}: {scene.detail}", fontsize=9, color=INK, loc="left")
    _save(figure, path)


def learning_curves_png(runs: Sequence[Run], path: str | Path) -> None:
    """Success and return against environment steps: a line per run, and each group's mean."""
    figure = _figure(8.4, 3.4)
    success, gain = figure.add_subplot(1, 2, 1), figure.add_subplot(1, 2, 2)
    _curves(success, runs, "success", "success (%)", 100)
    _curves(gain, runs, "return", "return of an episode", 1)
    success.set_ylim(-3, 103)  # a curve at either end is seen whole
    if runs:
        names = {"loc": "outside lower center", "ncols": 2, "frameon": False, "fontsize": 8}
        figure.legend(*success.get_legend_handles_labels(), labelcolor=SOFT, **names)
    _save(figure, path)


def _curves(axes: Any, runs: Sequence[Run], key: Key, name: str, scale: int) -> None:
    groups = dict.fromkeys(run.get("group") or "" for run in runs)
    for k, group in enumerate(groups):
        colour = PALETTE[k % len(PALETTE)]
        own = [learning_curve(run, key) for run in runs if (run.get("group") or "") == group]
        for x, y in own:
            axes.plot(x, scale * y, color=colour, linewidth=0.9, alpha=0.6)
        x, y = mean_curve(own)
        label = f"{group or 'runs'} ({len(own)} seed{'' if len(own) == 1 else 's'})"
        axes.plot(x, scale * y, color=colour, linewidth=2.2, label=label)
    axes.set_xlabel("environment steps", color=SOFT)
    axes.set_ylabel(name, color=SOFT)
    axes.xaxis.set_major_formatter(lambda value, _: f"{value / 1000:g}k" if value else "0")
    _quiet(axes)


def _paths(axes: Any, scene: Scene) -> None:
    """One episode seen from above, in Matplotlib."""
    from matplotlib.patches import Circle

    x, y, side = scene.view
    axes.set(xlim=(x - side / 2, x + side / 2), ylim=(y - side / 2, y + side / 2), aspect="equal")
    for k, target in enumerate(scene.targets):
        edge = _target_colour(scene, k)
        look = {"facecolor": f"{edge}12", "edgecolor": edge, "linestyle": (0, (3, 2))}
        axes.add_patch(Circle(target, scene.radius, linewidth=1, **look))
    for i, j in scene.links(-1):
        axes.plot(*scene.positions[-1, [i, j]].T, color=SOFT, linewidth=0.7, alpha=0.6)
    every = max(round(1 / scene.dt), 1)
    for k in range(scene.positions.shape[1]):
        path, ink = scene.positions[:, k], PALETTE[k % len(PALETTE)]
        axes.plot(*path.T, color=ink, linewidth=1.4, solid_capstyle="round")
        axes.plot(*path[every:-1:every].T, ".", color=ink, markersize=3.5)
        axes.plot(*path[0], "o", color=ink, markersize=5, fillstyle="none")
        angle = None if scene.headings is None else scene.headings[-1, k]
        shape: Any = "o" if angle is None else (3, 0, math.degrees(angle) - 90)
        fill = ink if scene.leaders[k] else PAPER
        axes.plot(*path[-1], marker=shape, color=ink, markersize=9, markerfacecolor=fill)
        if scene.leaders[k]:
            axes.plot(*path[-1], "o", color=ink, markersize=16, fillstyle="none")
    axes.tick_params(labelsize=7)
    axes.set_xlabel("x (m)", fontsize=8, color=SOFT)
    axes.set_ylabel("y (m)", fontsize=8, color=SOFT)
    _quiet(axes)


def _figure(width: float | int, height: float | int) -> Any:
    """A figure of its own, so that nobody's Matplotlib state is touched."""
    try:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure
    except ImportError as error:
        raise UserError("Drawing a PNG needs Matplotlib: pip install matplotlib.") from error
    figure = Figure(figsize=(width, height), dpi=160, facecolor=PAPER, layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def _quiet(axes: Any) -> None:
    axes.grid(color=FAINT, linewidth=0.8)
    axes.set_axisbelow(True)
    axes.tick_params(colors=SOFT, length=0)
    for spine in axes.spines.values():
        spine.set_color(RULE)


def _save(figure: Any, path: str | Path) -> None:
    write_bytes_atomic(Path(path), lambda file: figure.savefig(file, format="png"))


# -------------------------------------------------------------------------------------------------
# GIF
# -------------------------------------------------------------------------------------------------


def film_gif(film: Film, path: str | Path, fps: float | int = 10) -> None:
    """One episode as an animated picture; the last frame stays a while."""
    _write_gif([_Pane(scene, 440) for scene in _regular([film])], path, fps)


def film_pair_gif(left: Film, right: Film, path: str | Path, fps: float | int = 10) -> None:
    """Two episodes side by side in one frame, their labels above and their strips of L beneath."""
    pair = _regular([left, right])
    views = np.array([scene.view for scene in pair])
    low, high = views[:, :2] - views[:, 2:] / 2, views[:, :2] + views[:, 2:] / 2
    x, y = (low.min(0) + high.max(0)) / 2
    view = (float(x), float(y), float((high.max(0) - low.min(0)).max()))
    _write_gif([_Pane(replace(scene, view=view), 400) for scene in pair], path, fps)


def _write_gif(panes: Sequence[_Pane], path: str | Path, fps: float | int) -> None:
    image = _pillow("Image")
    gap, length = 20, max(len(pane.scene.positions) for pane in panes)
    width = gap + sum(pane.side + gap for pane in panes)
    sheet = image.new("RGB", (width, panes[0].height + 2 * gap), PAPER)
    frames = []
    for k in _times(length):
        for n, pane in enumerate(panes):
            sheet.paste(
                pane.picture(min(k, len(pane.scene.positions) - 1)),
                (gap + n * (pane.side + gap), gap),
            )
        frames.append(sheet.copy())
    palette = image.new("P", (1, 1))
    palette.putpalette([channel for colour in _inks() for channel in colour])
    small = [frame.quantize(palette=palette, dither=0) for frame in frames]
    pause = [round(1000 / fps)] * (len(small) - 1) + [1500]
    options = {"duration": pause, "loop": 0, "disposal": 1, "append_images": small[1:]}
    save = lambda file: small[0].save(file, format="GIF", save_all=True, **options)
    write_bytes_atomic(Path(path), save)


def _inks() -> list[tuple[int, int, int]]:
    """The colours of a GIF: every ink in ten strengths, the same for all frames."""
    inks = [_blend(ink, step / 10) for ink in (INK, SOFT, ALARM, *PALETTE) for step in range(1, 11)]
    return [_blend(PAPER, 1), _blend(INK, 0.07), _blend(RULE, 1), _blend(FAINT, 1), *inks]


def _times(length: int) -> list[int]:
    """The frames to draw: all of a short film, some of a long one, the last always."""
    stride = math.ceil(length / MOST_FRAMES)
    return [*range(0, length - 1, stride), length - 1]


@dataclass
class _Pane:
    """One film on a square of `side` pixels, a title above it and a strip beneath it."""

    scene: Scene
    side: int
    title: int = 26
    strip: int = 84

    @property
    def height(self) -> int:
        return self.title + self.side + self.strip

    def picture(self, k: int) -> Any:
        image = _pillow("Image")
        large = image.new("RGB", (SHARP * self.side, SHARP * self.height), PAPER)
        pen = _pillow("ImageDraw").Draw(large)
        self._scene(pen, k)
        self._frame(pen, k)
        self._strip(pen, k)
        return large.resize((self.side, self.height), image.Resampling.BOX)

    def _place(self, points: np.ndarray) -> np.ndarray:
        """Metres to pixels of the large picture."""
        x, y, side = self.scene.view
        scale = SHARP * self.side / side
        return (points - (x, y)) * (scale, -scale) + SHARP * np.array(
            [self.side / 2, self.title + self.side / 2]
        )

    def _scene(self, pen: Any, k: int) -> None:
        scene, (x, y, side) = self.scene, self.scene.view
        for value in ticks(x - side / 2, x + side / 2):
            at = self._place(np.array([value, y]))[0]
            pen.line((at, 0, at, SHARP * (self.title + self.side)), FAINT, SHARP)
        for value in ticks(y - side / 2, y + side / 2):
            at = self._place(np.array([x, value]))[1]
            pen.line((0, at, SHARP * self.side, at), FAINT, SHARP)
        radius = max(scene.radius * SHARP * self.side / side, 3 * SHARP)
        for n, target in enumerate(self._place(scene.targets)):
            ink, box = _target_colour(scene, n), (*(target - radius), *(target + radius))
            pen.ellipse(box, _blend(ink, 0.07))
            for arc in range(0, 360, 15):
                pen.arc(box, arc, arc + 9, ink, round(1.4 * SHARP))
        spots = self._place(scene.positions[k])
        for i, j in scene.links(k):
            pen.line((*spots[i], *spots[j]), _blend(SOFT, 0.5), SHARP)
        for agent in range(len(spots)):
            self._trail(pen, agent, k)
        for agent in range(len(spots)):
            self._agent(pen, spots[agent], agent, k)

    def _trail(self, pen: Any, agent: int, k: int) -> None:
        """The whole way so far, fading into a thin line."""
        path, colour = (
            self._place(self.scene.positions[: k + 1, agent]),
            PALETTE[agent % len(PALETTE)],
        )
        for n in range(1, len(path)):
            if np.isfinite(path[n - 1 : n + 1]).all():
                fresh = max(0.0, 1 - (k - n) * self.scene.dt / TRAIL)
                pen.line(
                    (*path[n - 1], *path[n]),
                    _blend(colour, 0.3 + 0.7 * fresh),
                    round((1 + 1.6 * fresh) * SHARP),
                )

    def _agent(self, pen: Any, spot: np.ndarray, agent: int, k: int) -> None:
        scene, colour, size = self.scene, PALETTE[agent % len(PALETTE)], 8.0 * SHARP
        if not np.isfinite(spot).all():
            return
        fill = colour if scene.leaders[agent] else PAPER
        if scene.leaders[agent]:
            _disc(pen, spot, 1.8 * size, None, colour, round(1.4 * SHARP))
        angle = None if scene.headings is None else scene.headings[k, agent]
        if angle is None or not math.isfinite(angle):
            _disc(pen, spot, 0.75 * size, fill, colour, 2 * SHARP)
            return
        ahead = np.array([math.cos(angle), -math.sin(angle)])
        aside = np.array([-ahead[1], ahead[0]])
        back, wing = spot - 0.8 * size * ahead, 0.75 * size * aside
        corners = [tuple(at) for at in (spot + 1.2 * size * ahead, back + wing, back - wing)]
        pen.polygon(corners, fill, colour, 2 * SHARP)

    def _frame(self, pen: Any, k: int) -> None:
        """What hides the drawing's overhang, the border and the words."""
        scene, right, top = self.scene, SHARP * self.side - 1, SHARP * self.title
        bottom = top + SHARP * self.side - 1
        pen.rectangle((0, 0, right, top - 1), PAPER)
        pen.rectangle((0, bottom + 1, right, SHARP * self.height), PAPER)
        pen.rectangle((0, top, right, bottom), None, RULE, SHARP)
        label, room = scene.label, right - 64 * SHARP
        while len(label) > 1 and pen.textlength(label, _font(15)) > room:
            label = label[:-2] + "…"
        pen.text((0, 4 * SHARP), label, INK, _font(15))
        pen.text((right, 5 * SHARP), f"{k * scene.dt:.1f} s", SOFT, _font(13), anchor="ra")

    def _strip(self, pen: Any, k: int) -> None:
        """L, else the cost, else the largest distance: up to now in ink, the rest in grey."""
        scene = self.scene
        values = scene.distance if scene.level is None else scene.level
        name = f"{scene.level_name} along the episode" if scene.rises else scene.level_name
        name = name or "largest distance (m)"
        top, bottom = SHARP * (self.height - self.strip + 32), SHARP * (self.height - 4)
        pen.text((0, SHARP * (self.height - self.strip + 10)), name, SOFT, _font(13))
        most = float(np.nanmax(values)) if np.isfinite(values).any() else 0.0
        x = np.linspace(2 * SHARP, SHARP * (self.side - 2), len(values))
        y = bottom - np.maximum(values, 0) / (most or 1.0) * (bottom - top)
        pen.line((0, bottom, SHARP * self.side, bottom), RULE, SHARP)
        for n in range(1, len(values)):
            if not np.isfinite(values[n - 1 : n + 1]).all():
                continue
            rises = scene.rises and values[n] - values[n - 1] > 1e-3 * most
            colour, width = (ALARM, 3) if rises else (INK, 1.8)
            pen.line(
                (x[n - 1], y[n - 1], x[n], y[n]),
                colour if n <= k else _blend(colour, 0.22),
                round(width * SHARP),
            )
        if np.isfinite(y[k]):
            _disc(pen, np.array([x[k], y[k]]), 3.5 * SHARP, PALETTE[0], None)


# -------------------------------------------------------------------------------------------------
# Small tools
# -------------------------------------------------------------------------------------------------


def _regular(films: Sequence[Film]) -> list[Scene]:
    shown = scenes(films)
    if len(shown) < len(films) or not shown:
        raise UserError(
            "There is no film to draw: `positions` must list, for each time, one [x, y] per agent."
        )
    return shown


def _target_colour(scene: Scene, k: int) -> str:
    return PALETTE[k % len(PALETTE)] if scene.own_targets else INK


def _pillow(name: str) -> ModuleType:
    try:
        return __import__(f"PIL.{name}", fromlist=[name])
    except ImportError as error:
        raise UserError("Drawing a GIF needs Pillow: pip install pillow.") from error


@cache
def _font(size: int) -> Any:
    return _pillow("ImageFont").load_default(size * SHARP)


def _blend(colour: str, alpha: float | int) -> tuple[int, int, int]:
    """A colour laid over the paper."""
    over, under = (tuple(int(text[n : n + 2], 16) for n in (1, 3, 5)) for text in (colour, PAPER))
    red, green, blue = (
        round(alpha * a + (1 - alpha) * b) for a, b in zip(over, under, strict=True)
    )
    return red, green, blue


def _disc(
    pen: Any, centre: np.ndarray, radius: float | int, fill: Any, outline: Any, width: int = 1
) -> None:
    pen.ellipse((*(centre - radius), *(centre + radius)), fill, outline, width)
