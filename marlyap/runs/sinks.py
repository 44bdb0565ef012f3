"""Where a run tells its figures besides log.jsonl: a CSV and an event file of TensorBoard always,
W&B, MLflow or Trackio where they are asked for. No JAX here.

A sink is opened with all that the log holds, since a run may be taken up again further back, and is
given each new line. log.jsonl alone is read back by marlyap.
"""

import csv
import hashlib
import io
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

from marlyap.errors import UserError
from marlyap.storage import store, tensorboard


Line = Mapping[str, Any]
ABOUT = ("seed", "iteration", "steps", "updates", "seconds")  # of a line; the rest are figures


@runtime_checkable
class Sink(Protocol):
    """Takes the lines of one run."""

    def line(self, line: Line) -> None:
        """One line of the log: `steps`, and figures by name."""
        ...

    def close(self) -> None:
        """There will be no more."""
        ...


@dataclass(frozen=True)
class About:
    """The run that a sink is about."""

    directory: Path
    title: str
    config: dict[str, Any]  # as run.json has it


def figures(line: Line) -> dict[str, float]:
    """What is plotted over the steps."""
    return {k: float(v) for k, v in line.items() if k not in ABOUT}


class Csv:
    """log.csv: a column for each name; what a line lacks is left empty."""

    def __init__(self, about: About, history: Sequence[Line]):
        self.path, self.columns = about.directory / "log.csv", list[str]()
        self.lines = list(history)
        self._rewrite()

    def _rewrite(self) -> None:
        self.columns = list(dict.fromkeys(k for line in self.lines for k in line))
        head = ",".join(self.columns) + "\n" if self.columns else ""
        store.write_text_atomic(self.path, head + "".join(map(self._text, self.lines)))

    def _text(self, line: Line) -> str:
        out = io.StringIO()
        csv.DictWriter(out, self.columns, lineterminator="\n").writerow(dict(line))
        return out.getvalue()

    def line(self, line: Line) -> None:
        self.lines.append(line)
        if line.keys() <= {*self.columns}:
            store.append_line(self.path, self._text(line).rstrip("\n"))
        else:
            self._rewrite()

    def close(self) -> None:
        return


class TensorBoard:
    """events.out.tfevents.*: every figure as a scalar over the environment steps.

    The time of a line is that in the file's name and the seconds trained until then, so that the
    same log is the same file.
    """

    def __init__(self, about: About, history: Sequence[Line]):
        self.path = tensorboard.path_in(about.directory)
        self.began = tensorboard.began(self.path)
        tensorboard.rewrite(self.path, b"".join(map(self._record, history)))

    def _record(self, line: Line) -> bytes:
        when = self.began + float(line["seconds"])
        return tensorboard.record(tensorboard.event(figures(line), int(line["steps"]), when))

    def line(self, line: Line) -> None:
        with open(self.path, "ab") as file:
            file.write(self._record(line))

    def close(self) -> None:
        return


class Wandb:
    """A run of Weights & Biases (https://wandb.ai), taken up again under the same name."""

    def __init__(self, about: About, history: Sequence[Line]):
        import wandb  # pyright: ignore[reportMissingImports] -- the user's

        name = about.directory.resolve()
        self.run: Any = wandb.init(
            project="marlyap",
            name=about.title,
            id=_identity(name),
            resume="allow",
            dir=str(name),
            config=about.config,
            reinit="create_new",  # several runs may be trained in one program
        )

    def line(self, line: Line) -> None:
        self.run.log(figures(line), step=int(line["steps"]))

    def close(self) -> None:
        self.run.finish()


class Mlflow:
    """A run of MLflow (https://mlflow.org), where its tracking address says."""

    def __init__(self, about: About, history: Sequence[Line]):
        import mlflow  # pyright: ignore[reportMissingImports] -- the user's

        self.client: Any = mlflow.MlflowClient()
        place = mlflow.set_experiment("marlyap").experiment_id
        name = f"{about.title} {_identity(about.directory.resolve())}"
        known = self.client.search_runs([place], f"run_name = '{name}'")
        run = known[0] if known else self.client.create_run(place, run_name=name)
        self.run: str = run.info.run_id
        if not known:
            self.client.log_dict(self.run, about.config, "run.json")

    def line(self, line: Line) -> None:
        for name, value in figures(line).items():
            self.client.log_metric(self.run, name, value, step=int(line["steps"]))

    def close(self) -> None:
        self.client.set_terminated(self.run)


class Trackio:
    """A run of Trackio (https://github.com/gradio-app/trackio), on this machine."""

    def __init__(self, about: About, history: Sequence[Line]):
        import trackio  # pyright: ignore[reportMissingImports] -- the user's

        name = f"{about.title} {_identity(about.directory.resolve())}"
        self.run: Any = trackio.init(
            project="marlyap", name=name, config=about.config, resume="allow"
        )

    def line(self, line: Line) -> None:
        self.run.log(figures(line), step=int(line["steps"]))

    def close(self) -> None:
        self.run.finish()


ALWAYS: tuple[Callable[[About, Sequence[Line]], Sink], ...] = (Csv, TensorBoard)
TRACKERS: dict[str, Callable[[About, Sequence[Line]], Sink]] = {
    "wandb": Wandb,
    "mlflow": Mlflow,
    "trackio": Trackio,
}


def check(names: Iterable[str]) -> None:
    """Raise UserError for a tracker that is unknown or not installed."""
    for name in names:
        if name not in TRACKERS:
            raise UserError(f"log: '{name}' must be {', '.join(TRACKERS)}.")
        if find_spec(name) is None:
            raise UserError(f"log: {name} is not installed; install it with pip install {name}.")


def _identity(path: Path) -> str:
    return hashlib.sha256(str(path).encode()).hexdigest()[:10]


class Sinks:
    """All sinks of one run."""

    def __init__(self, about: About, history: Sequence[Line], names: Iterable[str] = ()):
        kinds = [*ALWAYS, *(TRACKERS[name] for name in names)]
        self.sinks = [kind(about, history) for kind in kinds]

    def line(self, line: Line) -> None:
        """Tell a line to each of them. What a full disk takes from one is there after a restart."""
        for sink in self.sinks:
            with suppress(OSError, UserError):
                sink.line(line)

    def close(self) -> None:
        """Close each of them, whatever the others do."""
        for sink in self.sinks:
            with suppress(OSError):
                sink.close()
