"""Runs measured on the same held-out starts, as the records that charts and tables are made of."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from marlyap.errors import UserError
from marlyap.games.game import AbstractGame
from marlyap.report.charts import along
from marlyap.report.data import Group, LogRow, Share, Trained, Within
from marlyap.report.episodes import costs
from marlyap.runs import groups
from marlyap.runs.config import record
from marlyap.runs.run import Run
from marlyap.simulation.evaluation import evaluate
from marlyap.storage import store


MEASURED = (
    "Measured, not proved: the interval is about {what} in this simulation, from starts drawn as "
    "in training. {more}"
)


@dataclass(frozen=True, eq=False)
class Measurement:
    """Runs, what their evaluations found, and which of them belong together."""

    found: Sequence[groups.Measured]
    runs: Mapping[str, Run]  # by the name of what was measured, as are the next three
    labels: Mapping[str, str]  # what the page calls a run
    games: Mapping[str, str]
    strips: Mapping[str, np.ndarray]  # costs [episode, time]
    teams: Mapping[str, Sequence[groups.Measured]]  # runs that differ in their seed alone

    def run(self, m: groups.Measured) -> Run:
        return self.runs[m.name]

    def label(self, m: groups.Measured) -> str:
        return self.labels[m.name]

    def grouped(self, certified: bool = False) -> list[Group]:
        """The figures of each group."""
        return [
            _group(name, those, certified, self._more(those)) for name, those in self.teams.items()
        ]

    def trained(self) -> tuple[Trained, ...]:
        """The figures of each run, group by group."""
        return tuple(
            _trained(self.run(m), m, self.label(m), name, self._more([m]))
            for name, those in self.teams.items()
            for m in those
        )

    def _more(self, those: Sequence[groups.Measured]) -> dict[str, Any]:
        return _more(those, self.games[those[0].name], self.strips)


def measured(
    runs: Sequence[Run],
    episodes: int,
    seed: int,
    games: Sequence[AbstractGame] | None = None,
    called: str = "",
    tell: Callable[[str], None] = lambda text: None,
) -> Measurement:
    """Evaluate runs, each on its game; the arguments are those of `contents.gather`."""
    found = []
    for k, (run, game) in enumerate(zip(runs, games or [r.game for r in runs], strict=True)):
        tell(f"evaluating {run.directory} ({k + 1} of {len(runs)})")
        result = evaluate(game, run.controller(game), episodes, seed)
        found.append(groups.of_run(run, result, seed, game, called))
    names, labels = groups.labels(found, brief=True)
    keys = [m.name for m in found]
    by_name = lambda values: dict(zip(keys, values, strict=True))
    drives = [run.controller(m.game) for run, m in zip(runs, found, strict=True)]
    strips = [costs(m.game, c, seed, episodes) for m, c in zip(found, drives, strict=True)]
    return Measurement(
        found=found,
        runs=by_name(runs),
        labels=by_name(labels),
        games=by_name(_game_names(runs, found, called)),
        strips=by_name(strips),
        teams=dict(zip(names, groups.grouped(found).values(), strict=True)),
    )


def logged(runs: Sequence[Run]) -> tuple[Trained, ...]:
    """What the logs of runs say, without any evaluation."""
    names = groups.named([groups.configured(run) for run in runs])
    return tuple(
        Trained(name=str(run.directory), label=f"{name}, seed {run.seed}", group=name,
                game=run.labels["task"], seed=run.seed, log=log_rows(run))
        for run, name in zip(runs, names, strict=True)
    )  # fmt: skip


def _game_names(runs: Sequence[Run], found: Sequence[groups.Measured], called: str) -> list[str]:
    """What to call each game: the task, and what differs where several share its name."""
    tasks = [called or run.labels["task"] for run in runs]
    records = [{"task": record(m.game)} for m in found]
    return groups.named(list(zip(tasks, records, strict=True)))


def _more(
    those: Sequence[groups.Measured], game: str, strips: Mapping[str, np.ndarray]
) -> dict[str, Any]:
    """What the charts need of runs that belong together beside their figures."""
    finals = np.concatenate([m.evaluation.final for m in those])
    strip = along(np.concatenate([strips[m.name] for m in those]), those[0].game.dt)
    return {"game": game, "finals": tuple(finals.tolist()), "along": strip}


def figures(summary: Mapping[str, Any]) -> dict[str, Any]:
    """The fields of `data.Figures` out of the summary of an evaluation or a group."""
    known = [name for name in groups.SHARES if name in summary]
    shares = {name: Share(**_about_share(summary[name])) for name in known}
    within = [Within(radius=r["radius"], **_about_share(r)) for r in summary["radii"]]
    return {**summary, **shares, "radii": tuple(within)}


def _about_share(part: Mapping[str, Any]) -> dict[str, Any]:
    return {name: part[name] for name in ("episodes", "successes", "success_rate", "interval")}


def _group(
    label: str, members: Sequence[groups.Measured], certified: bool, more: Mapping[str, Any]
) -> Group:
    """What is said of runs that belong together."""
    said = groups.summary(members)
    text = _caveat(said["about"], certified)
    return Group(label=label, text=text, **figures(said), **more)


def _trained(
    run: Run, m: groups.Measured, label: str, group: str, more: Mapping[str, Any]
) -> Trained:
    """One run, what its evaluation found and what its log says."""
    said = figures(m.evaluation.summary())
    about = {"name": m.name, "label": label, "group": group, "seed": run.seed}
    return Trained(**about, log=log_rows(run), **said, **more)


def _caveat(about: str, certified: bool) -> str:
    """What the interval is about, and what is certified beside it."""
    one = about == "this policy"
    what = "the share of starts from which this policy succeeds"
    if not one:
        what = "the expected success rate of a policy that is trained with a new seed,"
    more = "What is certified, and on what evidence, stands below."
    return MEASURED.format(
        what=what, more=more if certified else "Stability is not certified by it."
    )


def log_rows(run: Run) -> tuple[LogRow, ...]:
    """The log of a run as far as it is known."""
    return tuple(
        LogRow(line["steps"], line.get("success"), line.get("return"))
        for line in history(run)[0]
        if "steps" in line
    )


def progress(run: Run) -> tuple[int, int]:
    """Environment steps done, by the log where the checkpoints are gone, and steps in all."""
    steps = [line["steps"] for line in history(run)[0] if isinstance(line.get("steps"), int)]
    whole = run.trainer.iterations * run.trainer.steps_per_iteration
    return max([run.steps_done, *steps[-1:]]), whole


def history(run: Run) -> tuple[list[dict[str, Any]], str]:
    """The log of a run as far as it can be read, and in words what it lacks."""
    try:
        lines = run.history()
    except UserError as error:
        return [], f"log.jsonl cannot be read ({error})"
    if not lines:
        return [], "log.jsonl is missing, empty or cut off"
    policy = run.directory / "policy"
    logged, known = lines[-1].get("iteration", 0), 0
    if policy.is_dir():
        known = store.read(policy, "policy")[1].get("iteration", 0)
    if logged < known:
        return lines, f"log.jsonl ends at iteration {logged} of {known}"
    return lines, ""
