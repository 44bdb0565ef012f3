"""How much is played and learnt, and the schedules that have a name."""

import equinox as eqx

from marlyap.errors import check_range, whole_fields


class Schedule(eqx.Module):
    """How much is played and learnt. An iteration plays `environments` episodes, then updates."""

    steps: int = 204_800  # environment steps in all
    environments: int = 64  # episodes played side by side in an iteration
    steps_per_update: int = 8  # environment steps for one gradient step
    warmup: int = 2_560  # environment steps of uniformly random actions before learning
    capacity: int = 1_024_000  # environment steps that the replay memory holds
    decay: float = 0.1  # learning rates are multiplied by this ...
    decay_episodes: int | None = None  # ... every so many episodes (None: over the whole run)
    select_every: int = 8  # iterations between evaluations of the policy
    select_episodes: int = 500  # starts on which the best policy so far is chosen

    def __check_init__(self):
        whole_fields(self)
        for name, low, high in (
            ("steps", 1, 10**12),
            ("environments", 1, 10**6),
            ("steps_per_update", 1, 10**9),
            ("warmup", 0, 10**9),
            ("capacity", 1, 10**9),
            ("select_every", 1, 10**9),
            ("select_episodes", 1, 10**6),
        ):
            check_range(name, getattr(self, name), low, high)
        check_range("decay", self.decay, 0, 1, open=True)
        if self.decay_episodes is not None:
            check_range("decay_episodes", self.decay_episodes, 1, 10**12)

    def updates(self, steps: int) -> int:
        """Gradient steps for so many environment steps: one at least."""
        return max(1, steps // self.steps_per_update)


SCHEDULES = {
    "tuned": Schedule(),
    # Section 4: one environment, one update a step, rates falling to 7.5 % every 2000 episodes.
    "paper": Schedule(
        steps=100_000,
        environments=1,
        steps_per_update=1,
        warmup=1_000,
        decay=0.075,
        decay_episodes=2_000,
        select_every=50,
    ),
}
