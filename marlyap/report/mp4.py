"""Films as MP4 files, by the encoder ffmpeg where it is installed."""

import shutil
import subprocess
import tempfile
from collections.abc import Sequence
from pathlib import Path

from marlyap.errors import UserError
from marlyap.report.data import Film
from marlyap.report.gif import pictures
from marlyap.report.scene import aligned, scenes
from marlyap.storage.store import write_bytes_atomic


EVEN = "pad=ceil(iw/2)*2:ceil(ih/2)*2:color=white"  # the common codec takes even sizes only


def encoder() -> str:
    """Where ffmpeg is. Raises UserError if it is not installed."""
    found = shutil.which("ffmpeg")
    if found is None:
        raise UserError(
            "format: mp4 needs the encoder ffmpeg, which is not on PATH; install it (apt install "
            "ffmpeg, brew install ffmpeg) or leave mp4 out."
        )
    return found


def films_mp4(films: Sequence[Film], path: str | Path, fps: float | int = 10) -> None:
    """Several episodes side by side, at one scale and at one time.

    Raises UserError if ffmpeg is missing or fails, or the file cannot be written.
    """
    program, frames = encoder(), pictures(aligned(scenes(films)))
    width, height = frames[0].size
    with tempfile.TemporaryDirectory() as folder:
        made = Path(folder) / "film.mp4"
        source = ["-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{width}x{height}", "-r", str(fps)]
        target = ["-vf", EVEN, "-pix_fmt", "yuv420p", "-movflags", "+faststart", str(made)]
        command = [program, "-loglevel", "error", "-y", *source, "-i", "-", *target]
        told = subprocess.run(
            command, input=b"".join(f.tobytes() for f in frames), capture_output=True
        )
        if told.returncode:
            words = told.stderr.decode(errors="replace").strip().splitlines()
            raise UserError(f"format: ffmpeg failed ({words[-1] if words else 'without a word'}).")
        data = made.read_bytes()
    write_bytes_atomic(Path(path), lambda file: file.write(data))
