"""The pytrees that cross the seams, each for one sample; a batch is made by `jax.vmap`.

Axis names used throughout: `agent`, `time`, `dx` (state of one agent), `du` (input of one
agent), `obs` (what one agent sees), `feature` (what the central critic sees of one agent).
"""

import equinox as eqx
import jaxtyping
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray, PyTree


Key = PRNGKeyArray
Keys = jaxtyping.Key[Array, "episode"]
Scalar = Float[Array, ""]
Action = Float[Array, "agent du"]
Obs = Float[Array, "agent obs"]
Links = Bool[Array, "agent agent"]
Features = Float[Array, "agent feature"]


class State(eqx.Module):
    """Everything the game knows at one instant."""

    x: Float[Array, "agent dx"]  # physical state of each agent, SI units, radians
    goal: Float[Array, "agent 2"]  # where each agent has to be (m); fixed within an episode
    t: Int[Array, ""]  # steps since the start
    memory: PyTree = None  # what else a game carries from step to step (delays, past observations)


class Transition(eqx.Module):
    """One tuple of the replay memory D: Algorithm 1's (s, a, r, s'), and what L needs.

    `reward` sums n steps and `next_*` lies n steps ahead when the algorithm asks for n-step
    returns; `discount` is gamma**n, and 0 once the game has terminated (a time limit does not
    terminate it).
    """

    obs: Obs
    features: Features
    action: Action
    log_prob: Float[Array, "agent"]  # of the action, under the policy that took it
    reward: Float[Array, "agent"]  # the team's reward is the mean
    cost: Float[Array, "agent"]  # c(s_t, a_t); the team's cost is the mean
    next_obs: Obs
    next_features: Features
    discount: Scalar
    cost_to_go: Float[Array, "agent"]  # L_target, the sum of the next T costs
    cost_ahead: Float[Array, "agent"]  # c_{t+T}
    noise: Float[Array, "agent 2 du"]  # standard normal, for the actions drawn at s and at s'


class Trajectory(eqx.Module):
    """What a game produced while a controller drove it, time-major."""

    action: Float[Array, "time agent du"]
    reward: Float[Array, "time agent"]
    cost: Float[Array, "time agent"]
    state: State  # leaves have a leading axis time + 1
    terminated: Bool[Array, "time"]  # the game ended at or before the end of this step
