"""A search: Optuna proposes cells one after the other, and gives up what does badly early on.

The study is a journal file in the folder of the sweep. A cell is named by what is set in it, not by
its trial, so that a proposal that was cut short is taken up where its runs stand.
"""

from collections import deque
from collections.abc import Sequence
from typing import Any

from marlyap.errors import UserError
from marlyap.sweeps.check import made_of
from marlyap.sweeps.engine import missing
from marlyap.sweeps.folder import Sweep
from marlyap.sweeps.jobs import OVER, Entry, Job, Status, last_lines
from marlyap.sweeps.plan import Range, Search, canonical


JOURNAL, STUDY = "study.journal", "sweep"
STARTUP = 4  # trials that are never given up, to compare with


class Searched:
    """The proposals of Optuna as a source of jobs."""

    def __init__(self, sweep: Sweep):
        try:
            import optuna  # pyright: ignore[reportMissingImports] -- an extra
        except ImportError:
            raise missing("optuna", "sweep", "search: it") from None
        assert sweep.plan.search is not None
        self.optuna: Any = optuna
        self.sweep, self.search = sweep, sweep.plan.search
        self.study = _study(optuna, sweep, self.search)
        self.waiting: deque[Job] = deque()
        self.trials: dict[str, Any] = {}  # by cell
        self.told: dict[str, int] = {}  # the last iteration that was reported of a cell
        states = optuna.trial.TrialState
        for frozen in self.study.get_trials(states=(states.RUNNING,)):
            # of a process that was killed: only one drives a sweep, so nobody else has it
            self._begin(optuna.trial.Trial(self.study, frozen._trial_id))

    @property
    def proposed(self) -> int:
        return len(self.study.trials)

    @property
    def exhausted(self) -> bool:
        return self.proposed >= self.search.trials and not self.waiting and not self.trials

    def take(self) -> list[Job]:
        if not self.waiting and self.proposed < self.search.trials:
            self._begin(self.study.ask())
        return [self.waiting.popleft()] if self.waiting else []

    def _begin(self, trial: Any) -> None:
        """Write down the cell of a trial, and put its jobs in the queue."""
        chosen = {name: _suggested(trial, name, r) for name, r in self.search.ranges.items()}
        (base,) = self.sweep.plan.expanded()
        try:
            made = made_of({**base, **chosen}, f"trial {trial.number}")[0]
        except UserError as error:
            self.study.tell(trial, state=self.optuna.trial.TrialState.FAIL)
            raise UserError(f"search: {error}") from None
        cell = Entry(*made, trial.number)
        known = {entry.name: entry for entry in self.sweep.cells}
        if cell.name not in known:
            self.sweep.add(cell)
        if cell.name in self.trials:  # the same proposal again, while it is trained
            self.study.tell(trial, state=self.optuna.trial.TrialState.FAIL)
            return
        self.trials[cell.name] = trial
        self.waiting.extend(self.sweep.jobs_of(known.get(cell.name, cell)))

    def look(self, statuses: Sequence[Status]) -> None:
        """Tell Optuna how its trials stand, and give up those that it would not go on with."""
        for name, trial in [*self.trials.items()]:
            mine = [s for s in statuses if s.job.cell.name == name]
            if mine and all(s.state in OVER for s in mine):
                self._end(trial, mine)
                del self.trials[name]
            elif self.search.prune and all(s.state != "failed" for s in mine):
                self._report(trial, name, mine)

    def _report(self, trial: Any, name: str, mine: list[Status]) -> None:
        """The mean over the seeds at each iteration at which all of them have been looked at."""
        curves = [_curve(s.job, self.search.metric) for s in mine]
        common = sorted(set.intersection(*map(set, curves))) if curves else []
        for at in [at for at in common if at > self.told.get(name, 0)]:
            self.told[name] = at
            trial.report(sum(curve[at] for curve in curves) / len(curves), at)
            if trial.should_prune():
                for status in mine:
                    status.job.beside("drop").touch()
                return

    def _end(self, trial: Any, mine: list[Status]) -> None:
        """Tell Optuna what the trial came to."""
        states = self.optuna.trial.TrialState
        if any(s.state == "failed" for s in mine):
            self.study.tell(trial, state=states.FAIL)
        elif any(s.state == "dropped" for s in mine):
            self.study.tell(trial, state=states.PRUNED)
        else:
            key = "best" if self.search.metric == "success" else self.search.metric
            values = [float((s.result or {}).get(key, 0.0)) for s in mine]
            self.study.tell(trial, sum(values) / len(values))


def _study(optuna: Any, sweep: Sweep, search: Search) -> Any:
    """The study in the sweep's folder, made if it is not there."""
    from optuna.storages import (  # pyright: ignore[reportMissingImports]
        JournalStorage,
        journal,
    )

    optuna.logging.set_verbosity(optuna.logging.WARNING)
    backend = journal.JournalFileBackend(str(sweep.directory / JOURNAL))
    study = optuna.create_study(
        storage=JournalStorage(backend),
        study_name=STUDY,
        pruner=optuna.pruners.MedianPruner(n_startup_trials=STARTUP),
        direction="maximize",
        load_if_exists=True,
    )
    seed = search.seed + len(study.trials)  # or it would propose again what it began with
    study.sampler = optuna.samplers.TPESampler(seed=seed)
    return study


def _suggested(trial: Any, name: str, r: Range) -> str:
    """The proposal for one field, as one would type it."""
    if r.choices:
        return trial.suggest_categorical(name, list(r.choices))
    if r.whole:
        value = trial.suggest_int(name, int(r.low), int(r.high), step=int(r.step or 1), log=r.log)
        return str(value)
    return canonical(repr(trial.suggest_float(name, r.low, r.high, step=r.step, log=r.log)))


def _curve(job: Job, metric: str) -> dict[int, float]:
    """The metric by the iteration at which the policy was looked at, as far as the log has it."""
    lines = last_lines(job.directory / "log.jsonl")
    return {line["iteration"]: line[metric] for line in lines if "success" in line}
