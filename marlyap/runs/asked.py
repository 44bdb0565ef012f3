"""What a user names, and the trainer that is made of it."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from marlyap.errors import UserError
from marlyap.learning.algorithm import AbstractAlgorithm
from marlyap.learning.algorithms import PRESETS
from marlyap.learning.trainers import ready, trainer_for, usual_schedule
from marlyap.learning.training import AbstractTrainer
from marlyap.runs import config
from marlyap.runs.subject import unfolded
from marlyap.shields import behind


@dataclass(frozen=True)
class Asked:
    """What the user named: task, algorithm and preset, and the environment steps of each seed."""

    task: str
    algorithm: str
    preset: str | None = None
    steps: int | None = None
    shield: bool = False  # whether it is trained behind one

    @property
    def names(self) -> dict[str, str]:
        """As run.json holds them."""
        return {
            "task": self.task,
            "algorithm": self.algorithm,
            "preset": self.preset or "tuned",
        }


def assemble(asked: Asked, overrides: Mapping[str, str]) -> AbstractTrainer:
    """Task, algorithm and schedule as asked for."""
    made = parts(asked, overrides)
    return trainer_for(made["game"], made["algorithm"], made["schedule"])


def parts(asked: Asked, overrides: Mapping[str, str]) -> dict[str, Any]:
    """The same before the algorithm has been asked whether it fits the task."""
    preset = asked.names["preset"]
    if preset not in PRESETS:
        raise UserError(f"preset: '{preset}' is unknown; {config.suggest(preset, PRESETS)}")
    game = config.load_task(asked.task)
    algorithm = PRESETS[preset](config.load(asked.algorithm, AbstractAlgorithm))
    schedule = usual_schedule(game, algorithm, preset)
    made = unfolded(game, asked.shield, overrides)
    made |= {"algorithm": algorithm, "schedule": schedule}
    made = config.override_all(made, overrides)
    if asked.steps is not None:
        made["schedule"] = config.override(made["schedule"], "steps", str(asked.steps))
    game = ready(behind(made["task"], made.get("shield")))
    return {"game": game, "algorithm": made["algorithm"], "schedule": made["schedule"]}
