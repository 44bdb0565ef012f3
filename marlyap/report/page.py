"""One self-contained HTML page that says how good a team is and shows it moving.

`html` is a pure function from data to text: no JAX, no network, no files but the package's own
`page.html`, `style.css`, `player.js` and `charts.js`, and Bokeh's library. Every text is escaped,
and the page's security policy allows these scripts alone.
"""

import base64
import hashlib
import json
from collections.abc import Iterable, Sequence
from functools import cache
from importlib.resources import files
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from marlyap.report import charts, interactive, plot, words
from marlyap.report.data import Claim, Figures, Group, Page
from marlyap.report.scene import PALETTE, Scene, Shot, played, shots


MOST_SHOWN = 6  # episodes whose paths are drawn
SQUARE = (3.6, 3.6)  # inches


def html(page: Page) -> str:
    """The whole report as the text of one HTML file."""
    shown = shots(page.films)
    drawn = charts.charts(page.runs, page.groups)
    scripts = {"player": _own("player.js")}
    lively = interactive.embedded(drawn, page.slices) if drawn or page.slices else None
    if lively is not None:
        scripts |= {"bokeh": Markup(interactive.library()), "charts": _own("charts.js")}
    radii = sorted({radius for run in page.runs for radius, *_ in charts.within(run)})
    paths = [scene for shot in shown for scene in shot.scenes[:1]]
    return page_of(
        "page.html",
        page=page,
        policy=_policy(scripts.values()),
        scripts=scripts,
        shots=shown,
        scenes=[scene for shot in shown for scene in shot.scenes],
        films=_json([_told(shot) for shot in shown]),
        shot_of=_numbers(page),
        starts=[(scene, _paths(scene, f"s{k}-")) for k, scene in enumerate(paths[:MOST_SHOWN])],
        charts=drawn,
        lively=None if lively is None else _json([lively.document, lively.items]),
        games=list(dict.fromkeys(chart.game for chart in drawn)),
        teams=_teams(page),
        tints=[k % len(PALETTE) for k in charts.colours(page.runs)],
        config=list(words.flatten(page.config)),
        nearest=radii[:1],
        unit=_unit(page.runs),
    )


def _told(shot: Shot) -> dict[str, Any]:
    return {"label": shot.label, "films": [played(scene) for scene in shot.scenes]}


def _numbers(page: Page) -> dict[str, int]:
    """The number of each shot that has a name."""
    names = dict.fromkeys(film.shot or f"alone {k}" for k, film in enumerate(page.films))
    return {name: k for k, name in enumerate(names)}


def _teams(page: Page) -> list[dict[str, Any]]:
    """Each group with its runs, as the switches of the charts show them."""
    tints, runs = charts.colours(page.runs), page.runs
    made = []
    for k, group in enumerate(charts.teams(runs)):
        own = [n for n, run in enumerate(runs) if run.group == group]
        members = [(n, charts.name(runs[n]), tints[n] % len(PALETTE)) for n in own]
        made.append({"number": k, "name": group or "all runs", "members": members})
    return made


def page_of(template: str, **said: Any) -> str:
    """A page of this package, in its style."""
    return _templates().get_template(template).render(style=_own("style.css"), **said)


@cache
def _templates() -> Environment:
    made = Environment(
        loader=PackageLoader("marlyap", "report"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    for name in ("anything", "both", "decimal", "duration", "integer", "interval", "p_value"):
        made.filters[name] = getattr(words, name)
    made.filters |= {"percent": words.percent, "text": words.text}
    made.filters |= {"name": charts.name, "within": _rate_within}
    made.filters |= {
        "afterwards": _afterwards,
        "gauge": _gauge,
        "verdict": _verdict,
        "facts": _facts,
    }
    made.tests["known"] = lambda value: words.number(value) is not None
    return made


def _own(name: str) -> Markup:
    """A file of the package, which is trusted."""
    return Markup(files("marlyap.report").joinpath(name).read_text(encoding="utf-8"))


def _policy(scripts: Iterable[str]) -> str:
    """A content security policy: nothing from anywhere, and no script but these.

    The library of the charts draws its own small icons, as data.
    """
    digest = lambda text: base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()
    allowed = " ".join(f"'sha256-{digest(script)}'" for script in scripts)
    nothing = "default-src 'none'; base-uri 'none'; form-action 'none'; img-src data:"
    return f"{nothing}; style-src 'unsafe-inline'; script-src {allowed}"


def _json(value: Any) -> Markup:
    """JSON that can stand inside a script element, whatever the strings say."""
    dense = json.dumps(value, separators=(",", ":"), allow_nan=False)
    return Markup(dense.translate({ord(c): f"\\u{ord(c):04x}" for c in "<>&"}))


def _unit(runs: Sequence[Figures]) -> str:
    """The unit of distances and radii, where all runs share it."""
    units = {run.unit for run in runs}
    return units.pop() if len(units) == 1 else ""


# ---- pictures ----


def _paths(scene: Scene, prefix: str) -> Markup:
    height = SQUARE[0] * sum(plot.heights(scene))
    figure = plot.figure(SQUARE[0], height)
    plot.whole(figure, scene)
    return Markup(plot.svg(figure, f"trajectories, {scene.label}", prefix))


def _gauge(figures: Figures) -> dict[str, float]:
    """Where the rate and its interval stand on a line from 0 to 300."""
    rate = words.number(figures.success_rate) or 0.0
    low, high = words.pair(figures.interval) or (rate, rate)
    return {"rate": 300 * rate, "low": 300 * low, "width": 300 * max(high - low, 0.004)}


def _afterwards(group: Group) -> str:
    """What the team does once it has arrived."""
    share = lambda part: words.percent(None if part is None else part.success_rate)
    parts = [f"at rest at the last step: {share(group.at_rest)}"] * (group.at_rest is not None)
    if group.beyond_steps:
        more = words.integer(group.beyond_steps)
        parts.append(f"stays for {more} steps more: {share(group.stayed)}")
        parts.append(f"lost by then: {share(group.lost)}")
    return "; ".join(parts)


# ---- tables ----


def _rate_within(run: Figures, radius: float) -> float | None:
    return {r: rate for r, rate, *_ in charts.within(run)}.get(radius)


def _share_asked(claim: Claim) -> bool:
    """Whether a claim is about a share of the starts, and is judged by that share."""
    asked, bound = words.number(claim.asked), words.number(claim.bound)
    return asked is not None and bound is not None and claim.holds == (bound >= asked)


def _verdict(claim: Claim) -> tuple[str, str]:
    """A claim's verdict in words, and the class of its mark."""
    share = _share_asked(claim)
    if claim.holds:
        return ("reached" if share else "holds"), "holds"
    return ("not reached" if share else "does not hold"), "fails"


def _facts(claim: Claim) -> list[tuple[str, str]]:
    """What was asked and what was shown, and how."""
    facts: dict[str, Any] = {"evidence": claim.evidence}
    if _share_asked(claim):
        facts |= {"asked": words.percent(claim.asked)}
        facts |= {"shown": claim.shown or words.percent(claim.bound)}
    else:
        facts |= {"bound": claim.bound}
    facts |= {"confidence": claim.confidence, "scope": claim.scope}
    return [(k, words.anything(v)) for k, v in facts.items() if v is not None]
