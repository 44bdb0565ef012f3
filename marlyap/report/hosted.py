"""What a report says of runs on games outside JAX, and their films."""

import time
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from marlyap.report.data import Group, LogRow, Page, Trained, Training
from marlyap.runs import config
from marlyap.runs.run import Run
from marlyap.storage import store
from marlyap.storage.hashing import policy_hash


def gather_hosted(
    runs: Sequence[Run], found: Sequence[Mapping[str, Any]], seed: int, command: str = ""
) -> Page:
    """The page about these runs; `found` has the summary of each one's evaluation."""
    labels = [f"seed {run.seed}" if len(runs) > 1 else run.title for run in runs]
    titles = list(dict.fromkeys(f"{r.labels['task']} {r.labels['algorithm']}" for r in runs))
    keys = ("episodes", "return_mean", "success_rate", "successes", "interval", "confidence")
    shown = [{k: one[k] for k in keys if k in one} for one in found]
    rows = [
        Trained(
            name=str(run.directory),
            label=label,
            group=titles[0],
            seed=run.seed,
            log=log(run),
            **told,
        )
        for run, label, told in zip(runs, labels, shown, strict=True)
    ]
    group = Group(label=titles[0], seeds=[r.seed for r in runs], text=words(found), **shown[0])
    return Page(
        title=", ".join(titles),
        subtitle=f"{runs[0].trainer.agents} agents, played outside JAX; {len(runs)} runs",
        generated=time.strftime("%Y-%m-%d %H:%M UTC", time.gmtime()),
        starts=seed,
        groups=(group,) if len(runs) == 1 else (),
        runs=tuple(rows),
        notes=(words(found), "certificates and films of places need a game of marlyap's."),
        config=config.record(runs[0].trainer.game),
        training=tuple(training(run, label) for run, label in zip(runs, labels, strict=True)),
        versions=store.versions(),
        command=command,
    )


def training(run: Run, label: str) -> Training:
    """When and with what a run was made."""
    about = store.read_json(run.directory / "run.json")
    seconds = [line.get("seconds") for line in run.history()[-1:]]
    return Training(
        name=label,
        made=str(about.get("created") or ""),
        seed=run.seed,
        seconds=seconds[0] if seconds else None,
        policy=policy_hash(run.deployed()[0])[:12],
        versions={str(k): str(v) for k, v in about.get("versions", {}).items()},
    )


def log(run: Run) -> tuple[LogRow, ...]:
    """The training's lines, for the curves."""
    return tuple(
        LogRow(line["steps"], line.get("success"), line.get("return"))
        for line in run.history()
        if "steps" in line
    )


def words(found: Sequence[Mapping[str, Any]]) -> str:
    """The return in one sentence."""
    means = [one["return_mean"] for one in found]
    each = found[0]["episodes"]
    if len(means) == 1:
        low, high = found[0].get("return_interval", [means[0]] * 2)
        return f"return {means[0]:.2f} ({low:.2f} to {high:.2f}) over {each} episodes"
    return (
        f"return {np.mean(means):.2f} over {len(means)} training seeds "
        f"({min(means):.2f} to {max(means):.2f}), {each} episodes each"
    )
