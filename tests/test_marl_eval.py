"""The JSON schema of marl-eval, from rows and from runs."""

import dataclasses
import json

import pytest

from marlyap.errors import UserError
from marlyap.learning.algorithms import MASAC
from marlyap.learning.trainer import Schedule, Trainer
from marlyap.runs.marl_eval import document, from_runs
from marlyap.runs.run import Run
from marlyap.tasks import Rendezvous


def looks(seed, *values, **others):
    about = {"task": "t", "algorithm": "a", "seed": seed} | others
    return [about | {"steps": 10 * (k + 1), "success": v} for k, v in enumerate(values)]


def end(seed, value, **others):
    return {"task": "t", "algorithm": "a", "seed": seed, "success": value} | others


def test_the_document_by_hand():
    """Strings and numbers alike: rows of a CSV file serve as well."""
    curves = [*looks(0, 0.1, 0.2), *looks("1", "0.3", "0.4", algorithm="b")]
    final = [end("1", "0.9", algorithm="b", extra=1), end(0, 0.8, extra=1)]
    assert document(curves, final, "e") == {
        "e": {
            "t": {
                "a": {
                    "seed_0": {
                        "step_0": {"step_count": 10, "success": [0.1]},
                        "step_1": {"step_count": 20, "success": [0.2]},
                        "absolute_metrics": {"success": [0.8]},
                    }
                },
                "b": {
                    "seed_1": {
                        "step_0": {"step_count": 10, "success": [0.3]},
                        "step_1": {"step_count": 20, "success": [0.4]},
                        "absolute_metrics": {"success": [0.9]},
                    }
                },
            }
        }
    }


@pytest.mark.parametrize(
    "curves, final, parts",
    [
        (looks(3, 0.1), [end(4, 0.5)], ["final:", "a seed 3 on t"]),
        ([*looks(0, 0.1), *looks(1, 0.1, 0.2)], [end(0, 1), end(1, 1)], ["curves:", "seed 1", "2"]),
    ],
)
def test_what_the_tool_would_refuse_is_refused(curves, final, parts):
    with pytest.raises(UserError) as error:
        document(curves, final)
    assert all(part in str(error.value) for part in parts)


def test_nothing_is_an_empty_document():
    assert document([], []) == {"marlyap": {}}


def test_from_runs(tmp_path):
    trainer = Trainer(Rendezvous(), MASAC(), dataclasses.replace(Schedule(), steps=10))
    names = {"task": "rendezvous", "algorithm": "masac", "preset": "tuned"}
    run = Run.create(tmp_path / "seed7", trainer, 7, names)
    run.log({"iteration": 1, "steps": 5, "return": -9.0})
    run.log({"iteration": 2, "steps": 10, "return": -8.0, "success": 0.25, "distance": 1.0})
    with pytest.raises(UserError, match="not measured"):
        from_runs([run.directory])
    (run.directory / "evaluation.json").write_text(
        json.dumps({"success_rate": 0.5, "return_mean": -7.0})
    )
    assert from_runs([run.directory]) == {
        "marlyap": {
            "rendezvous": {
                "masac": {
                    "seed_7": {
                        "step_0": {"step_count": 10, "success": [0.25], "return": [-8.0]},
                        "absolute_metrics": {"success": [0.5], "return": [-7.0]},
                    }
                }
            }
        }
    }


def measured_run(place, seed, rule, rate, starts=0):
    trainer = Trainer(Rendezvous(), rule, dataclasses.replace(Schedule(), steps=10))
    names = {"task": "rendezvous", "algorithm": "masac", "preset": "tuned"}
    run = Run.create(place, trainer, seed, names)
    run.log({"iteration": 2, "steps": 10, "return": -8.0, "success": 0.25})
    end = {"success_rate": rate, "return_mean": -7.0, "start_seed": starts, "episodes": 500}
    (place / "evaluation.json").write_text(json.dumps(end))
    return place


def test_settings_of_one_algorithm_are_told_apart(tmp_path):
    plain = [measured_run(tmp_path / f"a{s}", s, MASAC(), 0.5) for s in (0, 1)]
    other = measured_run(tmp_path / "b", 0, MASAC(rate_Q=1e-4), 0.75)
    found = from_runs([*plain, other])["marlyap"]["rendezvous"]
    assert {name: len(seeds) for name, seeds in found.items()} == {
        f"masac (rate_Q={MASAC().rate_Q:g})": 2,
        "masac (rate_Q=0.0001)": 1,
    }
    again = measured_run(tmp_path / "c", 0, MASAC(), 0.9)
    with pytest.raises(UserError, match="masac seed 0 on rendezvous is there twice"):
        from_runs([*plain, again])
    elsewhere = measured_run(tmp_path / "d", 2, MASAC(), 0.9, starts=7)
    with pytest.raises(UserError, match="same starts"):
        from_runs([*plain, elsewhere])
