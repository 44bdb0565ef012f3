"""Runs belong together by their whole configuration, and nothing is said across configurations."""

import dataclasses
import itertools
from pathlib import Path

import numpy as np
import pytest

from marlyap.learning.algorithms import ALGORITHMS, MASAC
from marlyap.learning.constraints import Lyapunov
from marlyap.learning.trainer import Schedule, Trainer
from marlyap.runs import groups
from marlyap.runs.run import Run
from marlyap.simulation.evaluation import Evaluation
from marlyap.statistics import clopper_pearson, mean_interval
from marlyap.tasks import TASKS, Rendezvous


NAMES = {"task": "rendezvous", "algorithm": "masac-lyapunov", "preset": "tuned"}
CONTROL = MASAC(constraint=Lyapunov(reading="critic", weight=1.0))


def outcome(successes, episodes=20):
    """An evaluation in which so many of the episodes succeed and then rest."""
    good = np.arange(episodes) < successes
    still, far = np.zeros(episodes), np.where(good, 0.02, 0.4)
    times = np.where(good, 1.0, np.inf)
    broken = np.zeros(episodes, bool)
    return Evaluation(
        successes=good,
        failed=broken,
        final=far,
        held=good,
        stayed=good,
        speed=still,
        spin=still,
        settled=times,
        back=good.astype(float),
        ended=still,
        swing=still,
        lost=broken,
        violated=broken,
        total=-far,
        cost=far,
        edge=0.1,
        unit="m",
        mapped=True,
        beyond=360,
    )


def made(place, seed=0, successes=15, game=None, algorithm=None, asked=None, starts=0, **about):
    """A run that was measured, without training it; `place` names its directory."""
    game = TASKS["rendezvous"] if game is None else game
    rule = ALGORITHMS["masac-lyapunov"] if algorithm is None else algorithm
    trainer = Trainer(game, rule, about.pop("schedule", Schedule()))
    run = Run(Path(place), trainer, seed, NAMES | about)
    return groups.of_run(run, outcome(successes), starts, asked)


def test_seeds_of_one_configuration_belong_together():
    found = [made(f"a{s}", s) for s in (0, 1)] + [made("b", 0, algorithm=CONTROL)]
    teams = groups.grouped(found)
    assert [len(members) for members in teams.values()] == [2, 1]
    assert list(teams)[1] == (
        "rendezvous masac-lyapunov (constraint.reading=critic, constraint.weight=1)"
    )
    assert list(teams)[0].endswith("(constraint.reading=han, constraint.weight=none)")
    assert list(groups.grouped(found[:2])) == ["rendezvous masac-lyapunov"]


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"game": Rendezvous(agents=5)}, "agents=5"),
        ({"game": Rendezvous(size=2.0)}, "size=2"),
        ({"algorithm": MASAC(constraint=Lyapunov(), rate_Q=1e-4)}, "rate_Q=0.0001"),
        ({"algorithm": MASAC()}, "constraint=Unconstrained"),
        ({"schedule": Schedule(steps=1000)}, "steps=1000"),
        ({"asked": Rendezvous(horizon=80)}, "measured on horizon=80"),
        ({"preset": "paper"}, "(paper)"),
    ],
)
def test_any_field_keeps_runs_apart(change, says):
    names = list(groups.grouped([made("a"), made("b", 1, **change)]))
    assert len(names) == 2 and says in names[1]


def test_of_one_policy_the_interval_is_exact_and_of_seeds_it_is_about_their_mean():
    one = groups.summary([made("a", successes=18)])
    assert one["interval"] == pytest.approx(clopper_pearson(18, 20)) and one["seeds"] == [0]
    assert groups.words(one) == "90.0 % [68.3, 98.8] of this policy"
    rates = (0.5, 0.9, 1.0)
    several = groups.summary([made(str(s), s, int(20 * r)) for s, r in enumerate(rates)])
    assert several["success_rate"] == pytest.approx(0.8) and several["episodes"] == 60
    assert several["successes"] == 48 and several["rates"] == [*rates]
    for part in (several, several["at_rest"], several["stayed"], several["radii"][0]):
        assert part["interval"] == pytest.approx(mean_interval(rates))
    assert several["interval"][1] - several["interval"][0] > 0.5  # pooled it would be 0.2
    assert groups.words(several).startswith("mean over 3 training seeds 80.0 % [")


def test_two_runs_of_one_seed_are_one_draw():
    twice = groups.summary([made("a", 4, 10), made("b", 4, 20)])
    assert twice["interval"] == pytest.approx(mean_interval([0.75]))
    assert groups.words(twice).startswith("mean over 1 training seed ")


def test_no_two_labels_are_equal():
    found = [made("x/a"), made("x/b"), made("c", 1, algorithm=CONTROL)]
    teams, labels = groups.labels(found, brief=True)
    assert teams == [
        "constraint.reading=han, constraint.weight=none",
        "constraint.reading=critic, constraint.weight=1",
    ]
    assert labels[0].endswith("seed 0 (x/a)") and labels[2].endswith("weight=1, seed 1")
    assert len(set(labels)) == 3
    assert groups.labels(found[:1], brief=True) == (
        ["rendezvous masac-lyapunov"],
        ["rendezvous masac-lyapunov, seed 0"],
    )


def test_pairs_are_compared_on_one_game_and_the_same_starts_alone():
    base, control = made("a"), made("b", algorithm=CONTROL)
    compared = lambda *found: [(p["a"], p["b"]) for p in groups.comparisons(found)]
    assert compared(base, control) == [("a", "b")]  # the comparison the project is about
    assert compared(base, made("c", 1)) == []  # of one configuration
    larger = Rendezvous(size=2.0)
    other_game = made("d", algorithm=CONTROL, game=larger)
    other_starts = made("e", algorithm=CONTROL, starts=1)
    fewer = dataclasses.replace(control, evaluation=outcome(10, episodes=10))
    by_hand = groups.of_controller("tree-pursuit", larger, outcome(3), 0)
    for one in (other_game, other_starts, fewer, by_hand):
        assert compared(base, one) == []
    assert compared(by_hand, other_game) == [("tree-pursuit", "d")]
    same_asked = made("f", algorithm=CONTROL, asked=larger)
    assert compared(by_hand, same_asked, base) == [("tree-pursuit", "f")]


def test_the_order_does_not_matter():
    found = [
        made("a"),
        made("b", 1),
        made("c", algorithm=CONTROL),
        made("d", game=Rendezvous(agents=5)),
    ]
    teams = {frozenset(m.name for m in members) for members in groups.grouped(found).values()}
    for order in itertools.permutations(found):
        again = groups.grouped(order)
        assert {frozenset(m.name for m in members) for members in again.values()} == teams
