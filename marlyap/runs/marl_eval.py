"""Results in the JSON schema that marl-eval reads, the common tongue of multi-agent evaluation.

    environment -> task -> algorithm -> run -> step_0, step_1 ... -> step_count, metrics
                                               absolute_metrics   -> metrics

A metric is a list: here of one number, the mean over the episodes. The absolute metrics are those
of the deployed policy, measured on held-out starts after training.

Source: Gorsane et al., "Towards a standardised performance evaluation protocol for cooperative
MARL", NeurIPS 2022, and the README of marl-eval 0.0.4.
"""

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from marlyap.errors import UserError
from marlyap.runs import groups
from marlyap.runs.run import Run
from marlyap.storage import store


Row = Mapping[str, Any]
NAMES = ("task", "algorithm", "seed", "steps")


def document(
    curves: Iterable[Row], final: Iterable[Row], environment: str = "marlyap"
) -> dict[str, Any]:
    """The document for rows of `task`, `algorithm`, `seed` and metrics; those of `curves` also have
    the environment `steps` at which the metrics were taken.

    Metrics that not all rows have are left out: the tool wants the same everywhere. Raises
    UserError where a run has no final row, or a task's runs were not evaluated equally often.
    """
    curves, final = list(curves), list(final)
    metrics = [k for k in final[0] if k not in NAMES] if final else []
    metrics = [k for k in metrics if all(k in row for row in [*curves, *final])]
    values = lambda row: {k: [float(row[k])] for k in metrics}
    runs: dict[tuple[str, str, str], dict[str, Any]] = {}
    for row in curves:
        run = runs.setdefault(_run(row), {})
        run[f"step_{len(run)}"] = {"step_count": int(row["steps"])} | values(row)
    absolute = {_run(row): values(row) for row in final}
    if len(absolute) < len(final):
        twice = next(key for key in absolute if sum(_run(row) == key for row in final) > 1)
        raise UserError(f"final: {twice[1]} seed {twice[2]} on {twice[0]} is there twice.")
    result: dict[str, Any] = {environment: {}}
    lengths: dict[str, int] = {}
    for (task, algorithm, seed), steps in runs.items():
        if (task, algorithm, seed) not in absolute:
            raise UserError(
                f"final: {algorithm} seed {seed} on {task} is not measured; evaluate it."
            )
        if lengths.setdefault(task, len(steps)) != len(steps):
            raise UserError(
                f"curves: {algorithm} seed {seed} on {task} has {len(steps)} evaluations, others "
                f"{lengths[task]}; marl-eval compares runs of equal length only."
            )
        place = result[environment].setdefault(task, {}).setdefault(algorithm, {})
        place[f"seed_{seed}"] = steps | {"absolute_metrics": absolute[task, algorithm, seed]}
    return result


def from_runs(directories: Iterable[Path]) -> dict[str, Any]:
    """The document for finished runs that `marlyap evaluate` has measured: success and return.

    Runs count as seeds of one algorithm only if they differ in nothing else; different settings
    of an algorithm are told apart in its name. Raises UserError where a run was not measured, or
    not on the starts of the others.
    """
    opened, curves, final, starts = [], [], [], set()
    for directory in directories:
        run, measured = Run.open(directory), directory / "evaluation.json"
        if not measured.is_file():
            raise UserError(f"run: {directory} is not measured; run `marlyap evaluate` on it.")
        end = store.read_json(measured)
        opened.append((run, end))
        starts.add((end.get("start_seed", 0), end.get("episodes")))
    if len(starts) > 1:
        raise UserError("run: not all were measured on the same starts; evaluate them together.")
    names = groups.named([groups.configured(run) for run, _ in opened])
    for (run, end), name in zip(opened, names, strict=True):
        task = run.labels["task"]
        about = {"task": task, "algorithm": name.removeprefix(f"{task} "), "seed": run.seed}
        looks = [line for line in run.history() if "success" in line]
        curves += [about | {k: line[k] for k in ("steps", "success", "return")} for line in looks]
        final.append(about | {"success": end["success_rate"], "return": end["return_mean"]})
    return document(curves, final)


def _run(row: Row) -> tuple[str, str, str]:
    return str(row["task"]), str(row["algorithm"]), str(row["seed"])
