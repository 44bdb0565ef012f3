"""What a report is made of: plain records, without JAX and without a game.

Only the title of a `Page` and the frames of a `Film` are required. A number that is missing or not
finite is shown as a dash.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from marlyap.errors import UserError


MARK = '<p class="kicker">marlyap report'  # by which a report is recognised

Number = float | int | None
Quantiles = Mapping[str, Number]  # by quantile: "0.5", "0.95", "1.0"
Pairs = tuple[tuple[int, int], ...]


@dataclass(frozen=True, kw_only=True)
class Share:
    """A share of the episodes with its interval."""

    episodes: int | None = None
    successes: int | None = None
    success_rate: Number = None
    interval: Sequence[Number] | None = None  # 95 %, low and high


@dataclass(frozen=True, kw_only=True)
class Within(Share):
    """Success at one radius."""

    radius: Number = None  # in the unit of the game's distance


@dataclass(frozen=True, eq=False, kw_only=True)
class Along:
    """The team's cost of a step along an episode: its mean over starts, and where 90 % lie."""

    times: np.ndarray  # [time], s
    mean: np.ndarray  # [time]
    low: np.ndarray  # [time], the quantile .05 over the starts
    high: np.ndarray  # [time], the quantile .95


@dataclass(frozen=True, kw_only=True)
class Figures(Share):
    """What an evaluation found, of one policy or over the training seeds of a group."""

    label: str = ""
    game: str = ""  # that it was measured on, in words; charts are drawn for each
    unit: str = ""  # of the radius, the radii and the final distance
    confidence: Number = None
    radius: Number = None  # of success
    radii: tuple[Within, ...] = ()
    held: Share | None = None
    failed: Share | None = None
    at_rest: Share | None = None  # of a game with a map, as are speed and spin
    stayed: Share | None = None
    beyond_steps: int | None = None  # steps after the last over which `stayed` looks
    lost: Share | None = None  # farther off when those end than at the start, and not arrived
    back: Number = None  # of the ends of later horizons, the share with success
    end_speed: Quantiles = field(default_factory=dict)  # m/s, of the fastest agent, when they end
    swing: Quantiles = field(default_factory=dict)  # of the worst distance in the last horizon
    violations: Share | None = None
    final_distance: Quantiles = field(default_factory=dict)
    final_speed: Quantiles = field(default_factory=dict)  # m/s, of the fastest agent
    final_spin: Quantiles = field(default_factory=dict)  # rad/s
    settling_time: Quantiles = field(default_factory=dict)  # s
    return_mean: Number = None  # of an episode
    cost_mean: Number = None  # of the team, mean over steps and episodes
    rests: str = ""  # what a team does once it has arrived, in words
    finals: Sequence[Number] = ()  # the final distance of every episode
    along: Along | None = None


@dataclass(frozen=True, kw_only=True)
class Group(Figures):
    """Runs that differ in their training seed alone: what is said at the top of the page."""

    seeds: Sequence[int | None] = ()
    about: str = "this policy"  # whether the interval is about one policy or a mean over seeds
    rates: Sequence[float] = ()  # of each run, where there are several
    text: str = ""  # one plain sentence: what is certified and what is not


@dataclass(frozen=True)
class LogRow:
    """One line of the training log."""

    steps: Number = None  # environment steps so far
    success: Number = None  # rate
    total: Number = None  # mean return of an episode


@dataclass(frozen=True, kw_only=True)
class Trained(Figures):
    """One trained run (one seed) and its evaluation."""

    name: str = ""
    group: str = ""  # label of the group that it belongs to
    seed: int | None = None
    log: tuple[LogRow, ...] = ()


@dataclass(frozen=True, eq=False, kw_only=True)
class Frames:
    """A trajectory to be drawn, of any physics. Bodies begin with the agents.

    Without positions there is no map, and the signals are drawn alone. Raises UserError if shapes
    disagree.
    """

    times: np.ndarray  # [time], s, evenly spaced
    positions: np.ndarray | None = None  # [time body d], d 1 (a road), 2 or 3
    headings: np.ndarray | None = None  # [time body 2], unit vectors in the plane of x and y
    goals: np.ndarray | None = None  # [time agent d]
    signals: Mapping[str, np.ndarray] = field(default_factory=dict)  # "name (unit)": [time agent]
    leaders: tuple[bool, ...] = ()  # of each agent
    links: tuple[Pairs, ...] = ()  # one entry where they never change, else [time]
    rods: Pairs = ()  # bodies that are joined; the second has the colour of the first
    edge: Number = None  # how near is near enough, drawn around each goal
    unit: str = ""  # of positions and edge

    def __post_init__(self):
        put = lambda name, value: object.__setattr__(self, name, value)
        put("times", np.asarray(self.times, float))
        time = len(self.times)
        if self.times.ndim != 1 or not time:
            raise UserError("frames: times must list at least one instant.")
        for name in ("positions", "headings", "goals"):
            if (value := getattr(self, name)) is not None:
                put(name, np.asarray(value, float))
        put("signals", {k: np.asarray(v, float) for k, v in self.signals.items()})
        shapes = {k: v.shape for k, v in self.signals.items()}
        if bad := [k for k, s in shapes.items() if len(s) != 2 or s[0] != time]:
            raise UserError(f"frames: signal {bad[0]!r} is {shapes[bad[0]]}, not [{time}, agents].")
        if self.positions is not None:
            shape = self.positions.shape
            if len(shape) != 3 or shape[0] != time or not shape[1] or shape[2] not in (1, 2, 3):
                raise UserError(
                    f"frames: positions are {shape}; give one place of 1 to 3 numbers for each of "
                    f"the {time} times and each body."
                )
            for name, last in (("headings", 2), ("goals", shape[2])):
                value = getattr(self, name)
                if value is not None and (
                    value.ndim != 3 or (value.shape[0], value.shape[2]) != (time, last)
                ):
                    raise UserError(f"frames: {name} are {value.shape}, not [{time}, n, {last}].")
        if len(self.links) not in (0, 1, time):
            raise UserError(f"frames: links have {len(self.links)} entries; give 1 or {time}.")

    @property
    def dt(self) -> float:
        """Between two times (s)."""
        return float(np.diff(self.times).mean()) if len(self.times) > 1 else 0.1


@dataclass(frozen=True, eq=False, kw_only=True)
class Film:
    """One episode and what is said of it."""

    frames: Frames
    label: str = "episode"  # "best", "median", "worst", ...
    start: str = ""  # number of the start among those evaluated
    run: str = ""  # who drives: a run, or the name of a controller
    shot: str = ""  # equal for films of one start of one game: they can be seen side by side
    title: str = ""  # of such films, where it is not the label
    distance: np.ndarray | None = None  # [time], of the agent farthest from where it has to be
    edge: Number = None  # the distance up to which an agent counts as arrived
    unit: str = ""  # of distance and edge
    level: np.ndarray | None = None  # [time]: a Lyapunov function, or the cost
    level_name: str = ""
    cost: np.ndarray | None = None  # [time], where the level is another
    rises: bool = False  # whether the level should fall, so that its rises are marked
    success: bool | None = None

    def __post_init__(self):
        for name in ("distance", "level", "cost"):
            if (value := getattr(self, name)) is not None:
                array, time = np.asarray(value, float), len(self.frames.times)
                if array.shape != (time,):
                    raise UserError(f"film: {name} has shape {array.shape}, not [{time}].")
                object.__setattr__(self, name, array)


@dataclass(frozen=True)
class Comparison:
    """Two runs on the same starts: McNemar's test on the starts that only one of them mastered."""

    a: str = ""
    b: str = ""
    only_a: int | None = None
    only_b: int | None = None
    p_value: Number = None


@dataclass(frozen=True, kw_only=True)
class Claim:
    """One certificate's claim, and what stands behind it."""

    name: str = "claim"
    claim: str = ""  # in words
    evidence: str | None = None  # proved, statistical or observed
    run: str = ""  # whose it is
    holds: bool | None = None
    asked: Number = None  # share of the starts that had to be shown
    shown: str | None = None  # the bound in words
    bound: Number | str = None
    confidence: Number | str = None
    scope: str | None = None  # start distribution, horizon, disturbance
    shot: str = ""  # of the film of its worst case


@dataclass(frozen=True, eq=False, kw_only=True)
class Slice:
    """V over the places of one agent relative to its goal, the others resting on theirs."""

    label: str
    values: np.ndarray  # [y x], evenly spaced over the square that is shown
    reach: float | int  # half the side of that square
    radius: float | int  # of success
    unit: str = ""  # of both
    level: Number = None  # that was certified, where it is in the picture
    facing: bool = False  # whether the agent has a heading
    run: str = ""  # whose it is


@dataclass(frozen=True, kw_only=True)
class Training:
    """How one run was made."""

    name: str = ""
    command: str = ""
    made: str = ""  # date
    seed: int | None = None
    seconds: Number = None
    policy: str = ""  # the first digits of its hash
    versions: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class Difference:
    """A field in which configurations differ, and its value in each."""

    field: str
    values: Sequence[str]  # one for each group of the page


@dataclass(frozen=True, kw_only=True)
class Page:
    """All that a report shows."""

    title: str
    subtitle: str = ""  # task and algorithm in words
    generated: str = ""  # date
    starts: int | None = None  # seed of the starts
    groups: tuple[Group, ...] = ()
    runs: tuple[Trained, ...] = ()
    films: tuple[Film, ...] = ()
    comparisons: tuple[Comparison, ...] = ()
    claims: tuple[Claim, ...] = ()
    slices: tuple[Slice, ...] = ()
    notes: tuple[str, ...] = ()  # what is missing, and why
    config: Mapping[str, Any] = field(default_factory=dict)  # that all runs have in common
    changed: tuple[str, ...] = ()  # its fields that are not the default, by dotted name
    differing: tuple[Difference, ...] = ()
    training: tuple[Training, ...] = ()
    versions: Mapping[str, str] = field(default_factory=dict)  # of what made the report
    command: str = ""  # that made the report
