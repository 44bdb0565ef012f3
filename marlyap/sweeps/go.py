"""Make a sweep, and run it: what the command line and Python share."""

from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

from marlyap.errors import UserError
from marlyap.runs.job import Launch
from marlyap.sweeps import plan as plans
from marlyap.sweeps.drive import Listed, Source, drive
from marlyap.sweeps.engine import Engine, Local
from marlyap.sweeps.folder import Sweep
from marlyap.sweeps.jobs import Entry, Status
from marlyap.sweeps.plan import WORDS, Plan


ENGINES = ("local", "ray", "slurm")


def make_sweep(plan: Plan | Path | str, out: Path | str) -> Sweep:
    """Check every cell of a plan, given or in a TOML file, and write it down in folder `out`.

    Nothing is trained. In a folder that holds a sweep already the plan is replaced, and runs with
    the same settings are kept. Raises UserError, naming cell and field, for what cannot be trained.
    """
    if not isinstance(plan, Plan):
        plan = plans.of_toml(Path(plan))
    plan = _placed(plan)
    from marlyap.sweeps.check import checked  # JAX is imported here

    return Sweep.make(out, plan, [Entry(*cell) for cell in checked(plan)])


def _placed(plan: Plan) -> Plan:
    """With the whole path to files of the user's own, since others read them from elsewhere."""

    def whole(name: str, text: str) -> str:
        file, colon, word = text.rpartition(":")
        return f"{Path(file).resolve()}:{word}" if name in WORDS and colon else text

    fixed = {k: whole(k, v) for k, v in plan.fixed.items()}
    grid = {k: tuple(whole(k, v) for v in values) for k, values in plan.grid.items()}
    cells = tuple({k: whole(k, v) for k, v in cell.items()} for cell in plan.cells)
    return replace(plan, fixed=fixed, grid=grid, cells=cells)


def run_sweep(
    sweep: Sweep,
    on: str = "local",
    slots: int | None = None,
    how: Launch | None = None,
    options: dict[str, str] | None = None,
    stop: Callable[[], bool] = lambda: False,
    retry: bool = False,
) -> Iterator[list[Status]]:
    """Train what a sweep has not trained yet; yields how all jobs stand, about once a second.

    Arguments: on, local, ray or slurm; slots, how many jobs at once; how, as for `launch`; options
    of Ray or Slurm; retry, whether failed jobs are tried again. Dropping the iterator stops what is
    trained, which is saved first; calling this again resumes.

    Raises UserError for an engine that is unknown or not installed, and where another process runs
    this sweep.
    """
    sweep = replace(sweep, directory=sweep.directory.resolve())
    source: Source = Listed(sweep)
    if sweep.plan.search is not None:
        from marlyap.sweeps.search import Searched

        source = Searched(sweep)
    how = how or Launch()
    one = on == "local" and how.device == "gpu"  # the jobs of a machine share its device
    engine = engine_of(on, sweep, slots or (1 if one else None), options)
    yield from drive(sweep, engine, source, how, stop, retry)


def engine_of(
    on: str, sweep: Sweep, slots: int | None, options: dict[str, str] | None = None
) -> Engine:
    """The engine of this name. Raises UserError where it is unknown or not installed."""
    if slots is not None and slots < 1:
        raise UserError(f"workers: {slots} is out of range; take 1 or more.")
    given: dict[str, Any] = {"slots": slots, "options": options}
    if on == "ray":
        from marlyap.sweeps.on_ray import OnRay

        return OnRay(**given)
    if on == "slurm":
        from marlyap.sweeps.on_slurm import OnSlurm

        return OnSlurm(sweep.directory / "slurm", **given)
    if on != "local":
        raise UserError(f"on: '{on}' must be {', '.join(ENGINES[:-1])} or {ENGINES[-1]}.")
    if options:
        raise UserError("engine: this machine takes no options; leave them out.")
    return Local(slots)
