"""What the verbs of the command line do."""

import dataclasses
import json
import re
import secrets
import shlex
import shutil
import sys
import time
from argparse import Namespace
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from rich import box
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from marlyap import config, groups, store
from marlyap.algorithm import AbstractAlgorithm
from marlyap.algorithms import ALGORITHMS, PRESETS
from marlyap.certificate import arrival, sentence
from marlyap.certificates import CERTIFICATES
from marlyap.certificates.safety import has_rules
from marlyap.certify import certify, save
from marlyap.conformance import conformance
from marlyap.controllers import CONTROLLERS, names_a_controller
from marlyap.errors import UserError, within
from marlyap.evaluation import RESTS, evaluate
from marlyap.game import AbstractGame, regulated
from marlyap.lyapunov_function import cost_sum
from marlyap.recheck import recheck
from marlyap.report import contents, episodes
from marlyap.report.data import MARK, Page
from marlyap.run import Run, expand
from marlyap.seeds import stream
from marlyap.sensing import Entry
from marlyap.subject import asked, refuse_all_but_task, subject, supplies
from marlyap.tasks import TASKS
from marlyap.trainer import SCHEDULES, Trainer, schedule_for
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
            raise UserError(f"{option}: a resumed run keeps its settings; leave it out.")
        args.task, args.algorithm = args.task or args.own_task, args.algorithm or args.own_algorithm
        if overrides:
            raise UserError(f"--{next(iter(overrides))}: a run that is resumed keeps its settings.")
        game = config.load(args.task, AbstractGame) if args.task else None
        rule = config.load(args.algorithm, AbstractAlgorithm) if args.algorithm else None
        runs = [Run.open(d, game, rule) for d in expand(args.resume)]
        for run in runs:
            keeps(run, args, game, rule)
            for warning in run.warnings:
                say(f"warning: {warning}")
        readable(runs)
    else:
        if args.own_task or args.own_algorithm:
            option = "--task" if args.own_task else "--algorithm"
            raise UserError(f"{option}: it is for --resume; a new run is train TASK ALGORITHM.")
        if not args.task or not args.algorithm:
            raise UserError("train: name a task and an algorithm, as in train rendezvous masac.")
        runs = create(args, overrides)
    code = trained(runs, args, new=not args.resume)
    state = [
        {"run": str(r.directory), "seed": r.seed, "steps": r.steps_done, "finished": r.finished}
        for r in runs
    ]
    say(f"{'Done' if code == 0 else 'Stopped'}: {', '.join(str(r.directory) for r in runs)}")
    return {"runs": state}, code


def trained(runs: list[Run], args: Namespace, new: bool) -> int:
    """Train; a new run in which training could not begin leaves no directory behind."""
    try:
        return train_all(runs, args)
    except BaseException:
        for run in runs if new else ():
            if run.untouched:
                shutil.rmtree(run.directory, ignore_errors=True)
                with suppress(OSError):  # as when other runs are in it
                    run.directory.parent.rmdir()
        raise


def keeps(
    run: Run, args: Namespace, game: AbstractGame | None, rule: AbstractAlgorithm | None
) -> None:
    """Raise UserError if another task or algorithm is named than the run was trained with."""
    own_rule = rule is not None and bool(config.own_classes(run.trainer.algorithm))
    fits = {
        "task": game is None or supplies(args.task, game, run),
        "algorithm": rule is None or own_rule,
    }
    for part, is_own in fits.items():
        if not is_own and getattr(args, part) != run.names[part]:
            raise UserError(
                f"{part}: {run.directory} was trained with {run.labels[part]}, and a run that is "
                "resumed keeps it; leave the other out."
            )


def readable(runs: list[Run]) -> None:
    """Raise UserError where a finished run has no sound checkpoint left; nothing would train it."""
    for run in runs:
        if run.finished:
            for warning in run.checkpoints.latest().warnings:
                say(f"warning: {warning}")


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
    parts = config.override_all(parts, overrides)
    if args.steps is not None:
        parts["schedule"] = config.override(parts["schedule"], "steps", str(args.steps))
    return Trainer(parts["task"], parts["algorithm"], parts["schedule"])


def seeds(words: list[str]) -> list[int]:
    """The seeds asked for: whole numbers, each once."""
    each = [w for word in words for w in word.split(",")]
    for word in each:
        if not re.fullmatch(r"[+-]?\d+", word.strip()):
            raise UserError(f"seeds: '{word}' is not a whole number.")
    numbers = [int(w) for w in each]
    if len(set(numbers)) != len(numbers):
        raise UserError(f"seeds: {' '.join(words)} names a seed twice.")
    if not all(0 <= n < 2**31 for n in numbers):
        raise UserError(f"seeds: {' '.join(words)} must lie between 0 and 2147483647.")
    return numbers


def measure(args: Namespace, overrides: Overrides) -> Result:
    """`evaluate`: every run and controller on the same held-out starts."""
    if not 0 < args.confidence < 1:
        raise UserError(f"confidence: {args.confidence} must lie between 0 and 1.")
    if args.out is not None and not args.out.parent.is_dir():
        raise UserError(f"out: there is no directory {args.out.parent}.")
    starts = starts_of(args.seed)
    refuse_all_but_task(overrides)
    game = asked(args.task, overrides) if args.task else None
    found: list[groups.Measured] = []
    directories = []
    for word in args.runs:
        if names_a_controller(word):
            if game is None:
                raise UserError(f"task: {word} needs --task, the task it is to be measured on.")
            result = evaluate(game, config.load_controller(word, game), args.episodes, starts)
            found.append(groups.of_controller(word.rpartition(":")[2], game, result, starts))
        elif Path(word).exists():
            directories.append(Path(word))
        else:
            hint = config.suggest(word, CONTROLLERS)
            raise UserError(f"run: there is no run or controller '{word}'; {hint}")
    notes = []
    for directory in expand(directories):
        run, there = subject(directory, args.task, args.algorithm, overrides)
        notes += run.warnings
        result = evaluate(there, run.controller(there), args.episodes, starts)
        found.append(groups.of_run(run, result, starts, there, args.task or ""))
        done, whole = contents.progress(run)
        if done < whole:
            notes.append(f"{directory}: training is unfinished ({done} of {whole} steps).")
        if groups.same_game(there, run.game):
            notes += keep(run, row_of(found[-1], args.confidence))
    result = {
        "start_seed": starts,
        "runs": [row_of(m, args.confidence) for m in found],
        "groups": [
            {"group": name} | groups.summary(members, args.confidence)
            for name, members in groups.grouped(found).items()
        ],
        "comparisons": groups.comparisons(found),
    }
    if len(result["groups"]) == 1:  # over several configurations there is nothing to say
        result = {k: v for k, v in result["groups"][0].items() if k != "group"} | result
    if args.out is not None:
        store.write_text_atomic(args.out, json.dumps(result, indent=1) + "\n")
    if not args.json:
        tabulate(result, found)
    for note in notes:
        say(note)
    return result, 0


def starts_of(seed: int | str) -> int:
    """The seed of the starts; a fresh one for the word draw."""
    return secrets.randbelow(2**31) if seed == "draw" else int(seed)


def row_of(measured: groups.Measured, confidence: float) -> dict[str, Any]:
    """One run's or controller's figures, with all that they depend on."""
    about = {"name": measured.name, "group": measured.base, "seed": measured.seed}
    about |= {"start_seed": measured.starts, "game": config.record(measured.game)}
    return about | measured.evaluation.summary(confidence)


def keep(run: Run, row: dict[str, Any]) -> list[str]:
    """Leave the figures in the run; where that cannot be, say so."""
    try:
        store.write_text_atomic(run.directory / "evaluation.json", json.dumps(row, indent=1) + "\n")
    except UserError as error:
        return [f"evaluation.json was not written: {error}"]
    return []


def tabulate(result: dict[str, Any], found: Sequence[groups.Measured]) -> None:
    """The evaluation as a table on standard output, and what it says in words."""
    rows, teams = result["runs"], result["groups"]
    first, asked = rows[0], {arrival(m.game) for m in found}
    reached = asked.pop() if len(asked) == 1 else "as each task defines it"
    ruled = any(has_rules(m.game) for m in found) or any(r["violations"]["successes"] for r in rows)
    title = f"{first['episodes']} held-out starts of seed {result['start_seed']}; "
    title += f"success at the last step: {reached}"
    table = Table(
        title=title,
        title_justify="left",
        box=box.SIMPLE_HEAD,
        pad_edge=False,
        padding=0,  # the box has a blank between columns; names need the room on 80 of them
    )
    table.add_column("run", overflow="fold", min_width=10)
    percent = f"{100 * first['confidence']:g} %"
    heads = ["success", percent, "rest", "stays", *["broken"] * ruled, "in .05"]
    for head in [*heads, "median", "95 %", "m/s", "rad/s", "settled"]:
        table.add_column(head, justify="right", no_wrap=True)
    by_name = {row["name"]: row for row in rows}
    for members, team in zip(groups.grouped(found).values(), teams, strict=True):
        for row in [by_name[m.name] for m in members]:
            table.add_row(*cells(row, ruled))
        if len(members) > 1:
            table.add_row(*cells(team | {"name": team["about"]}, ruled))
    console = Console()
    console = console if console.is_terminal else Console(width=max(console.width, 110))
    console.print(table)
    console.print(
        "success, rest (no agent above 0.1 m/s or 0.1 rad/s), stays (in every step until "
        f"{1 + max(m.evaluation.beyond / m.game.horizon for m in found):g} horizons)"
        + (", broken (episodes with a violation)" if ruled else "")
        + ": % of the episodes; median and 95 %: worst final distance (m); m/s and rad/s: of the "
        "fastest agent at the last step, median; settled: median time (s)\n",
        highlight=False,
    )
    for team in teams:
        console.print(f"{team['group']}: {groups.words(team)}", highlight=False, markup=False)
    for row in rows:
        if row["rests"] and row["rests"] != RESTS:
            console.print(f"{row['name']}: {row['rests']}", highlight=False, markup=False)
    for pair in result["comparisons"]:
        text = f"{pair['a']} against {pair['b']}: only the first {pair['only_a']}, "
        text += f"only the second {pair['only_b']}, McNemar p = {pair['p_value']:.2g}"
        console.print(text, highlight=False, markup=False)
    if len(result["comparisons"]) == groups.MOST_PAIRS:
        console.print(f"Only the first {groups.MOST_PAIRS} pairs are compared.", highlight=False)


def cells(row: dict[str, Any], ruled: bool) -> list[str]:
    """One line of the evaluation's table."""
    number = lambda v, digits: "-" if v is None else f"{v:.{digits}f}"
    share = lambda part: f"{100 * part['success_rate']:.1f}"
    low, high = row["interval"]
    return [
        escape(row["name"]),
        share(row),
        f"{100 * low:.1f}-{100 * high:.1f}",
        share(row["at_rest"]),
        share(row["stayed"]) if row["beyond_steps"] else "-",
        *[share(row["violations"])] * ruled,
        share(row["radii"][0]),
        number(row["final_distance"]["0.5"], 3),
        number(row["final_distance"]["0.95"], 3),
        number(row["final_speed"]["0.5"], 2),
        number(row["final_spin"]["0.5"], 2),
        number(row["settling_time"]["0.5"], 1),
    ]


def one_run(word: Path | str) -> Path:
    """The one run at this place. Raises UserError where there is none, or several."""
    found = expand([Path(word)])
    if len(found) > 1:
        raise UserError(f"run: {word} holds {len(found)} runs; name one, such as {found[0]}.")
    return found[0]


SAMPLED = ("reach", "reach-and-stay", "decrease", "contraction", "basin", "quantiles")


def certification(args: Namespace, overrides: Overrides) -> Result:
    """`certify`: the verdicts of several certificates on one controller, stored to be rechecked."""
    if not 0 < args.confidence < 1:
        raise UserError(f"confidence: {args.confidence} must lie between 0 and 1.")
    out, rollouts = args.out, args.rollouts
    if rollouts is not None:
        within("rollouts", rollouts, 1, 10_000_000)
    if names_a_controller(args.run):
        if args.task is None or out is None:
            missing = "--task TASK" if args.task is None else "--out DIRECTORY"
            raise UserError(f"certify: {args.run} is a controller, not a run; add {missing}.")
        game = asked(args.task, overrides)
        controller: Any = config.load_controller(args.run, game)
    else:
        place = one_run(args.run)
        run, game = subject(place, args.task, args.algorithm, overrides)
        controller = run.controller(game)
        for note in run.warnings:
            say(note)
        if game is not run.game and out is None:
            raise UserError(
                f"out: this certificate is not about the task that {place} was trained on; say "
                "where it goes with --out DIRECTORY."
            )
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
        several = rollouts is not None and "rollouts" in config.fields(c)
        chosen[name] = dataclasses.replace(c, rollouts=rollouts) if several else c  # pyright: ignore
    game = regulated(game)
    V = cost_sum(game, controller, stream(args.seed, "calibrate"))
    if V.ball > game.edge:
        say(
            f"V ignores errors below {V.ball:g} {V.unit}: started on the target, this controller "
            "drifts that far."
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
        tell(f"[left out] {name}: {why.removeprefix(f'{name}: ')}")
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
    game = asked(args.task, overrides)
    within("seed", args.seed, 0, 2**31 - 1)
    found = conformance(game, args.seed)
    broken = [f.law for f in found if f.faults]
    skipped = [f.law for f in found if f.faults is None]
    if not args.json:
        table = Table(title=escape(args.task), title_justify="left", show_header=False)
        for f in found:
            if f.faults is None:
                continue
            figures = ", ".join(f"{name} {value:.3g}" for name, value in f.figures.items())
            text = "\n".join(f.faults) or f.says + (f" ({figures})" if figures else "")
            table.add_row(f.law, "broken" if f.faults else "kept", escape(text))
        if skipped:
            rest = f"{len(skipped)} laws need sound shapes: {', '.join(skipped)}"
            table.add_row("", "skipped", rest)
        Console().print(table)
        print(
            f"{args.task}: {len(found) - len(broken) - len(skipped)} of {len(found)} laws kept",
            end="",
        )
        print(f", {len(skipped)} skipped" if skipped else "", end="")
        print(f"; broken: {', '.join(broken)}." if broken else ".")
    laws = {f.law: {"says": f.says, "faults": f.faults, "figures": f.figures} for f in found}
    return {"task": args.task, "passes": not broken, "laws": laws}, int(bool(broken))


def report(args: Namespace, overrides: Overrides) -> Result:
    """Write the HTML page and the pictures."""
    opened = [subject(d, args.task, args.algorithm, overrides) for d in expand(args.runs)]
    runs, games = [run for run, _ in opened], [game for _, game in opened]
    default = runs[0].directory / "report.html" if len(runs) == 1 else Path("report.html")
    out = args.out or default
    if out.exists() and not is_report(out):
        raise UserError(f"out: {out} exists and is not a report of marlyap; choose another file.")
    command = shlex.join(["marlyap", *sys.argv[1:]])
    page = contents.gather(
        runs, args.episodes, starts_of(args.seed), command, games, args.task or ""
    )
    from marlyap.report import png  # late, as it loads Matplotlib
    from marlyap.report.page import html

    store.write_text_atomic(out, html(page))
    pictures = [out.with_name(f"{out.stem}-{name}") for name in ("starts.png", "learning.png")]
    png.trajectories_png(page.films, pictures[0])
    png.learning_curves_png(page.runs, pictures[1])
    say(f"Report: {out.resolve()}")
    for note in page.notes:
        say(note)
    result: dict[str, Any] = {
        "start_seed": page.starts,
        "groups": [dataclasses.asdict(g) for g in page.groups],
    }
    if len(page.groups) == 1:
        result = {k: v for k, v in result["groups"][0].items() if k != "text"} | result
    return result | {"report": str(out), "pictures": [str(p) for p in pictures]}, 0


def is_report(path: Path) -> bool:
    """Whether a file was written by `report`, and may be replaced by it."""
    try:
        with path.open("rb") as file:
            return MARK.encode() in file.read(10_000_000)
    except OSError as error:
        raise UserError(f"out: {path} cannot be read ({error.strerror}).") from None


def watch(args: Namespace, overrides: Overrides) -> Result:
    """Film one episode."""
    run, game = subject(one_run(args.run), args.task, args.algorithm, overrides)
    place = args.out or run.directory
    if not place.is_dir():
        raise UserError(f"out: there is no directory {place}.")
    starts = starts_of(args.seed)
    shot = episodes.one(run, args.episode, starts, game=game)
    from marlyap.report.gif import film_gif  # late, as it loads Matplotlib
    from marlyap.report.page import html

    gif, page = place / "film.gif", place / "film.html"
    film_gif(shot, gif)
    title = f"One episode of {run.title}"
    about = f"start {args.episode} of the held-out starts of seed {starts}"
    if game is not run.game:
        about += f", on {groups.told(run.game, game, args.task or '')}"
    store.write_text_atomic(page, html(Page(title=title, subtitle=about, films=(shot,))))
    say(f"Film: {page.resolve()} and {gif.resolve()}")
    done = {"gif": str(gif), "html": str(page), "start_seed": starts}
    return done | {"success": bool(shot.success)}, 0


def listing(args: Namespace, overrides: Overrides) -> Result:
    """What there is, or the fields of one of them."""
    if overrides:
        raise UserError(f"--{next(iter(overrides))}: list shows what there is; leave it out.")
    if args.name:
        return fields_of(args.name, args.json), 0
    families: dict[str, dict[str, Any]] = {
        "tasks": TASKS,
        "algorithms": ALGORITHMS,
        "controllers": CONTROLLERS,
        "certificates": CERTIFICATES,
    }
    result = {
        title: {name: summary(thing) for name, thing in family.items()}
        for title, family in families.items()
    }
    result["presets"] = dict(PRESET_NOTES)
    if not args.json:
        console = Console()
        for title, members in result.items():
            table = Table(
                title=title, title_justify="left", show_header=False, box=None, padding=(0, 2)
            )
            for name, text in members.items():
                table.add_row(f"[bold]{escape(name)}[/]", escape(text))
            console.print(table, "")
        console.print("`marlyap list NAME` shows the fields of each, and `marlyap list schedule`.")
    return result, 0


PRESET_NOTES = {
    "tuned": "what learns best here; every algorithm and schedule as listed",
    "paper": "section 4 of the paper: plain networks, one environment, 100,000 steps",
}


def summary(thing: Any) -> str:
    """The first line of its documentation."""
    cls = thing if isinstance(thing, type) else type(thing)
    line = (cls.__doc__ or "").strip().splitlines()[0]
    if isinstance(thing, AbstractGame):
        n, who = thing.agents, len(thing.informed)
        limits = " and ".join(f"{u:g}" for u in thing.plant.limits)
        leaders = f", {who} leader{'s' * (who > 1)}" if who < n else ""
        line += f" ({n} agents{leaders}, {thing.graph} graph, limits {limits})"
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
    """Every field of what `list` names, or of path/to/file.py:Name, with value and meaning."""
    rows = rows_of(name)
    table = Table(title=escape(name), title_justify="left", title_style="bold")
    table.add_column("option", overflow="fold", min_width=max(len(row[0]) for row in rows))
    table.add_column("value", overflow="fold")
    table.add_column("meaning", overflow="fold")
    for row in rows:
        table.add_row(*map(escape, row))
    found: dict[str, Any] = {
        option: {"value": value, "meaning": note} for option, value, note in rows
    }
    if not quiet:
        Console().print(table)
    if (game := game_called(name)) is not None:
        entries = game.entries()
        found["entries"] = {k: [e._asdict() for e in of_kind] for k, of_kind in entries.items()}
        if not quiet:
            show_entries(entries)
    return found


def show_entries(entries: Mapping[str, Sequence[Entry]]) -> None:
    """What every number of an observation, a state and an action is."""
    for kind, of_kind in entries.items():
        table = Table(title=f"one agent's {kind}", title_justify="left", title_style="bold")
        for head in ("#", "entry", "unit", "frame"):
            table.add_column(head, overflow="fold")
        for k, entry in enumerate(of_kind):
            table.add_row(str(k), escape(entry.name), entry.unit, entry.frame)
        if of_kind:
            Console().print(table)


def rows_of(name: str) -> list[tuple[str, str, str]]:
    """(option or field, value, meaning) of whatever has this name."""
    dotted = lambda obj, part: [(f"--{o}", v, m) for o, v, m in config.describe(obj, part)]
    for table, family in ((TASKS, AbstractGame), (ALGORITHMS, AbstractAlgorithm)):
        if name in table:
            return dotted(table[name], config.WORDS[family])
    if name in ("schedule", *PRESETS):
        return dotted(SCHEDULES["tuned" if name == "schedule" else name], "schedule")
    if name in CONTROLLERS:
        return config.describe_class(CONTROLLERS[name]) or [("(no gains)", "", "")]
    if name in CERTIFICATES:
        return [(o.lstrip("."), v, m) for o, v, m in config.describe(CERTIFICATES[name], "")]
    if ":" not in name and not name.endswith(".py"):
        there = [*TASKS, *ALGORITHMS, *CONTROLLERS, *CERTIFICATES, *PRESETS, "schedule"]
        raise UserError(f"name: nothing is called '{name}'; {config.suggest(name, there)}")
    game = game_called(name)
    if game is not None:
        return dotted(game, "task")
    return dotted(config.load(name, AbstractAlgorithm), "algorithm")


def game_called(name: str) -> AbstractGame | None:
    """The task of this name, or in path/to/file.py:Name; None where that is no task."""
    if name in TASKS or ":" not in name:
        return TASKS.get(name)
    with suppress(config.NotOfThatKind):
        return config.load(name, AbstractGame)
    return None


def demo(args: Namespace, overrides: Overrides) -> Result:
    """Train, evaluate and report the main task; what is trained already is kept."""
    start = time.monotonic()
    names = [args.out / f"seed{s}" for s in seeds(args.seeds)]
    for place in names:
        Run.outside(place)
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
        say(f"{args.out} holds these runs, which are used again; to train anew: demo --again")
    else:
        runs = create(job, overrides)
    code = trained([r for r in runs if not r.finished], job, new=not there or args.again)
    if code:
        return None, code
    out = args.out / "report.html"
    result, _ = report(
        Namespace(runs=names, out=out, episodes=500, seed=0, task=None, algorithm=None), {}
    )
    assert result is not None
    rests = f"; the team {result['rests']}" if result["rests"] else ""
    text = f"{result['successes']} of {result['episodes']} held-out starts of seed 0 succeeded: "
    text += f"{groups.words(result)}{rests}. It took {time.monotonic() - start:.0f} s."
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
