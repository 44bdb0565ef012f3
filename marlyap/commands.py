"""What the verbs of the command line do."""

import dataclasses
import json
import shlex
import sys
import time
from argparse import Namespace
from collections.abc import Callable
from pathlib import Path
from typing import Any, cast

from rich import box
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from marlyap import config, film, store
from marlyap.algorithm import AbstractAlgorithm
from marlyap.algorithms import ALGORITHMS, PRESETS
from marlyap.certificate import sentence
from marlyap.certificates import CERTIFICATES
from marlyap.certificates.safety import has_rules
from marlyap.certify import certify, save
from marlyap.conformance import conformance
from marlyap.controllers import CONTROLLERS
from marlyap.errors import UserError
from marlyap.evaluation import Evaluation, compare, evaluate, pooled
from marlyap.game import AbstractGame
from marlyap.lyapunov_function import cost_sum
from marlyap.recheck import recheck
from marlyap.report import Film, Page, html
from marlyap.run import Run, expand
from marlyap.seeds import stream
from marlyap.tasks import TASKS
from marlyap.trainer import Trainer, schedule_for
from marlyap.workers import train_all


Result = tuple[dict[str, Any] | None, int]
Overrides = dict[str, str]
DEMO_STEPS = 204_800


def train(args: Namespace, overrides: Overrides) -> Result:
    """Make the runs, or open those to be resumed, and train them."""
    if args.resume:
        given = {"--seeds": args.seeds, "--steps": args.steps, "--preset": args.preset}
        given |= {"--out": args.out, "--force": args.force or None}
        for option in [k for k, v in given.items() if v is not None]:
            raise UserError(f"{option}: a run that is resumed goes on as it is; leave it out.")
        args.task, args.algorithm = args.task or args.own_task, args.algorithm or args.own_algorithm
        game, algorithm = own_code(args, overrides)
        runs = [Run.open(d, game, algorithm) for d in expand(args.resume)]
    else:
        if not args.task or not args.algorithm:
            raise UserError("train: name a task and an algorithm, as in train rendezvous masac.")
        runs = create(args, overrides)
    code = train_all(runs, args)
    state = [
        {"run": str(r.directory), "seed": r.seed, "steps": r.steps_done, "finished": r.finished}
        for r in runs
    ]
    say(f"{'Done' if code == 0 else 'Stopped'}: {', '.join(str(r.directory) for r in runs)}")
    return {"runs": state}, code


def create(args: Namespace, overrides: Overrides) -> list[Run]:
    """One new run for each seed."""
    trainer = assemble(args, overrides)
    names = {"task": args.task, "algorithm": args.algorithm, "preset": args.preset or "tuned"}
    safe = lambda name: Path(name.rpartition(":")[2]).stem if ":" in name else name
    out = args.out or Path("runs") / safe(args.task) / safe(args.algorithm)
    places = {seed: out / f"seed{seed}" for seed in seeds(args.seeds or ["0"])}
    for place in places.values():
        Run.vacant(place, args.force)
    return [Run.create(p, trainer, seed, names, args.force) for seed, p in places.items()]


def assemble(args: Namespace, overrides: Overrides) -> Trainer:
    """Task, algorithm and schedule as asked for."""
    preset = args.preset or "tuned"
    if preset not in PRESETS:
        raise UserError(f"preset: '{preset}' is unknown; {config.suggest(preset, PRESETS)}")
    game = config.load(args.task, AbstractGame)
    algorithm = PRESETS[preset](config.load(args.algorithm, AbstractAlgorithm))
    schedule = schedule_for(algorithm, preset)
    parts = {"task": game, "algorithm": algorithm, "schedule": schedule}
    for path, text in overrides.items():
        part, _, field = path.partition(".")
        try:
            parts[part] = config.override(parts[part], field, text)
        except UserError as error:
            raise UserError(f"--{part}.{error}") from None
    if args.steps is not None:
        parts["schedule"] = config.override(parts["schedule"], "steps", str(args.steps))
    return Trainer(parts["task"], parts["algorithm"], parts["schedule"])


def own_code(
    args: Namespace, overrides: Overrides
) -> tuple[AbstractGame | None, AbstractAlgorithm | None]:
    """Task and algorithm that the user named because the run's are his own code."""
    game = config.load(args.task, AbstractGame) if args.task else None
    algorithm = config.load(args.algorithm, AbstractAlgorithm) if args.algorithm else None
    for path, text in overrides.items():
        part, _, field = path.partition(".")
        if part != "task" or game is None:
            raise UserError(f"--{path}: here only --task.FIELD beside --task can be set.")
        game = config.override(game, field, text)
    return game, algorithm


def changed(game: AbstractGame, overrides: Overrides) -> AbstractGame:
    """The task of a run with some fields set anew: what its policy was not trained on."""
    for path, text in overrides.items():
        part, _, field = path.partition(".")
        if part != "task":
            raise UserError(f"--{path}: the policy is trained; only fields of the task can be set.")
        try:
            game = config.override(game, field, text)
        except UserError as error:
            raise UserError(f"--task.{error}") from None
    return game


def seeds(words: list[str]) -> list[int]:
    """The seeds asked for: whole numbers, each once."""
    try:
        numbers = [int(w) for word in words for w in word.split(",")]
    except ValueError:
        raise UserError(f"seeds: {' '.join(words)} are not all whole numbers.") from None
    if len(set(numbers)) != len(numbers):
        raise UserError(f"seeds: {' '.join(words)} names a seed twice.")
    if not all(0 <= n < 2**31 for n in numbers):
        raise UserError(f"seeds: {' '.join(words)} must lie between 0 and 2147483647.")
    return numbers


def measure(args: Namespace, overrides: Overrides) -> Result:
    """`evaluate`: every run and controller on the same fresh starts."""
    if not 0 < args.confidence < 1:
        raise UserError(f"confidence: {args.confidence} must lie between 0 and 1.")
    game, algorithm = own_code(args, overrides if args.task else {})
    found: list[tuple[str, str, Any, Evaluation]] = []
    directories = []
    for word in args.runs:
        if word in CONTROLLERS:
            if game is None:
                raise UserError(f"task: {word} needs --task, the task it is to be measured on.")
            result = evaluate(game, CONTROLLERS[word](game), args.episodes, args.seed)
            found.append((word, word, None, result))
        elif Path(word).exists():
            directories.append(Path(word))
        else:
            hint = config.suggest(word, CONTROLLERS)
            raise UserError(f"run: there is no run or controller '{word}'; {hint}")
    for directory in expand(directories):
        run = Run.open(directory, game, algorithm)
        there = changed(run.game, overrides)
        controller = run.controller(there) if overrides else run.controller()
        result = evaluate(there, controller, args.episodes, args.seed)
        found.append((str(directory), group(run), run, result))
    rows = [
        {"name": name, "group": g, "seed": run.seed if run else None} | e.summary(args.confidence)
        for name, g, run, e in found
    ]
    for (_, _, run, _), row in zip(found, rows, strict=True):
        if run and not overrides:
            store.write_text_atomic(
                run.directory / "evaluation.json", json.dumps(row, indent=1) + "\n"
            )
    names = list(dict.fromkeys(g for _, g, _, _ in found))
    together = {n: pooled([e for _, g, _, e in found if g == n]) for n in names}
    groups = [{"group": n} | e.summary(args.confidence) for n, e in together.items()]
    pairs = comparisons(found)
    whole = pooled([e for *_, e in found]).summary(args.confidence)
    if not args.json:
        tabulate(rows, groups, pairs)
    return whole | {
        "start_seed": args.seed,
        "runs": rows,
        "groups": groups,
        "comparisons": pairs,
    }, 0


def group(run: Run) -> str:
    """Runs that differ in their seed alone belong together."""
    preset = run.names["preset"]
    return f"{run.names['task']} {run.names['algorithm']}" + (
        f" ({preset})" if preset not in ("", "tuned") else ""
    )


def comparisons(found: list[tuple[str, str, Any, Evaluation]]) -> list[dict[str, Any]]:
    """McNemar's test for every pair of different groups, on the starts they share."""
    pairs = []
    for i, (name_a, group_a, _, a) in enumerate(found):
        for name_b, group_b, _, b in found[i + 1 :]:
            if group_a != group_b and len(a.final) == len(b.final) and len(pairs) < 100:
                pairs.append({"a": name_a, "b": name_b} | compare(a, b))
    return pairs


def tabulate(
    rows: list[dict[str, Any]], groups: list[dict[str, Any]], pairs: list[dict[str, Any]]
) -> None:
    """The evaluation as a table on standard output."""
    first, counts = rows[0], {row["episodes"] for row in rows}
    title = f"{counts.pop()} fresh starts" if len(counts) == 1 else "fresh starts"
    title += f"; success: all within {first['radius']:g} m at the last step"
    table = Table(title=title, title_justify="left", box=box.SIMPLE_HEAD, pad_edge=False)
    table.add_column("run", overflow="fold", min_width=16)
    percent = f"{100 * first['confidence']:g} %"
    heads = "success", percent, "in 0.05", "median", "95 %", "settled"
    for head in heads:
        table.add_column(head, justify="right", no_wrap=True)
    number = lambda v, digits: "-" if v is None else f"{v:.{digits}f}"
    several = len(rows) > len(groups)
    for row in rows + (groups if several else []):
        low, high = row["interval"]
        table.add_row(
            row.get("name") or f"all of {row['group']}",
            f"{100 * row['success_rate']:.1f} %",
            f"{100 * low:.1f}-{100 * high:.1f}",
            f"{100 * row['radii'][0]['success_rate']:.1f} %",
            number(row["final_distance"]["0.5"], 3),
            number(row["final_distance"]["0.95"], 3),
            number(row["settling_time"]["0.5"], 1),
        )
    console = Console()
    console.print(table)
    console.print("median and 95 %: worst final distance (m); settled: median time (s)\n")
    for pair in pairs:
        text = f"{pair['a']} against {pair['b']}: only the first {pair['only_a']}, "
        text += f"only the second {pair['only_b']}, McNemar p = {pair['p_value']:.2g}"
        console.print(text, highlight=False)


SAMPLED = ("reach", "reach-and-stay", "decrease", "contraction", "basin", "quantiles")


def certification(args: Namespace, overrides: Overrides) -> Result:
    """`certify`: the verdicts of several certificates on one controller, stored to be rechecked."""
    if not 0 < args.confidence < 1:
        raise UserError(f"confidence: {args.confidence} must lie between 0 and 1.")
    game, algorithm = own_code(args, overrides)
    out = args.out
    if args.run in CONTROLLERS:
        if game is None or out is None:
            missing = "--task TASK" if game is None else "--out DIRECTORY"
            raise UserError(f"certify: {args.run} is a controller, not a run; add {missing}.")
        controller: Any = CONTROLLERS[args.run](game)
    else:
        run = Run.open(expand([Path(args.run)])[0], game, algorithm)
        game, controller = run.game, run.controller()
        out = out or run.directory / "certificate"
    if out.exists() and not args.force:
        raise UserError(f"out: {out} already exists; choose another or add --force.")
    usual = (*SAMPLED, "linearisation", *(("safe",) if has_rules(game) else ()))
    chosen = {}
    for name in args.certificates or usual:
        if name not in CERTIFICATES:
            hint = config.suggest(name, CERTIFICATES)
            raise UserError(f"certificates: there is none called '{name}'; {hint}")
        c = CERTIFICATES[name]
        several = args.rollouts is not None and "rollouts" in config.fields(c)
        chosen[name] = dataclasses.replace(c, rollouts=args.rollouts) if several else c  # pyright: ignore
    V = cost_sum(game, controller, stream(args.seed, "calibrate"))
    if V.ball > game.radius:
        say(
            f"V ignores errors below {V.ball:g} m: started on the target, this controller drifts "
            "that far."
        )
    tell = say if args.json else print

    def begin(name: str) -> None:
        if sys.stderr.isatty():  # each takes some seconds
            say(f"{name} ...")

    result = certify(
        game,
        controller,
        chosen,
        args.seed,
        args.confidence,
        V=V,
        optional=() if args.certificates else usual,
        begin=begin,
        tell=lambda verdict: tell(f"[{verdict.evidence}] {sentence(verdict)}"),
    )
    for name, why in result["left_out"].items():
        tell(f"[left out] {name}: {why}")
    tell(f"Information: {result['information']}.")
    save(out, result, game, controller, V, replace=args.force)
    say(f"Certificate: {out}")
    return result | {"certificate": str(out)}, 0


def recheck_certificate(args: Namespace, overrides: Overrides) -> Result:
    """`recheck`: reject the certificate, or say of each verdict that it agrees.

    The exit code is 0 only if every verdict was derived again, and 1 where some could not be.
    """

    def tell(name: str, verdict: dict[str, Any]) -> None:
        if not args.json:
            mark = "holds" if verdict["holds"] else "does not hold"
            print(f"{name} agrees: {verdict['claim']}: {mark}.", flush=True)

    result = recheck(args.certificate, tell)
    done, left = len(result["rechecked"]), result["not_rechecked"]
    if not args.json:
        for name, why in left.items():
            print(f"NOT CHECKED: {name}: {why}.")
        print(
            f"{args.certificate}: {done} of {done + len(left)} verdicts were derived again; ",
            end="",
        )
        print("the file as a whole is not confirmed." if left else "all agree.")
    return result, int(not result["agrees"])


def check_task(args: Namespace, overrides: Overrides) -> Result:
    """`check-task`: one finding for every law; exit code 1 if one is broken."""
    game, _ = own_code(Namespace(task=args.task, algorithm=None), overrides)
    assert game is not None
    found = conformance(game, args.seed)
    if not args.json:
        table = Table(title=args.task, title_justify="left", show_header=False)
        for f in found:
            mark = "not looked at" if f.faults is None else "broken" if f.faults else "kept"
            figures = ", ".join(f"{name} {value:.3g}" for name, value in f.figures.items())
            text = "\n".join(f.faults or ()) or f.says + (f" ({figures})" if figures else "")
            table.add_row(f.law, mark, escape(text))
        Console().print(table)
    broken = any(f.faults for f in found)
    laws = {f.law: {"says": f.says, "faults": f.faults, "figures": f.figures} for f in found}
    return {"task": args.task, "passes": not broken, "laws": laws}, int(broken)


def report(args: Namespace, overrides: Overrides) -> Result:
    """Write the HTML page and the pictures."""
    game, algorithm = own_code(args, overrides)
    runs = [Run.open(d, game, algorithm) for d in expand(args.runs)]
    out = args.out or runs[0].directory / "report.html"
    page = film.page(runs, args.episodes, args.seed, command=shlex.join(["marlyap", *sys.argv[1:]]))
    store.write_text_atomic(out, html(cast(Page, page)))
    from marlyap import draw

    pictures = [out.with_name(f"{out.stem}-{name}") for name in ("starts.png", "learning.png")]
    draw.trajectories_png(page["films"], pictures[0])
    draw.learning_curves_png(page["runs"], pictures[1])
    say(f"Report: {out.resolve()}")
    summary = {k: page["summary"][k] for k in ("episodes", "successes", "success_rate", "interval")}
    return summary | {"report": str(out), "pictures": [str(p) for p in pictures]}, 0


def watch(args: Namespace, overrides: Overrides) -> Result:
    """Film one episode."""
    game, algorithm = own_code(args, overrides)
    run = Run.open(expand([args.run])[0], game, algorithm)
    place = args.out or run.directory
    if not place.is_dir():
        raise UserError(f"out: there is no directory {place}.")
    shot = film.one(run, args.episode, args.seed)
    from marlyap import draw

    gif, page = place / "film.gif", place / "film.html"
    draw.film_gif(cast(Film, shot), gif)
    store.write_text_atomic(
        page, html(cast(Page, {"title": f"One episode of {run.title}", "films": [shot]}))
    )
    say(f"Film: {page.resolve()} and {gif.resolve()}")
    return {"gif": str(gif), "html": str(page), "success": bool(shot["success"])}, 0


def listing(args: Namespace, overrides: Overrides) -> Result:
    """What there is, or the fields of one of them."""
    if args.name:
        return fields_of(args.name, args.json), 0
    families: dict[str, dict[str, Any]] = {
        "tasks": TASKS,
        "algorithms": ALGORITHMS,
        "controllers": CONTROLLERS,
    }
    result = {
        title: {name: summary(thing) for name, thing in family.items()}
        for title, family in families.items()
    }
    if not args.json:
        console = Console()
        for title, members in result.items():
            table = Table(
                title=title, title_justify="left", show_header=False, box=None, padding=(0, 2)
            )
            for name, text in members.items():
                table.add_row(f"[bold]{name}[/]", text)
            console.print(table, "")
    return result, 0


def summary(thing: Any) -> str:
    """The first line of its documentation."""
    cls = thing if isinstance(thing, type) else type(thing)
    line = (cls.__doc__ or "").strip().splitlines()[0]
    if isinstance(thing, AbstractGame):
        n, who = thing.agents, len(thing.leaders)
        limits = " and ".join(f"{u:g}" for u in thing.dynamics.limits)
        several = "s" * (who > 1)
        line += f" ({n} agents, {who} leader{several}, {thing.graph} graph, limits {limits})"
    elif isinstance(thing, AbstractAlgorithm) and (set_here := changes(thing)):
        line += f" ({', '.join(set_here)})"
    return line


def changes(thing: Any, prefix: str = "") -> list[str]:
    """The fields, nested ones too, that are not what their class has by default."""
    usual, found = config.fields(type(thing)()), []
    for name, value in config.fields(thing).items():
        if config.show(value) != config.show(usual[name]):
            found.append(f"{prefix}{name} {config.show(value)}")
        if dataclasses.is_dataclass(value):
            found += changes(value, f"{prefix}{name}.")
    return found


def fields_of(name: str, quiet: bool) -> dict[str, Any]:
    """Every field of a task or algorithm with its value, for overriding."""
    family = AbstractGame if name in TASKS else AbstractAlgorithm
    if name not in TASKS and name not in ALGORITHMS:
        raise UserError(
            f"name: there is no task or algorithm '{name}'; "
            f"{config.suggest(name, [*TASKS, *ALGORITHMS])}"
        )
    rows = config.describe(config.load(name, family), config.WORDS[family])
    table = Table(title=name, title_justify="left")
    for head in ("option", "value", "meaning"):
        table.add_column(head)
    for option, value, note in rows:
        table.add_row(f"--{option}", value, note)
    if not quiet:
        Console().print(table)
    return {f"--{option}": {"value": value, "meaning": note} for option, value, note in rows}


def demo(args: Namespace, overrides: Overrides) -> Result:
    """Train, evaluate and report the main task; what is trained already is kept."""
    start = time.monotonic()
    names = [args.out / f"seed{s}" for s in seeds(args.seeds)]
    job = Namespace(
        task="rendezvous",
        algorithm="masac-lyapunov",
        preset=None,
        seeds=args.seeds,
        out=args.out,
        steps=DEMO_STEPS if args.steps is None else args.steps,
        force=args.again,
        parallel="auto",
        json=False,
        worker=False,
        device=None,
    )
    there = [d for d in names if (d / "run.json").is_file()]
    if there and not args.again:
        missing = [d for d in names if d not in there]
        if missing:
            raise UserError(
                f"seeds: {missing[0]} is not there beside {there[0]}; train all anew by --again."
            )
        runs = [Run.open(d) for d in names]
        say(f"{args.out} holds these runs; going on with them. To train anew: demo --again")
    else:
        runs = create(job, overrides)
    code = train_all([r for r in runs if not r.finished], job)
    if code:
        return None, code
    out = args.out / "report.html"
    result, _ = report(
        Namespace(runs=names, out=out, episodes=500, seed=0, task=None, algorithm=None), {}
    )
    assert result is not None
    low, high = (100 * end for end in result["interval"])
    rate, seconds = 100 * result["success_rate"], time.monotonic() - start
    text = f"{result['successes']} of {result['episodes']} fresh starts succeeded: {rate:.1f} % "
    text += f"(95 % interval {low:.1f} to {high:.1f} %), in {seconds:.0f} s."
    print(text, file=sys.stderr if args.json else sys.stdout)
    return result | {"seconds": time.monotonic() - start}, 0


def say(text: str) -> None:
    """A line for the person; standard output is kept for results."""
    print(text, file=sys.stderr)


VERBS: dict[str, Callable[[Namespace, Overrides], Result]] = {
    "demo": demo,
    "train": train,
    "evaluate": measure,
    "certify": certification,
    "recheck": recheck_certificate,
    "check-task": check_task,
    "report": report,
    "watch": watch,
    "list": listing,
}
