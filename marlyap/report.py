"""One self-contained HTML page that says how good a team is and shows it moving.

`html` is a pure function from plain data to text: no JAX, no network, no files but its own
template, `report_page.html`, which holds the style and the film player. Everything that a user may
have written is escaped, the page's security policy allows only the template's own script, and what
is missing or not a number is shown as a dash.

The data is described by the typed dictionaries below. Only `title` is required, and `positions` of
a film; every other key may be absent, and numbers may be Python's, NumPy's, NaN or None.
"""

from __future__ import annotations

import base64
import hashlib
import json
import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from html import escape
from importlib.resources import files
from typing import Any, Literal, NotRequired, Required, TypedDict

import numpy as np


# -------------------------------------------------------------------------------------------------
# The data
# -------------------------------------------------------------------------------------------------


class Within(TypedDict, total=False):
    """Success at one radius."""

    radius: float  # m
    successes: int
    success_rate: float
    interval: Sequence[float]


# One line of the training log: environment steps so far, success rate, mean return of an episode.
# Other keys are ignored.
LogRow = TypedDict("LogRow", {"steps": int, "success": float, "return": float}, total=False)


class Share(TypedDict, total=False):
    """A share of the episodes."""

    success_rate: float
    interval: Sequence[float]


class Figures(TypedDict, total=False):
    """What an evaluation found, of one policy or over the training seeds of a group."""

    label: str
    episodes: int
    successes: int
    success_rate: float
    interval: Sequence[float]  # 95 %, low and high
    radius: float  # m, of success
    radii: Sequence[Within]
    at_rest: Share
    stayed: Share
    beyond_steps: int  # steps after the last over which `stayed` looks
    violations: Share
    final_distance: Mapping[str, float]  # m, by quantile: "0.5", "0.95", "1.0"
    final_speed: Mapping[str, float]  # m/s, of the fastest agent
    final_spin: Mapping[str, float]  # rad/s
    settling_time: Mapping[str, float]  # s, by quantile
    return_mean: float  # of an episode
    rests: str  # what a team does once it has arrived, in words


class Group(Figures, total=False):
    """Runs that differ in their training seed alone: what is said at the top of the page."""

    seeds: Sequence[int | None]
    about: str  # whether the interval is about one policy or a mean over training seeds
    text: str  # one plain sentence: what is certified and what is not


class Run(Figures, total=False):
    """One trained run (one seed) and its evaluation."""

    name: str
    group: str  # label of the group that it belongs to
    seed: int
    log: Sequence[LogRow]


class Film(TypedDict, total=False):
    """One episode. All lists over time have the same length, the first entry being the start."""

    positions: Required[Any]  # [time][agent][2], m
    label: str  # "best", "median", "worst", ...
    start: int  # number of the start among those evaluated
    run: str
    dt: float  # s
    radius: float  # m
    target: Any  # [x, y], or one per agent, or None
    headings: Any  # [time][agent], rad, or None for point masses
    leaders: Sequence[bool]
    edges: Any  # [[i, j], ...] when constant, else [time][[i, j], ...]
    distance: Any  # [time], m: of the worst agent; computed from the target when absent
    lyapunov: Any  # [time] or None
    function: str  # what `lyapunov` is of: L (default), or the V of a certificate
    cost: Any  # [time]; shown where there is no lyapunov
    success: bool


class Comparison(TypedDict, total=False):
    """Two runs on the same starts: McNemar's test on the starts that only one of them mastered."""

    a: str
    b: str
    only_a: int
    only_b: int
    p_value: float
    text: str


class Certificate(TypedDict, total=False):
    """One claim, and what stands behind it."""

    name: str
    claim: str  # in words
    evidence: str  # proved, statistical or observed
    run: str  # whose it is
    holds: bool
    asked: float  # share of the starts that had to be shown
    shown: str  # the bound in words
    bound: float | str
    confidence: float | str
    scope: str  # start distribution, horizon, disturbance
    text: str


class Contour(TypedDict, total=False):
    """One level set in a slice."""

    level: float
    lines: Sequence[Any]  # each [[x, y], ...], m
    certified: bool  # whether it is the level that was certified


class Slice(TypedDict, total=False):
    """V over the places of one agent relative to its goal, the others resting on theirs."""

    label: str
    reach: float  # m, half the side of the square that is shown
    radius: float  # m, of success
    headings: bool  # whether the agents have a heading
    run: str  # whose it is
    contours: Sequence[Contour]


class Training(TypedDict, total=False):
    """How one run was made."""

    name: str
    command: str
    made: str  # date
    seed: int
    seconds: float
    policy: str  # the first digits of its hash
    versions: Mapping[str, str]


class Difference(TypedDict, total=False):
    """What tells one configuration from the others."""

    name: str
    fields: str


class Page(TypedDict):
    """All that a report shows."""

    title: str
    subtitle: NotRequired[str]  # task and algorithm in words
    generated: NotRequired[str]  # date
    starts: NotRequired[int]  # seed of the starts
    groups: NotRequired[Sequence[Group]]
    runs: NotRequired[Sequence[Run]]
    films: NotRequired[Sequence[Film]]
    comparisons: NotRequired[Sequence[Comparison]]
    certificates: NotRequired[Sequence[Certificate]]
    slices: NotRequired[Sequence[Slice]]
    notes: NotRequired[Sequence[str]]  # what is missing, and why
    config: NotRequired[Mapping[str, Any]]  # that all runs have in common
    changed: NotRequired[Sequence[str]]  # its fields that are not the default, by dotted name
    differing: NotRequired[Sequence[Difference]]
    training: NotRequired[Sequence[Training]]
    versions: NotRequired[Mapping[str, str]]  # of what made the report
    command: NotRequired[str]  # that made the report


# -------------------------------------------------------------------------------------------------
# The page
# -------------------------------------------------------------------------------------------------

# The colours of Okabe and Ito, one per agent or run; one is kept for what should not happen.
PALETTE = ("#0072b2", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#7a7d85")
ALARM = "#d55e00"
DASH = "–"
MARK = '<p class="kicker">marlyap report'  # by which a report is known


def html(page: Page) -> str:
    """The whole report as the text of one HTML file."""
    template = files("marlyap").joinpath("report_page.html").read_text(encoding="utf-8")
    script = re.search(r"<script>(.*?)</script>", template, re.DOTALL)
    assert script is not None, "report_page.html holds one script"
    shown = scenes(page.get("films") or ())
    parts = {
        "policy": _policy(script[1]),
        "title": _text(page["title"]),
        "header": _header(page),
        "player": _episodes(shown),
        "runs": _runs(page),
        "curves": _curves(page.get("runs") or ()),
        "starts": _starts(shown),
        "comparisons": _comparisons(page.get("comparisons") or ()),
        "certificates": _certificates(page.get("certificates") or (), page.get("slices") or ()),
        "making": _making(page),
        "films": _json([_film(scene) for scene in shown]),
    }
    return re.sub(r"<!--#(\w+)-->", lambda mark: parts[mark[1]], template)


def _policy(script: str) -> str:
    """A content security policy: nothing from anywhere, and no script but this one."""
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    nothing = "default-src 'none'; base-uri 'none'; form-action 'none'"
    return f"{nothing}; style-src 'unsafe-inline'; script-src 'sha256-{digest}'"


def _header(page: Page) -> str:
    kicker = f"marlyap report · {_text(page.get('generated'))}".removesuffix(f" · {DASH}")
    head = _tag("p", kicker, cls="kicker") + _tag("h1", _text(page["title"]))
    if page.get("subtitle"):
        head += _tag("p", _text(page.get("subtitle")), cls="lede")
    groups, starts = page.get("groups") or (), page.get("starts")
    if len(groups) == 1:
        head += _verdict(groups[0], starts)
    elif groups:
        head += _tag("div", "".join(_one_of_several(group) for group in groups), cls="verdicts")
    texts = dict.fromkeys(text for group in groups if (text := group.get("text")))
    head += "".join(_tag("p", _text(text), cls="caveat") for text in texts)
    return head + "".join(_tag("p", _text(n), cls="caveat warn") for n in page.get("notes") or ())


def _verdict(group: Group, starts: Any) -> str:
    """The large figure of a report about one configuration, and what it stands on."""
    rate = _number(group.get("success_rate"))
    if rate is None:
        return ""
    count = _tag("strong", _integer(group.get("successes")))
    facts = [f"{count} of {_integer(group.get('episodes'))} episodes succeeded"]
    if (radius := _number(group.get("radius"))) is not None:
        facts.append(f"success within {radius:g} m at the last step")
    if starts is not None:
        facts.append(f"held-out starts of seed {_text(starts)}")
    side = _tag("p", "; ".join(facts)) + _gauge(rate, group.get("interval"))
    side += _tag("p", _about(group)) + _tag("p", _afterwards(group))
    return _tag("div", _tag("p", _percent(rate), cls="figure") + _tag("div", side), cls="verdict")


def _one_of_several(group: Group) -> str:
    """A line about one configuration among others."""
    rate = _number(group.get("success_rate"))
    if rate is None:
        return ""
    head = _tag("h3", _text(group.get("label"))) + _tag("p", _percent(rate), cls="figure")
    side = _gauge(rate, group.get("interval")) + _tag("p", _about(group))
    return _tag("article", head + side + _tag("p", _afterwards(group)))


def _about(group: Group) -> str:
    """What the interval is, and what it is about."""
    interval, about = _interval(group.get("interval")), _text(group.get("about"), "this policy")
    if about == "this policy":
        return f"exact 95 % interval {interval} of {about}"
    return f"{about}; 95 % interval {interval} for the expectation over training seeds"


def _afterwards(group: Group) -> str:
    """What the team does once it has arrived."""
    share = lambda part: _percent((part or {}).get("success_rate"))
    parts = [f"at rest at the last step: {share(group.get('at_rest'))}"] * ("at_rest" in group)
    if group.get("beyond_steps"):
        more = _integer(group.get("beyond_steps"))
        parts.append(f"stays for {more} steps more: {share(group.get('stayed'))}")
    words = _text(group.get("rests"), "")
    return "; ".join([_tag("b", words)] * bool(words) + parts)


def _gauge(rate: float, interval: Any) -> str:
    """A line from 0 to 100 % with the interval as a bar and the rate as a tick."""
    low, high = _pair(interval) or (rate, rate)
    width = 300 * max(high - low, 0.004)
    marks = (
        _tag("line", cls="axis", x1=0, x2=300, y1=7, y2=7)
        + _tag("rect", cls="band", x=300 * low, y=3, width=width, height=8, rx=1.5)
        + _tag("line", cls="tick", x1=300 * rate, x2=300 * rate, y1=0, y2=14)
        + _tag("text", "0", x=0, y=26)
        + _tag("text", "100 %", x=300, y=26, text_anchor="end")
    )
    return _svg(300, 28, marks, "success rate and interval from 0 to 100 %", "gauge")


# -------------------------------------------------------------------------------------------------
# Tables
# -------------------------------------------------------------------------------------------------


def _runs(page: Page) -> str:
    runs, groups = page.get("runs") or (), page.get("groups") or ()
    if not runs:
        return ""
    radii = sorted({radius for run in runs for radius, *_ in _within(run)})[:1]
    ruled = any(_number((run.get("violations") or {}).get("success_rate")) for run in runs)
    head = ["Run", "Success", "95 % interval", "At rest", "Stays", *["Violations"] * ruled]
    head += [*[f"within {radius:g} m" for radius in radii], "Final distance (m)", "speed (m/s)"]
    head += ["spin (rad/s)", "Settling time (s)", "Return"]
    body = [_run_row(run, radii, ruled, c) for run, c in zip(runs, _colours(runs), strict=True)]
    body += [_run_row(g, radii, ruled) for g in groups if len(g.get("seeds") or ()) > 1]
    more = next((n for run in runs if (n := _number(run.get("beyond_steps")))), None)
    note = (
        "Each run was evaluated on the same held-out starts with its deterministic policy. At "
        "rest: no agent faster than 0.1 m/s or 0.1 rad/s at the last step. "
        + (f"Stays: succeeds in every one of {more:,.0f} steps more. " if more else "")
        + "Distance, speed and spin are those of the worst agent at the last step. Two figures in "
        "a cell: the median, and what 95 % of the episodes stay under."
    )
    return _section("Runs", _table(head, body), note)


def _run_row(
    run: Run | Group, radii: Sequence[float], ruled: bool, colour: int | None = None
) -> str:
    """One run with its colour, or a group of several seeds without."""
    mark = "" if colour is None else _tag("i", cls=f"swatch c{colour}")
    rate = _tag("b", _percent(run.get("success_rate")))
    cells = [f"{_integer(run.get('successes'))} / {_integer(run.get('episodes'))} {rate}"]
    cells.append(_interval(run.get("interval")))
    shares = [run.get("at_rest"), run.get("stayed") if run.get("beyond_steps") else None]
    shares += [run.get("violations")] * ruled
    cells += [_percent((share or {}).get("success_rate")) for share in shares]
    within = {radius: rate for radius, rate, *_ in _within(run)}
    cells += [_percent(within.get(radius)) for radius in radii]
    columns = [(run.get("final_distance"), 3), (run.get("final_speed"), 2)]
    for quantiles, digits in (*columns, (run.get("final_spin"), 2), (run.get("settling_time"), 1)):
        both = [_decimal(_quantile(quantiles, q), digits) for q in (0.5, 0.95)]
        cells.append(" / ".join(both) if quantiles else DASH)
    cells.append(_decimal(run.get("return_mean"), 2))
    about = f": {run['about']}" if "about" in run else ""
    return _row(mark + _text(_name(run) + about), cells, "pooled" if colour is None else "")


def _within(run: Figures) -> list[tuple[float, float, float, float]]:
    """What is known of success by radius: radius, rate, and the ends of the interval."""
    known = []
    for within in run.get("radii") or ():
        radius, rate = _number(within.get("radius")), _number(within.get("success_rate"))
        if radius is not None and rate is not None:
            known.append((radius, rate, *(_pair(within.get("interval")) or (rate, rate))))
    return sorted(known)


def _name(run: Any) -> str:
    return run.get("label") or run.get("name") or DASH


def _comparisons(comparisons: Sequence[Comparison]) -> str:
    if not comparisons:
        return ""
    head = ["First", "Second", "Only the first succeeded", "Only the second", "p (McNemar)", ""]
    body = []
    for c in comparisons:
        cells = [_text(c.get("b")), _integer(c.get("only_a")), _integer(c.get("only_b"))]
        cells += [_p_value(c.get("p_value")), _text(c.get("text"), "")]
        body.append(_row(_text(c.get("a")), cells))
    note = (
        "The same starts for both. McNemar's test asks whether the starts that only one of them "
        "mastered fall evenly on both sides."
    )
    return _section("Compared", _table(head, body, words=(0, 1, 5)), note)


def _certificates(certificates: Sequence[Certificate], slices: Sequence[Slice]) -> str:
    """Each claim with its evidence and reach, then the level sets of V."""
    if not certificates:
        return ""
    claims = "".join(_claim(c) for c in certificates)
    note = (
        "Each claim is about this policy, from starts of the kind stated and no others. "
        "<b>Statistical</b>: shown on fresh starts, at the confidence stated. <b>Proved</b>: for "
        "every state stated. <b>Observed</b>: seen, and no more. The worst case found for each is "
        "among the films above."
    )
    figures = "".join(
        _captioned(_slice(part), f"{_tag('b', 'V')} along {_of(part.get('label'), part)}")
        for part in slices
    )
    charts = _tag("div", figures, cls="charts slices") if figures else ""
    if figures:
        facing = ", facing right," if any(part.get("headings") for part in slices) else ""
        dashed = any(c.get("certified") for part in slices for c in part.get("contours") or ())
        words = (
            f"Level sets of V where one agent rests beside its goal{facing} and all others rest on "
            "theirs. The ring is the target"
            + ("; the dashed line is the level that was certified." if dashed else ".")
        )
        charts = _tag("p", words, cls="note") + charts
    return _section("Certificates", _tag("div", claims, cls="claims") + charts, note)


def _of(text: Any, part: Mapping[str, Any]) -> str:
    """Something, and whose it is where that is said."""
    return _text(text) + (f" · {_text(part.get('run'))}" if part.get("run") else "")


def _claim(c: Certificate) -> str:
    """One claim: what was asked, what was shown, and whether that is enough."""
    holds, asked, shown = c.get("holds"), _number(c.get("asked")), _number(c.get("bound"))
    share = asked is not None and shown is not None and holds == (shown >= asked)
    words = {
        True: "reached" if share else "holds",
        False: "not reached" if share else "does not hold",
    }
    kind = "holds" if holds else "fails"
    verdict = "" if holds is None else _tag("span", words[holds], cls=f"mark {kind}")
    head = _tag("h3", _of(c.get("name") or "claim", c) + verdict)
    facts: dict[str, Any] = {"evidence": c.get("evidence")}
    if share:
        facts |= {"asked": _percent(asked), "shown": c.get("shown", _percent(shown))}
    else:
        facts |= {"bound": c.get("bound")}
    facts |= {key: c.get(key) for key in ("confidence", "scope", "text")}
    pairs = "".join(
        _tag("div", _tag("dt", key) + _tag("dd", _any(value)))
        for key, value in facts.items()
        if value is not None
    )
    return _tag("article", head + _tag("p", _text(c.get("claim"))) + _tag("dl", pairs))


def _slice(part: Slice) -> str:
    """Contours in a square of 300 units."""
    reach = _number(part.get("reach")) or 1.0
    scale, body = 150 / reach, ""
    for value in ticks(-reach, reach):
        body += _grid_line(150 + value * scale, value, upright=True)
        body += _grid_line(150 - value * scale, value, upright=False)
    for contour in part.get("contours") or ():
        kind = "contour certified" if contour.get("certified") else "contour"
        for line in contour.get("lines") or ():
            place = _array(line).reshape(-1, 2) * (scale, -scale) + 150
            body += _tag("polyline", cls=kind, points=_points(*place.T))
        body += _level(contour, scale)
    radius = (_number(part.get("radius")) or 0.0) * scale
    body += _tag("circle", cls="target", cx=150, cy=150, r=max(radius, 2.5))
    return _svg(300, 300, body, f"level sets of V, {part.get('label') or ''}", "square")


def _level(contour: Contour, scale: float) -> str:
    """The value of a contour, written at its highest point if that is inside the picture."""
    points = [point for line in contour.get("lines") or () for point in line]
    level = _number(contour.get("level"))
    if not points or level is None:
        return ""
    x, y = max(points, key=lambda point: point[1])
    place = 150 + x * scale, 150 - y * scale
    if place[1] < 12:
        return ""
    return _tag("text", f"{level:.3g}", x=place[0], y=place[1] - 3, text_anchor="middle")


def _making(page: Page) -> str:
    body = _trainings(page.get("training") or ())
    if differing := page.get("differing"):
        rows = [_row(_text(d.get("name")), [_text(d.get("fields"))]) for d in differing]
        body += _tag("h3", "What differs") + _table(["Configuration", "Fields"], rows, (0, 1))
    changed = set(page.get("changed") or ())
    config = [(path, _any(value)) for path, value in _flatten(page.get("config") or {})]
    marked = [(_tag("b", _text(k)) if k in changed else _text(k), v) for k, v in config]
    bold = " (bold: not the default)" if any(k in changed for k, _ in config) else ""
    body += _pairs(("Configuration in common" if differing else "Configuration") + bold, marked)
    if command := page.get("command"):
        body += _tag("h3", "This report") + _tag("pre", _text(command), cls="command")
    versions = [(_text(k), _any(v)) for k, v in (page.get("versions") or {}).items()]
    body += _pairs("Versions that made this report", versions)
    return _section("How it was made", body) if body else ""


def _pairs(title: str, pairs: Sequence[tuple[str, str]]) -> str:
    rows = [_tag("div", _tag("dt", k) + _tag("dd", v)) for k, v in pairs]
    return _tag("h3", title) + _tag("dl", "".join(rows), cls="pairs") if rows else ""


def _trainings(trainings: Sequence[Training]) -> str:
    """When, how long and with what each run was trained, and by which command."""
    if not trainings:
        return ""
    head = ["Run", "Seed", "Made", "Wall time", "Policy", "With"]
    body = []
    for t in trainings:
        versions = ", ".join(f"{k} {v}" for k, v in (t.get("versions") or {}).items())
        cells = [_integer(t.get("seed")), _text(t.get("made") or None), _duration(t.get("seconds"))]
        body.append(_row(_text(t.get("name")), [*cells, _text(t.get("policy")), _text(versions)]))
    commands = dict.fromkeys(command for t in trainings if (command := t.get("command")))
    said = "".join(_tag("pre", _text(command), cls="command") for command in commands)
    return _tag("h3", "Training") + said + _table(head, body, words=(0, 5))


def _flatten(tree: Mapping[str, Any], prefix: str = "") -> Iterable[tuple[str, Any]]:
    """The leaves of a nested dictionary with their dotted paths."""
    for key, value in tree.items():
        if isinstance(value, Mapping) and value:
            yield from _flatten(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", value


def _section(title: str, body: str, note: str = "") -> str:
    note = _tag("p", note, cls="note") if note else ""
    return _tag("section", _tag("h2", title) + note + body)


def _table(head: Sequence[str], rows: Sequence[str], words: Sequence[int] = (0,)) -> str:
    """A table that scrolls sideways on a narrow screen; `words` are the columns set flush left."""
    names = [
        _tag("th", name, cls="word" if k in words else None, scope="col")
        for k, name in enumerate(head)
    ]
    body = _tag("thead", _tag("tr", "".join(names))) + _tag("tbody", "".join(rows))
    table = _tag("table", body, cls=" ".join(f"w{k}" for k in words))
    return _tag("div", table, cls="scroll", tabindex=0, role="region", aria_label="table")


def _row(head: str, cells: Sequence[str], kind: str = "") -> str:
    body = "".join(_tag("td", cell) for cell in cells)
    return _tag("tr", _tag("th", head, scope="row") + body, cls=kind or None)


# -------------------------------------------------------------------------------------------------
# Curves
# -------------------------------------------------------------------------------------------------

Curve = tuple[np.ndarray, np.ndarray]


def _curves(runs: Sequence[Run]) -> str:
    learning = [_learning_chart(runs, "success"), _learning_chart(runs, "return")]
    charts = [
        _captioned(chart, caption) for caption, chart in (_radius_chart(runs), *learning) if chart
    ]
    if not charts:
        return ""
    return _section("Curves", _tag("div", "".join(charts), cls="charts") + _legend(runs))


def _captioned(picture: str, caption: str) -> str:
    return _tag("figure", picture + _tag("figcaption", caption))


def _legend(runs: Sequence[Run]) -> str:
    groups = _groups(runs)
    names = groups if len(groups) > 1 else [_name(run) for run in runs]
    marks = [_tag("i", cls=f"swatch c{k % len(PALETTE)}") for k in range(len(names))]
    items = [_tag("li", mark + _text(name)) for mark, name in zip(marks, names, strict=True)]
    return _tag("ul", "".join(items), cls="legend")


def _groups(runs: Sequence[Run]) -> list[str]:
    """The configurations, in order of appearance."""
    return list(dict.fromkeys(_group(run) for run in runs))


def _group(run: Run) -> str:
    return run.get("group") or ""


def _colours(runs: Sequence[Run]) -> list[int]:
    """One colour per configuration when there are several, else one per run."""
    groups = _groups(runs)
    if len(groups) > 1:
        return [groups.index(_group(run)) % len(PALETTE) for run in runs]
    return [k % len(PALETTE) for k in range(len(runs))]


def learning_curve(run: Run, key: Literal["success", "return"]) -> Curve:
    """What the log of a run says of `key` against environment steps, without the gaps."""
    points = [(_number(row.get("steps")), _number(row.get(key))) for row in run.get("log") or ()]
    known = np.array([point for point in points if None not in point], dtype=float).reshape(-1, 2)
    return known[:, 0], known[:, 1]


def mean_curve(curves: Sequence[Curve]) -> Curve:
    """The mean over several curves where all of them reach, on the steps of the first."""
    curves = [curve for curve in curves if len(curve[0])]
    if not curves:
        return np.zeros(0), np.zeros(0)
    low, high = max(x[0] for x, _ in curves), min(x[-1] for x, _ in curves)
    grid = curves[0][0][(curves[0][0] >= low) & (curves[0][0] <= high)]
    return grid, np.mean([np.interp(grid, x, y) for x, y in curves], axis=0)


def _learning_chart(runs: Sequence[Run], key: Literal["success", "return"]) -> tuple[str, str]:
    """Caption and picture: thin a line per run, thick the mean of each configuration."""
    scale = 100 if key == "success" else 1
    curves = [(x, scale * y) for x, y in (learning_curve(run, key) for run in runs)]
    if not any(len(x) for x, _ in curves):
        return "", ""
    x_all, y_all = (np.concatenate(values) for values in zip(*curves, strict=True))
    span = (0.0, 100.0) if key == "success" else (float(y_all.min()), float(y_all.max()))
    axes = Axes((0.0, float(x_all.max())), span, "environment steps")
    groups = _groups(runs)
    kinds = [f"thin c{colour}" for colour in _colours(runs)]
    marks = [axes.line(*curve, kind) for curve, kind in zip(curves, kinds, strict=True)]
    for k, group in enumerate(groups):
        own = [c for run, c in zip(runs, curves, strict=True) if _group(run) == group]
        if len(own) > 1:
            colour = f" c{k % len(PALETTE)}" if len(groups) > 1 else ""
            marks.append(axes.line(*mean_curve(own), f"mean{colour}"))
    title = {"success": "Success during training (%)", "return": "Return of an episode"}[key]
    unit = "" if key == "success" else " (sum of rewards)"
    seeds = ", one thin line per run, thick the mean" if len(runs) > 1 else ""
    return title + unit + seeds, axes.svg(marks, title)


def _radius_chart(runs: Sequence[Run]) -> tuple[str, str]:
    """Caption and picture: success against how near is near enough."""
    known = [_within(run) for run in runs]
    if not any(known):
        return "", ""
    axes = Axes((0.0, max(row[-1][0] for row in known if row)), (0.0, 100.0), "radius (m)")
    bands, lines = [], []
    for rows, colour in zip(known, _colours(runs), strict=True):
        if rows:
            radius, rate, low, high = np.array(rows).T * [[1], [100], [100], [100]]
            bands.append(axes.band(radius, low, high, f"c{colour}"))
            lines.append(axes.line(radius, rate, f"thin c{colour}"))
            lines.append(axes.dots(radius, rate, f"c{colour}"))
    caption = "Success (%) against the radius asked (m), bands of 95 %"
    return caption, axes.svg(bands + lines, caption)


@dataclass(frozen=True)
class Axes:
    """A frame of 360 by 240 units with marks in the coordinates of the data."""

    x_span: tuple[float, float]
    y_span: tuple[float, float]
    x_label: str
    left, right, top, bottom = 46.0, 350.0, 10.0, 200.0

    def x(self, value: Any) -> Any:
        low, high = self.x_span
        return self.left + (value - low) / ((high - low) or 1.0) * (self.right - self.left)

    def y(self, value: Any) -> Any:
        low, high = self.y_span
        return self.bottom - (value - low) / ((high - low) or 1.0) * (self.bottom - self.top)

    def line(self, x: np.ndarray, y: np.ndarray, kind: str) -> str:
        return _tag("polyline", cls=kind, points=_points(self.x(x), self.y(y))) if len(x) else ""

    def band(self, x: np.ndarray, low: np.ndarray, high: np.ndarray, kind: str) -> str:
        x, y = np.concatenate([x, x[::-1]]), np.concatenate([high, low[::-1]])
        return _tag("polygon", cls=f"band {kind}", points=_points(self.x(x), self.y(y)))

    def dots(self, x: np.ndarray, y: np.ndarray, kind: str) -> str:
        return "".join(
            _tag("circle", _tag("title", f"{q:.3g} % within {p:g} m"), cls=kind, cx=a, cy=b, r=2.5)
            for a, b, p, q in zip(self.x(x), self.y(y), x, y, strict=True)
        )

    def svg(self, marks: Sequence[str], title: str) -> str:
        left, right, bottom = self.left, self.right, self.bottom
        frame = _tag("line", cls="axis", x1=left, x2=right, y1=bottom, y2=bottom)
        for value in ticks(*self.y_span):
            y = self.y(value)
            frame += _tag("line", cls="grid", x1=left, x2=right, y1=y, y2=y)
            frame += _tag("text", _short(value), x=left - 6, y=y + 4, text_anchor="end")
        for value in ticks(*self.x_span):
            x = self.x(value)
            frame += _tag("line", cls="axis", x1=x, x2=x, y1=bottom, y2=bottom + 4)
            frame += _tag("text", _short(value), x=x, y=bottom + 17, text_anchor="middle")
        middle = (left + right) / 2
        frame += _tag("text", self.x_label, x=middle, y=bottom + 35, text_anchor="middle")
        return _svg(360, 240, frame + "".join(marks), title)


def ticks(low: float | int, high: float | int, about: int = 5) -> list[float]:
    """Round numbers from `low` to `high`, roughly `about` of them."""
    if not high > low:
        return [float(low)]
    rough = (high - low) / about
    power = 10.0 ** math.floor(math.log10(rough))
    step = power * next(m for m in (1, 2, 5, 10) if m * power >= rough * 0.8)
    return [
        k * step for k in range(math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9) + 1)
    ]


def _points(x: np.ndarray, y: np.ndarray, most: int = 240) -> str:
    keep = np.unique(np.linspace(0, len(x) - 1, min(len(x), most)).astype(int))
    return " ".join(f"{x[k]:.1f},{y[k]:.1f}" for k in keep)


# -------------------------------------------------------------------------------------------------
# Films
# -------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Scene:
    """A film made regular, for the player, the small multiples and `marlyap.draw`."""

    label: str
    start: str
    run: str
    dt: float
    radius: float
    targets: np.ndarray  # [0, 1 or agents][2]
    positions: np.ndarray  # [time][agent][2]
    headings: np.ndarray | None  # [time][agent]
    leaders: list[bool]
    edges: list[list[tuple[int, int]]]  # of length 1 when constant, else [time]
    distance: np.ndarray  # [time]
    level: np.ndarray | None  # [time]: L, or the cost
    level_name: str
    rises: bool  # whether it should fall, and its rises are marked
    success: bool | None
    view: tuple[float, float, float]  # centre and side of the square to show

    @property
    def detail(self) -> str:
        """Where it ended and where it came from, in a few words."""
        last = f"ends {_decimal(self.distance[-1], 3, 'm')} away"
        return " · ".join([last, *([f"start {self.start}"] if self.start else [])])

    @property
    def own_targets(self) -> bool:
        """Whether each agent has a target of its own."""
        return len(self.targets) == self.positions.shape[1] > 1

    def links(self, k: int) -> list[tuple[int, int]]:
        """The edges at time `k` whose two ends are known."""
        known = np.isfinite(self.positions[k]).all(-1)
        edges = self.edges[k if len(self.edges) > 1 else 0]
        return [(i, j) for i, j in edges if max(i, j) < len(known) and known[i] and known[j]]


def scenes(films: Sequence[Film]) -> list[Scene]:
    """Regular films, drawn to one scale unless they differ too much in size for that."""
    made = [scene for film in films if (scene := _scene(film)) is not None]
    sides = [scene.view[2] for scene in made]
    if not made or max(sides) > 2.5 * min(sides):
        return made
    return [replace(scene, view=(*scene.view[:2], max(sides))) for scene in made]


def _scene(film: Film) -> Scene | None:
    positions = _array(film.get("positions"))
    if positions.ndim != 3 or not positions.size:
        return None
    time, agents = positions.shape[:2]
    targets = _array(film.get("target")).reshape(-1, 2)
    headings = (
        None if film.get("headings") is None else _array(film.get("headings")).reshape(time, agents)
    )
    name = next((name for name in ("lyapunov", "cost") if film.get(name) is not None), None)
    radius = _number(film.get("radius")) or 0.0
    return Scene(
        label=str(film.get("label") or "episode"),
        start="" if film.get("start") is None else str(film.get("start")),
        run=str(film.get("run") or ""),
        dt=_number(film.get("dt")) or 0.1,
        radius=radius,
        targets=targets,
        positions=positions,
        headings=headings,
        leaders=([bool(flag) for flag in film.get("leaders") or ()] + [False] * agents)[:agents],
        edges=_edges(film.get("edges"), time),
        distance=_distance(film, positions, targets),
        level=None if name is None else _over(film.get(name), time),
        level_name=str(film.get("function") or "L") if name == "lyapunov" else name or "",
        rises=name == "lyapunov",
        success=None if film.get("success") is None else bool(film.get("success")),
        view=_view(positions, targets, radius),
    )


def _distance(film: Film, positions: np.ndarray, targets: np.ndarray) -> np.ndarray:
    time = len(positions)
    if film.get("distance") is not None:
        return _over(film.get("distance"), time)
    if len(targets) not in (1, positions.shape[1]):
        return np.full(time, np.nan)
    return np.linalg.norm(positions - targets, axis=-1).max(-1)


def _edges(edges: Any, time: int) -> list[list[tuple[int, int]]]:
    """Edges over time; one entry when they never change."""
    plain = [] if edges is None else [np.asarray(e).tolist() for e in edges]
    moving = any(not e or isinstance(e[0], list) for e in plain)
    frames = [[(int(i), int(j)) for i, j in frame] for frame in (plain if moving else [plain])]
    if all(frame == frames[0] for frame in frames):
        return frames[:1]
    return (frames + frames[-1:] * time)[:time]


def _over(values: Any, time: int) -> np.ndarray:
    """Values over time, filled with NaN or cut to the length of the film."""
    known = _array(values).reshape(-1)[:time]
    return np.concatenate([known, np.full(time - len(known), np.nan)])


def _view(positions: np.ndarray, targets: np.ndarray, radius: float) -> tuple[float, float, float]:
    corners = [positions.reshape(-1, 2), targets - radius, targets + radius]
    cloud = np.concatenate(corners)
    cloud = cloud[np.isfinite(cloud).all(-1)]
    if not len(cloud):
        return 0.0, 0.0, 2.0
    low, high = cloud.min(0), cloud.max(0)
    x, y = (low + high) / 2
    return float(x), float(y), 1.12 * max(float((high - low).max()), 6 * radius, 1e-3)


def _film(scene: Scene) -> dict[str, Any]:
    """What the player reads."""
    return {
        "label": scene.label,
        "dt": scene.dt,
        "radius": scene.radius,
        "targets": _plain(scene.targets),
        "positions": _plain(scene.positions),
        "headings": None if scene.headings is None else _plain(scene.headings, 3),
        "leaders": scene.leaders,
        "edges": scene.edges,
        "distance": _plain(scene.distance),
        "level": None if scene.level is None else _plain(scene.level, significant=True),
        "levelName": scene.level_name,
        "rises": scene.rises,
        "view": _plain(np.array(scene.view)),
    }


def _episodes(shown: Sequence[Scene]) -> str:
    """The buttons that choose an episode."""
    return "".join(
        _tag(
            "button",
            f"{_tag('b', _text(scene.label))} {_tag('span', _outcome(scene))}",
            type="button",
            data_film=k,
            aria_pressed="true" if k == 0 else "false",
        )
        for k, scene in enumerate(shown)
    )


def _outcome(scene: Scene) -> str:
    """Whose episode it is, where that is said, and how it went."""
    run = [scene.run] if scene.run else []
    end = {None: [], True: ["success"], False: ["failure"]}[scene.success]
    return _text(" · ".join([*run, scene.detail, *end]))


def _starts(shown: Sequence[Scene], most: int = 6) -> str:
    figures = [
        _captioned(_panel(scene), f"{_tag('b', _text(scene.label))} {_outcome(scene)}")
        for scene in shown[:most]
    ]
    note = (
        "Paths from the start (small circle) to the last step, with a dot every second. Leaders "
        "are filled, and the target's ring is to scale."
    )
    body = _tag("div", "".join(figures), cls="charts")
    return _section("A few starts", body, note) if figures else ""


def _panel(scene: Scene) -> str:
    """The paths of one episode in a square of 300 units."""
    x0, y0, side = scene.view
    scale = 300 / side
    place = (scene.positions - (x0, y0)) * (scale, -scale) + 150
    rings = (scene.targets - (x0, y0)) * (scale, -scale) + 150
    body = ""
    for value in ticks(x0 - side / 2, x0 + side / 2):
        body += _grid_line(150 + (value - x0) * scale, value, upright=True)
    for value in ticks(y0 - side / 2, y0 + side / 2):
        body += _grid_line(150 - (value - y0) * scale, value, upright=False)
    for k, (x, y) in enumerate(rings):
        own = f" c{k % len(PALETTE)}" if scene.own_targets else ""
        body += _tag("circle", cls="target" + own, cx=x, cy=y, r=max(scene.radius * scale, 2.5))
    for i, j in scene.links(-1):
        (a, b), (c, d) = place[-1, i], place[-1, j]
        body += _tag("line", cls="edge", x1=a, y1=b, x2=c, y2=d)
    body += "".join(_path(scene, place[:, k], k) for k in range(place.shape[1]))
    return _svg(300, 300, body, f"trajectories, {scene.label}", "square")


def _grid_line(at: float, value: float | int, *, upright: bool) -> str:
    """A line of the grid with its number, but none in the corners."""
    label = f"{_short(value)} m" if 24 < at < 276 else ""
    if upright:
        return _tag("line", cls="grid", x1=at, x2=at, y1=0, y2=300) + _tag(
            "text", label, x=at + 3, y=296
        )
    return _tag("line", cls="grid", x1=0, x2=300, y1=at, y2=at) + _tag("text", label, x=3, y=at - 3)


def _path(scene: Scene, place: np.ndarray, agent: int) -> str:
    """One agent's path, a dot a second, and its shape at the end."""
    known = np.isfinite(place).all(-1)
    if not known.any():
        return ""
    colour, path = f"c{agent % len(PALETTE)}", place[known]
    every = max(round(1 / scene.dt), 1)
    body = _tag("polyline", cls=f"thin {colour}", points=_points(*path.T))
    for x, y in place[every:-1:every]:
        body += _tag("circle", cls=colour, cx=x, cy=y, r=1.7) if np.isfinite(x + y) else ""
    body += _tag("circle", cls=f"start {colour}", cx=path[0, 0], cy=path[0, 1], r=3.2)
    angle = math.nan if scene.headings is None else float(scene.headings[known][-1, agent])
    turn = f"rotate({-math.degrees(angle):.1f})"
    shape = (
        _tag("path", d="M9 0L-6 5.5L-6 -5.5Z", transform=turn)
        if math.isfinite(angle)
        else _tag("circle", r=5)
    )
    ring = _tag("circle", cls="crown", r=11) if scene.leaders[agent] else ""
    role = "leader" if scene.leaders[agent] else "follower"
    x, y = path[-1]
    return body + _tag(
        "g", shape + ring, cls=f"{role} {colour}", transform=f"translate({x:.1f} {y:.1f})"
    )


# -------------------------------------------------------------------------------------------------
# Words and numbers
# -------------------------------------------------------------------------------------------------


def _tag(name: str, content: str = "", **attributes: Any) -> str:
    """An element; `cls` stands for class, and an attribute that is None is left out."""
    text = ""
    for key, value in attributes.items():
        if value is not None:
            shown = f"{value:.1f}" if isinstance(value, float) else escape(str(value), quote=True)
            text += f' {"class" if key == "cls" else key.replace("_", "-")}="{shown}"'
    return f"<{name}{text}>{content}</{name}>"


def _svg(width: int, height: int, content: str, title: str, kind: str | None = None) -> str:
    head = {"viewBox": f"0 0 {width} {height}", "role": "img", "aria_label": title, "cls": kind}
    return _tag("svg", content, **head)


def _text(value: Any, missing: str = DASH) -> str:
    return missing if value is None else escape(str(value), quote=True)


def _number(value: Any) -> float | None:
    """A finite number, or None."""
    try:
        number = float(value)
    except (TypeError, ValueError):
        return None
    return number if math.isfinite(number) else None


def _pair(values: Any) -> tuple[float, float] | None:
    low, high = (_number(v) for v in (*(values if values is not None else ()), None, None)[:2])
    return None if low is None or high is None else (low, high)


def _array(values: Any) -> np.ndarray:
    """Floats, with None as NaN."""
    return np.asarray([] if values is None else values, dtype=float)


def _quantile(quantiles: Mapping[Any, Any] | None, q: float) -> float | None:
    return next((value for key, value in (quantiles or {}).items() if _number(key) == q), None)


def _integer(value: Any) -> str:
    number = _number(value)
    return DASH if number is None else f"{number:,.0f}".replace(",", "\u202f")


def _decimal(value: Any, digits: int, unit: str = "") -> str:
    number = _number(value)
    return (
        DASH
        if number is None
        else f"{number:.{digits}f}{' ' + unit if unit else ''}".replace("-", "\u2212")
    )


def _percent(value: Any) -> str:
    """A rate in per cent; only an exact one is written as 0 or 100."""
    rate = _number(value)
    if rate is None:
        return DASH
    if rate in (0.0, 1.0):
        return f"{100 * rate:.0f} %"
    return f"{min(max(100 * rate, 0.1), 99.9):.1f} %"


def _interval(values: Any) -> str:
    pair = _pair(values)
    return (
        DASH
        if pair is None
        else f"{_percent(pair[0]).removesuffix(' %')} {DASH} {_percent(pair[1])}"
    )


def _p_value(value: Any) -> str:
    number = _number(value)
    if number is None:
        return DASH
    return "&lt; 0.0001" if number < 1e-4 else f"{number:.2g}"


def _short(value: float | int) -> str:
    """A tick's label."""
    for size, letter in ((1e6, "M"), (1e3, "k")):
        if abs(value) >= size:
            return f"{value / size:g}{letter}".replace("-", "\u2212")
    return f"{0.0 if abs(value) < 1e-12 else value:.6g}".replace("-", "\u2212")


def _duration(seconds: Any) -> str:
    number = _number(seconds)
    if number is None:
        return DASH
    if number < 60:
        return f"{number:.1f} s"
    minutes, seconds = divmod(round(number), 60)
    hours, minutes = divmod(minutes, 60)
    parts = ((hours, "h"), (minutes, "min"), (seconds, "s"))
    return " ".join(f"{count} {unit}" for count, unit in parts if count)


def _any(value: Any) -> str:
    """A value of unknown kind as text."""
    plain = _plain(value, significant=True)
    if plain is None:
        return DASH
    if isinstance(plain, bool):
        return "yes" if plain else "no"
    if isinstance(plain, list) and not any(isinstance(item, list | dict) for item in plain):
        return ", ".join(_any(item) for item in plain) or DASH
    return _text(
        plain if isinstance(plain, str) else json.dumps(plain, ensure_ascii=False, default=str)
    )


def _plain(value: Any, digits: int = 4, *, significant: bool = False) -> Any:
    """Python's own numbers, rounded, with None for what is not finite."""
    if isinstance(value, np.ndarray | np.generic):
        value = value.tolist()
    if isinstance(value, float):
        if not math.isfinite(value):
            return None
        value = float(f"{value:.{digits}g}") if significant else round(value, digits)
        return int(value) if value == int(value) and abs(value) < 1e6 else value
    if isinstance(value, Mapping):
        return {
            str(key): _plain(item, digits, significant=significant) for key, item in value.items()
        }
    if isinstance(value, list | tuple):
        return [_plain(item, digits, significant=significant) for item in value]
    return value


def _json(value: Any) -> str:
    """JSON that can stand inside a script element, whatever the strings say."""
    dense = json.dumps(value, separators=(",", ":"), allow_nan=False)
    return dense.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")
