"""The figures of a sweep in rows: one a job, or one a number of a learning curve. No JAX here."""

import csv
import io
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from marlyap.storage import store
from marlyap.sweeps.jobs import Status
from marlyap.sweeps.plan import Plan


FIGURES = (
    *("steps", "updates", "seconds", "cpu_seconds", "return", "success", "best"),
    *("held_out", "low", "high", "episodes", "final_p50", "final_p95", "policy", "host"),
)
ABOUT = ("iteration", "steps", "updates", "seconds", "seed")  # of a line of a log; not a figure


def rows(plan: Plan, statuses: Sequence[Status]) -> list[dict[str, Any]]:
    """A row for each job: what is set in it, how it stands, what it came to."""
    found = []
    for status in statuses:
        result = status.result or {}
        figures = {**status.last, **result}
        row = {"sweep": status.job.sweep.name, "cell": status.job.cell.name}
        row |= {"seed": status.job.seed, "status": status.state}
        row |= {name: _number(status.job.cell.set.get(name, "")) for name in plan.varied}
        row |= {name: figures.get(name) for name in FIGURES}
        row |= {"versions": _versions(result.get("versions", {})), "says": status.says}
        found.append(row)
    return found


def _versions(found: Mapping[str, str]) -> str:
    return " ".join(f"{name} {version}" for name, version in found.items())


def _number(text: str) -> Any:
    """What was typed, as a number where it is one."""
    for kind in (int, float):
        try:
            return kind(text)
        except ValueError:
            continue
    return text


def curves(statuses: Sequence[Status]) -> list[dict[str, Any]]:
    """A row for each figure of each line of the logs: cell, seed, steps, metric, value."""
    found = []
    for status in statuses:
        path = status.job.directory / "log.jsonl"
        for line in store.read_jsonl(path) if path.is_file() else []:
            about = {"cell": status.job.cell.name, "seed": status.job.seed}
            about |= {"steps": line["steps"]}
            metrics = (item for item in line.items() if item[0] not in ABOUT)
            found += [about | {"metric": k, "value": v} for k, v in metrics]
    return found


def text(found: Iterable[Mapping[str, Any]]) -> str:
    """Rows as CSV; what is not known is left empty."""
    found, out = list(found), io.StringIO()
    names = list(dict.fromkeys(name for row in found for name in row))
    writer = csv.DictWriter(out, names, lineterminator="\n")
    writer.writeheader()
    writer.writerows(found)
    return out.getvalue()
