"""What the experiments share: cases are trained, measured into tidy tables, and drawn from those.

An experiment NAME on a task leaves in `--results`

    NAME-TASK-curves.csv       one row for each case, seed and iteration
    NAME-TASK-contraction.csv  one row for each case and seed: how often the cost contracts by BETA
                               over T steps, and by how much (beta98) from 98 % of the starts
    NAME-TASK-success.csv      one row for each case, seed and radius, with its exact 95 % interval;
                               the share of episodes at rest and of those that stay for ten
                               horizons, median final speed (m/s) and spin (rad/s) of the fastest
                               agent, the policy's hash, and where the row was made
    NAME-TASK.png, .json       the figure, and curves and success in the schema of marl-eval

A row that is there is not made again: started anew, a script goes on where it was. Runs are kept in
`--runs`, without their replay memories once they are measured unless --keep says so.
"""

import argparse
import csv
import io
import json
import re
import shutil
import sys
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import numpy as np

from marlyap import statistics
from marlyap.certificates.contraction import Contraction
from marlyap.errors import UserError
from marlyap.games.game import AbstractGame
from marlyap.learning.algorithm import AbstractAlgorithm
from marlyap.learning.trainer import SCHEDULES, Schedule, Trainer
from marlyap.report.scene import PALETTE
from marlyap.runs import events
from marlyap.runs.config import fields
from marlyap.runs.launch import Launch, launch
from marlyap.runs.marl_eval import document
from marlyap.runs.progress import show
from marlyap.runs.provenance import provenance
from marlyap.runs.run import Run
from marlyap.runs.stop import Stop
from marlyap.seeds import stream
from marlyap.simulation.evaluation import Evaluation, evaluate, share
from marlyap.simulation.rollout import rollout
from marlyap.storage.hashing import policy_hash
from marlyap.storage.store import write_text_atomic
from marlyap.tasks import TASKS


Row = dict[str, Any]
TINY = {"actor_width": 8, "critic_width": 8, "batch": 16}
QUICK = Schedule(
    steps=320, environments=4, steps_per_update=32, warmup=160, select_every=1, select_episodes=8
)
TOGETHER = 4  # cases that are trained before they are measured
RADIUS = 0.1  # m, of success where there is one only
T, BETA = 20, 0.1  # the cost is to fall by this share over so many steps
MOST = Contraction().share  # of the starts, from which certificate C3 asks it


@dataclass(frozen=True)
class Case:
    """What is trained, and the columns that tell it from the other cases of its experiment."""

    about: Row
    game: AbstractGame
    algorithm: AbstractAlgorithm
    schedule: Schedule

    @property
    def label(self) -> str:
        return label(self.about, [c for c in self.about if c not in ("task", "budget")])

    def run(self, root: Path, seed: int) -> Run:
        """The run of one seed, made if it is not there."""
        words = [re.sub(r"[^\w.=+-]+", "_", str(v)) for v in self.about.values()]
        place = root.joinpath(*words, f"seed{seed}")
        if (place / "run.json").is_file():
            return Run.open(place)
        names = {"task": str(self.about["task"]), "algorithm": self.label, "preset": ""}
        return Run.create(place, Trainer(self.game, self.algorithm, self.schedule), seed, names)

    def quick(self) -> "Case":
        """The same in a second, to see that it works; it learns nothing."""
        tiny = {k: v for k, v in TINY.items() if k in fields(self.algorithm)}
        return replace(self, algorithm=replace(self.algorithm, **tiny), schedule=QUICK)


def options(doc: str, **defaults: Any) -> argparse.Namespace:
    """The command line of every experiment."""
    p = argparse.ArgumentParser(
        description=doc, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    o = {"task": "rendezvous", "steps": 204_800, "seeds": range(5), "episodes": 500} | defaults
    here = Path(__file__).parent / "results"
    p.add_argument("--task", default=o["task"], choices=list(TASKS))
    p.add_argument("--steps", type=int, default=o["steps"], help="environment steps of each run")
    p.add_argument("--seeds", type=int, nargs="+", default=list(o["seeds"]), help="of training")
    p.add_argument("--episodes", type=int, default=o["episodes"], help="held-out starts")
    p.add_argument("--only", default="", help="only this case, or those with this in their names")
    p.add_argument("--list", action="store_true", help="name the cases and stop")
    p.add_argument("--runs", type=Path, default=Path("runs/experiments"), help="where runs go")
    p.add_argument("--results", type=Path, default=here, help="where tables and figures go")
    p.add_argument("--keep", action="store_true", help="keep the checkpoints of measured runs")
    p.add_argument("--quick", action="store_true", help="two cases, two seeds, seconds")
    p.add_argument("--draw", action="store_true", help="only the figure, from the tables")
    return p.parse_args()


def only(cases: Iterable[Case], args: argparse.Namespace) -> list[Case]:
    """The case of the name asked for, or all that have it in their names; exits if none has."""
    cases = list(cases)
    exact = [case for case in cases if case.label == args.only]
    chosen = exact or [case for case in cases if args.only in case.label]
    if not chosen:
        print(f"only: no case has '{args.only}' in its name; --list names them.", file=sys.stderr)
        raise SystemExit(2)
    return chosen


def at_budget(name: str, args: argparse.Namespace) -> str:
    """The name, and the budget where it is not the tuned schedule's."""
    return name if args.steps == SCHEDULES["tuned"].steps else f"{name}-{args.steps}"


def schedule(args: argparse.Namespace, **changes: Any) -> Schedule:
    """The tuned schedule at the budget asked for."""
    return replace(SCHEDULES["tuned"], steps=args.steps, **changes)


def experiment(
    name: str,
    cases: Sequence[Case],
    args: argparse.Namespace,
    draw: Callable[[argparse.Namespace, str], None] | None = None,
    plain: str = "",
) -> None:
    """Train what is missing, measure it, and draw the figure from the tables.

    With `plain`, the other cases are held against the one of that name.
    """
    cases = only(cases, args)
    if args.list:
        print(*(case.label for case in cases), sep="\n")
        return
    args.results.mkdir(parents=True, exist_ok=True)
    if args.quick:
        usual = [case.quick() for case in cases if case.game == TASKS[args.task]]
        cases, args.seeds, args.episodes = usual[:2], args.seeds[:2], 20
    if not args.draw:
        for k in range(0, len(cases), TOGETHER):
            fill(name, cases[k : k + TOGETHER], args)
    name = f"{name}-{args.task}"
    if not read(args, f"{name}-success"):
        print(f"results: {args.results} has no table of {name}; leave out --draw.", file=sys.stderr)
        raise SystemExit(2)
    export(name, args)
    (draw or forest)(args, name)
    if plain:
        improvements(args, name, plain)


def fill(name: str, cases: Sequence[Case], args: argparse.Namespace) -> None:
    """Train and measure those of the cases whose rows are not there."""
    root, name = args.runs / name, f"{name}-{args.task}"
    columns = [*cases[0].about, "seed"]
    there = {tuple(row[c] for c in columns) for row in read(args, f"{name}-success")}
    key = lambda case, seed: tuple(str(v) for v in (*case.about.values(), seed))
    wanted = [(c, s) for c in cases for s in args.seeds if key(c, s) not in there]
    runs = {key(c, s): c.run(root, s) for c, s in wanted}
    train(list(runs.values()), args.quick)
    for case, seed in wanted:
        run = runs[key(case, seed)]
        if not run.finished:  # it diverged
            continue
        about = case.about | {"seed": seed}
        controller = run.controller()
        found, falls = measure(run.game, controller, args.episodes)
        kept = ("steps", "updates", "success", "return")
        history = run.history()
        looks = [line for line in history if "success" in line or len(history) <= 200]
        curves = [about | {k: line.get(k, "") for k in kept} for line in looks]
        put(args, f"{name}-curves", columns, curves)
        by = {"beta98": float(np.sort(falls)[len(falls) - round(MOST * len(falls))])}
        contraction = about | {"T": T, "beta": BETA} | counted(falls >= BETA) | by
        put(args, f"{name}-contraction", columns, [contraction])
        made = after(found) | {"policy": policy_hash(controller)} | provenance()
        success = [about | {"radius": r} | counted(found.final <= r) | made for r in found.radii]
        put(args, f"{name}-success", columns, success)
        if not args.keep:
            shutil.rmtree(run.directory / "checkpoints", ignore_errors=True)


def train(runs: list[Run], quick: bool) -> None:
    """Train to the end, or until a number stops being finite: those diverged.

    With `quick`, one after the other in this process.
    """
    given_up: list[events.Failed] = []

    def kept(happening: Iterator[events.Event]) -> Iterator[events.Event]:
        for event in happening:
            given_up.extend([event] if isinstance(event, events.Failed) else [])
            yield event

    with Stop() as stop:
        for some in [[run] for run in runs] if quick else [runs]:
            if stop():
                break
            before = len(given_up)
            try:
                show(kept(launch(some, Launch(), stop)))
            except UserError:
                if len(given_up) == before:
                    raise
    for event in given_up:
        print(f"diverged: {event.says}")
    if stop():
        raise SystemExit(stop.code)


@eqx.filter_jit
def _falls(game: AbstractGame, controller: Any, keys: Any) -> Any:
    def one(key):
        k_start, k_act = jax.random.split(key)
        long = rollout(game, controller, game.reset(k_start), k_act, game.horizon + 1)
        return Contraction(T=min(T, game.horizon)).judge(game, None, long, k_act).figures["beta"]

    return jax.vmap(one)(keys)


def measure(
    game: AbstractGame, controller: Any, episodes: int, beyond: int | None = None
) -> tuple[Evaluation, np.ndarray]:
    """From the starts of `marlyap evaluate`: what it finds there, and how the cost contracts.

    By that share of itself, at least, it falls over every T steps that begin above the radius.
    """
    found = evaluate(game, controller, episodes, beyond=beyond)
    falls = _falls(game, controller, jax.random.split(stream(0, "evaluate"), episodes))
    return found, np.asarray(falls)


def after(found: Evaluation) -> Row:
    """Columns for what the team does once it has arrived."""
    stayed = float(np.mean(found.stayed)) if found.beyond else ""  # a plan ends at the horizon
    still = {"at_rest": float(np.mean(found.at_rest)), "stayed": stayed}
    return still | {"speed": float(np.median(found.speed)), "spin": float(np.median(found.spin))}


def counted(hits: np.ndarray) -> Row:
    """Columns for a share of episodes."""
    s = share(hits, 0.95)
    rate = {k: s[k] for k in ("episodes", "successes", "success_rate")}
    return rate | dict(zip(("low", "high"), s["interval"], strict=True))


def put(args: argparse.Namespace, name: str, key: list[str], rows: list[Row]) -> None:
    """Add rows to a table, in the place of those it has with the same key; all or nothing."""
    of = lambda row: tuple(str(row[c]) for c in key)
    new = {of(row) for row in rows}
    table = [row for row in read(args, name) if of(row) not in new] + rows
    text = io.StringIO()
    writer = csv.DictWriter(text, list(rows[0]), lineterminator="\n")
    writer.writeheader()
    writer.writerows(table)
    write_text_atomic(args.results / f"{name}.csv", text.getvalue())


def read(args: argparse.Namespace, name: str) -> list[dict[str, str]]:
    """A table; empty if it is not there."""
    path = args.results / f"{name}.csv"
    if not path.is_file():
        return []
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


NUMBERS = (
    "radius episodes successes success_rate low high T beta beta98 steps updates success return "
    "at_rest stayed speed spin policy machine cpu commit"
).split()


def label(row: Row, columns: Iterable[str]) -> str:
    """What a case is called."""
    return " ".join(str(row[c]) for c in columns if row[c] != "")


def labels(rows: Sequence[Row]) -> list[str]:
    """What the case of each row of a table is called, by the columns that tell them apart."""
    about = [c for c in (rows[0] if rows else ()) if c not in ("task", "seed", *NUMBERS)]
    telling = [c for c in about if len({row[c] for row in rows}) > 1]
    return [label(row, telling or about) for row in rows]


class Estimate(NamedTuple):
    """Interquartile mean over seeds, its 95 % interval over seeds and episodes, and the seeds'.

    That interval is a bootstrap's, which covers less than it says with few seeds
    (reliability/coverage.py has measured how much). `expected` is the interval for the plain mean
    of a rate over training seeds, which holds whatever their distribution.
    """

    mean: float
    low: float
    high: float
    seeds: np.ndarray
    expected: statistics.Interval | None  # None for what is not a share


def estimate(rows: Iterable[Row]) -> Estimate:
    """Of one case, from the counts of its seeds; exact where there is one seed.

    What has no counts is resampled over seeds alone, and has no interval where there is one.
    """
    rows = list(rows)
    rates = np.array([float(row["success_rate"]) for row in rows])
    counts = [(int(row["successes"]), int(row["episodes"])) for row in rows if row["successes"]]
    if len(rows) > 1:
        episodes = [np.repeat([1.0, 0.0], [k, n - k]) for k, n in counts] or rates[:, None]
        low, high = statistics.two_level_bootstrap(episodes)
    elif counts:
        low, high = statistics.clopper_pearson(*counts[0], 0.95)
    else:
        low = high = rates[0]
    share = bool(np.all((rates >= 0) & (rates <= 1)))
    expected = statistics.mean_interval(rates) if share and len(rows) > 1 else None
    return Estimate(statistics.iqm(rates), low, high, rates, expected)


AFTER = {"at_rest": "at rest at the last step", "stayed": "stays for ten horizons"}


def measured(args: argparse.Namespace, name: str) -> dict[str, dict[str, list[Row]]]:
    """For each measure, the rows of each case, in the order of the tables."""
    success = [row for row in read(args, f"{name}-success") if row["radius"] in ("0.05", "0.1")]
    contraction = read(args, f"{name}-contraction")
    groups: dict[str, dict[str, list[Row]]] = defaultdict(lambda: defaultdict(list))
    for row, case in zip(success, labels(success), strict=True):
        groups[f"success within {row['radius']} m"][case].append(row)
    for row, case in zip(success, labels(success), strict=True):
        for column, name in AFTER.items():
            if row["radius"] == f"{RADIUS:g}" and row.get(column):
                count = round(float(row[column]) * int(row["episodes"]))
                about = row | {"success_rate": row[column], "successes": str(count)}
                groups[name][case].append(about)
    for row, case in zip(contraction, labels(contraction), strict=True):
        groups[f"cost falls by {row['beta']} in {row['T']} steps"][case].append(row)
        if row.get("beta98"):
            by = {"success_rate": row["beta98"], "successes": ""}
            groups[f"fall in {row['T']} steps, {MOST:.0%} of starts"][case].append(by)
    return groups


def forest(args: argparse.Namespace, name: str) -> None:
    """The figure, and the same on standard output: a line a case, a panel a measure."""
    tables = measured(args, name)
    found = {m: {c: estimate(rows) for c, rows in by.items()} for m, by in tables.items()}
    for measure, cases in found.items():
        print(f"{name}, {measure}: interquartile mean over seeds with its bootstrap interval; mean")
        print("  with its interval for the expectation over training seeds (95 % each); worst seed")
        for case, e in cases.items():
            mean = f"{e.seeds.mean():.4f}"
            if e.expected is not None:
                mean += f" [{e.expected.low:.4f}, {e.expected.high:.4f}]"
            worst = f"{mean}  {e.seeds.min():.3f} of {len(e.seeds)}"
            print(f"  {case:<44} {e.mean:.4f} [{e.low:.4f}, {e.high:.4f}]  {worst}")
    speeds(args, name)
    order = list(dict.fromkeys(case for cases in found.values() for case in cases))
    figure, panels = canvas(len(found), 3.0, 0.9 + 0.24 * len(order))
    for axes, (measure, cases) in zip(panels, found.items(), strict=True):
        for case, e in cases.items():
            y = -order.index(case)
            axes.plot(e.seeds, [y] * len(e.seeds), "|", color="#9a9da6", markersize=7)
            axes.plot([e.low, e.high], [y, y], color="#0b62a4", linewidth=1.6)
            axes.plot(e.mean, y, "o", color="#0b62a4", markersize=4)
        least = min(0.0, *(min(e.low, *e.seeds) for e in cases.values()))
        axes.set(xlim=(least - 0.03, 1.03), ylim=(0.6 - len(order), 0.6), title=measure)
        axes.set_yticks([-k for k in range(len(order))])
        first = axes.get_subplotspec().is_first_col()
        axes.set_yticklabels(order if first else [], fontsize=7)
    save(figure, args.results / f"{name}.png")


def speeds(args: argparse.Namespace, name: str) -> None:
    """On standard output: how fast the teams of each case still are at the last step."""
    rows = [r for r in read(args, f"{name}-success") if r["radius"] == f"{RADIUS:g}"]
    found = defaultdict(list)
    for row, case in zip(rows, labels(rows), strict=True):
        if row.get("speed"):
            found[case].append((float(row["speed"]), float(row["spin"])))
    if found:
        print(
            f"{name}: final speed (m/s) and spin (rad/s) of the fastest agent; median seed, worst"
        )
    for case, pairs in found.items():
        (speed, spin), (fast, turning) = np.median(pairs, axis=0), np.max(pairs, axis=0)
        print(f"  {case:<44} {speed:.3f} {spin:.2f}  {fast:.3f} {turning:.2f} of {len(pairs)}")


def improvements(args: argparse.Namespace, name: str, plain: str) -> None:
    """On standard output: how probably each case is above the plain one, measure by measure."""
    rates = lambda rows: [float(row["success_rate"]) for row in rows]
    for measure, cases in measured(args, name).items():
        for case in [c for c in cases if c != plain and plain in cases]:
            if min(len(cases[case]), len(cases[plain])) < 2:
                print(f"P({case} above {plain}) needs two seeds or more of each, {measure}")
                continue
            better = statistics.probability_of_improvement
            p, (low, high) = better(rates(cases[case]), rates(cases[plain]))
            print(f"P({case} above {plain}) = {p:.2f} [{low:.2f}, {high:.2f}], {measure}")


def canvas(panels: int, width: float, height: float) -> tuple[Any, list[Any]]:
    """A figure with several panels, at most four side by side."""
    from matplotlib.figure import Figure

    across, down = min(panels, 4), -(-panels // 4)
    figure = Figure(figsize=(width * across + 1.5, height * down), layout="constrained")
    grid = list(np.ravel(figure.subplots(down, across, squeeze=False)))
    for axes in grid[panels:]:
        axes.set_axis_off()
    for axes in grid[:panels]:
        axes.set_prop_cycle(color=PALETTE)
        axes.spines[["top", "right"]].set_visible(False)
        axes.grid(axis="x", color="#ecebe6")
        axes.tick_params(labelsize=7)
        axes.title.set_fontsize(8)
    return figure, grid[:panels]


def save(figure: Any, path: Path) -> None:
    """Write the figure, and say where."""
    for axes in figure.axes:
        axes.title.set_fontsize(8)
    figure.savefig(path, dpi=150)
    print(path)


def export(name: str, args: argparse.Namespace) -> None:
    """The tables as marl-eval reads them, where it could compare the runs."""
    success = [row for row in read(args, f"{name}-success") if float(row["radius"]) == RADIUS]
    curves = [row for row in read(args, f"{name}-curves") if row["success"]]
    if not success:
        return
    measured = ((success, "success_rate"), (curves, "success"))
    final, looks = (
        [
            {k: row[k] for k in ("task", "seed", "steps") if k in row}
            | {"algorithm": case, "success": row[column]}
            for row, case in zip(rows, labels(rows), strict=True)
        ]
        for rows, column in measured
    )
    try:
        text = json.dumps(document(looks, final), indent=1) + "\n"
    except UserError as error:
        print(f"not exported for marl-eval: {error}")
    else:
        write_text_atomic(args.results / f"{name}.json", text)
