"""Films as animated GIF files."""

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from PIL import Image

from marlyap.report import plot
from marlyap.report.data import Film
from marlyap.report.scene import (
    ALARM,
    FAINT,
    INK,
    PALETTE,
    PAPER,
    RULE,
    SOFT,
    Scene,
    aligned,
    scenes,
)
from marlyap.storage.store import write_bytes_atomic


MOST_FRAMES = 120
DPI = 100
SIDE = 4.4  # inches, of a square panel


def film_gif(film: Film, path: str | Path, fps: float | int = 10) -> None:
    """One episode as an animated picture; the last frame stays a while.

    Raises UserError if the file cannot be written.
    """
    films_gif([film], path, fps)


def film_pair_gif(left: Film, right: Film, path: str | Path, fps: float | int = 10) -> None:
    """Two episodes side by side in one frame, at one scale, each with its strip beneath.

    Raises UserError if the file cannot be written.
    """
    films_gif([left, right], path, fps)


def frames_gif(frames: Sequence[np.ndarray], path: str | Path, fps: float | int = 10) -> None:
    """Frames [height width 3] that were drawn elsewhere, thinned out to MOST_FRAMES.

    Raises UserError if the file cannot be written.
    """
    images = [Image.fromarray(np.ascontiguousarray(f)) for f in frames]
    images = images[:: -(-len(images) // MOST_FRAMES)]
    more = {"append_images": images[1:], "duration": int(1000 / fps), "loop": 0}
    write_bytes_atomic(Path(path), lambda f: images[0].save(f, "GIF", save_all=True, **more))


def films_gif(
    films: Sequence[Film],
    path: str | Path,
    fps: float | int = 10,
    dpi: int = DPI,
    most: int = MOST_FRAMES,
) -> None:
    """Several episodes side by side, at one scale and at one time, in at most so many frames.

    Raises UserError if the file cannot be written.
    """
    frames = pictures(aligned(scenes(films)), dpi, most)
    palette = Image.new("P", (1, 1))
    palette.putpalette([channel for colour in _inks() for channel in colour])
    small = [frame.quantize(palette=palette, dither=Image.Dither.NONE) for frame in frames]
    pause = [round(1000 / fps)] * (len(small) - 1) + [1500]
    options = {"duration": pause, "loop": 0, "disposal": 1, "append_images": small[1:]}
    save = lambda file: small[0].save(file, format="GIF", save_all=True, **options)
    write_bytes_atomic(Path(path), save)


def pictures(shown: Sequence[Scene], dpi: int = DPI, most: int = MOST_FRAMES) -> list[Image.Image]:
    """Every frame of several scenes side by side."""
    height = SIDE * max(_height(scene) for scene in shown)
    figure = plot.figure(SIDE * len(shown), height, dpi, layout="constrained")
    spaces = figure.subfigures(1, len(shown), squeeze=False).ravel()
    panes = [_Pane(space, scene) for space, scene in zip(spaces, shown, strict=True)]
    return _frames(figure, panes, _times(max(len(scene.times) for scene in shown), most))


def _strips(scene: Scene) -> int:
    """One strip under a map, the first; all of them where there is no map."""
    return min(len(scene.strips), 1) if scene.panels else len(scene.strips)


def _height(scene: Scene) -> float:
    return 0.1 + sum(panel.height for panel in scene.panels) + plot.STRIP * _strips(scene)


class _Pane:
    """One film in its part of the figure: what stands still is drawn once, the rest each time."""

    def __init__(self, space, scene: Scene):
        self.scene = scene
        self.strips = scene.strips[: _strips(scene)]
        sizes = [*(panel.height for panel in scene.panels), *[plot.STRIP] * len(self.strips)]
        rows = [row[0] for row in space.subplots(len(sizes), 1, squeeze=False, height_ratios=sizes)]
        self.maps, self.bands = rows[: len(scene.panels)], rows[len(scene.panels) :]
        for axes, panel in zip(self.maps, scene.panels, strict=True):
            plot.ground(axes, scene, panel)
        for axes, strip in zip(self.bands, self.strips, strict=True):
            plot.band(axes, scene, strip)
            plot.curves(axes, scene, strip, alpha=0.22)
        label = scene.label if len(scene.label) < 44 else scene.label[:43] + "…"
        space.suptitle(label, fontsize=10, color=INK, x=0.02, ha="left")
        self.clock = space.text(0.98, 0.985, "", fontsize=9, color=SOFT, ha="right", va="top")
        self.clock.set_animated(True)

    def draw(self, k: int) -> None:
        """Draw time `k`, or the last there is."""
        scene = self.scene
        k = min(k, len(scene.times) - 1)
        for axes, panel in zip(self.maps, scene.panels, strict=True):
            for artist in plot.moment(scene, panel, k, trail=True):
                _once(axes, artist)
        for axes, strip in zip(self.bands, self.strips, strict=True):
            for artist in plot.until(scene, strip, k):
                _once(axes, artist)
            now, colour = scene.times[k], PALETTE[0]
            _once(axes, Line2D([now, now], strip.span, color=colour, linewidth=0.8))
            if not strip.agents:
                _once(axes, Line2D([now], [strip.lines[0, k]], marker="o", color=colour, ms=5))
        self.clock.set_text(f"{scene.times[k]:.{1 if scene.dt >= 0.1 else 2}f} s")
        (*self.maps, *self.bands)[0].draw_artist(self.clock)


def _once(axes, artist) -> None:
    """Draw an artist on what is there, and forget it."""
    axes.add_artist(artist)
    axes.draw_artist(artist)
    artist.remove()


def _frames(figure: Figure, panes: Sequence[_Pane], times: Sequence[int]) -> list[Image.Image]:
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    still, made = canvas.copy_from_bbox(figure.bbox), []
    for k in times:
        canvas.restore_region(still)
        for pane in panes:
            pane.draw(k)
        made.append(Image.fromarray(np.array(canvas.buffer_rgba())).convert("RGB"))
    return made


def _times(length: int, most: int) -> list[int]:
    """The frames to draw: all of a short film, some of a long one, the last always."""
    stride = math.ceil(length / most)
    return [*range(0, length - 1, stride), length - 1]


def _inks() -> list[tuple[int, int, int]]:
    """The colours of a GIF: every ink in ten strengths, the same for all frames."""
    inks = [_blend(ink, step / 10) for ink in (INK, SOFT, ALARM, *PALETTE) for step in range(1, 11)]
    return [_blend(PAPER, 1.0), _blend(INK, 0.07), _blend(RULE, 1.0), _blend(FAINT, 1.0), *inks]


def _blend(colour: str, alpha: float) -> tuple[int, int, int]:
    """A colour laid over the paper."""
    over, under = np.array(to_rgb(colour)), np.array(to_rgb(PAPER))
    red, green, blue = (round(255 * float(c)) for c in alpha * over + (1 - alpha) * under)
    return red, green, blue
