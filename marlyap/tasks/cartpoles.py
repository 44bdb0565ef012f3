"""Cart-poles: inverted pendulums on carts in a row, coupled by springs and dampers."""

from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from marlyap.errors import UserError, check_range
from marlyap.games.game import AbstractRegulation, Tolerance
from marlyap.games.physics import AbstractPlant, Integrator
from marlyap.games.sensing import beside, beside_entries
from marlyap.types import Entry, Scalar, Scene, State


class Row(eqx.Module):
    """The scenario: what this episode's row of carts is like."""

    stiffness: Scalar  # of the springs and dampers, in multiples of the plant's
    push: Float[Array, "agent"]  # force on each cart while it lasts (N)
    begins: Scalar  # when the push begins (s)


class CartPoleRow(AbstractPlant):
    """Carts in a row, each with a pole, and springs and dampers between neighbouring carts.

    With F_i = u_i + k (x_{i-1} - 2 x_i + x_{i+1}) + b (x'_{i-1} - 2 x'_i + x'_{i+1}) (one term
    less at the ends), m = m_c + m_p and half the length l of a pole,

        p = (F + m_p l theta'^2 sin theta) / m,
        theta'' = (g sin theta - p cos theta) / (l (4/3 - m_p cos^2 theta / m)),
        x'' = p - m_p l theta'' cos theta / m.

    Cart and pole: Barto, Sutton and Anderson, IEEE Trans. Systems, Man and Cybernetics 13(5), 1983,
    with the constants that became usual. Coupled pendulums are the classic plant of decentralised
    control (Siljak, Decentralized Control of Complex Systems, 1991). The springs act where the
    motors do, so feedback of its own state can stabilise each cart.
    """

    limits: tuple[float, ...] = (10.0,)  # largest force of a motor (N)
    integrator: Integrator = "euler"
    spring: float = 5.0  # k, between neighbouring carts (N/m)
    damper: float = 0.5  # b, between neighbouring carts (N s/m)
    cart: float = 1.0  # m_c (kg)
    pole: float = 0.1  # m_p (kg)
    half: float = 0.5  # l, half the length of a pole (m)
    gravity: float = 9.8  # g (m/s^2)
    push_lasts: float = 0.1  # how long a push lasts (s)
    states: ClassVar[tuple[Entry, ...]] = (
        Entry("displacement of the cart", "m"),
        Entry("velocity of the cart", "m/s"),
        Entry("angle of the pole", "rad"),
        Entry("angular velocity of the pole", "rad/s"),
    )
    inputs: ClassVar[tuple[Entry, ...]] = (Entry("force on the cart", "N"),)
    blocks: ClassVar[tuple[tuple[int, ...], ...]] = ((1, 3), (0, 2))

    def __check_init__(self):
        for name in ("spring", "damper", "push_lasts"):
            check_range(name, getattr(self, name), 0, 1e6)
        for name in ("cart", "pole", "half", "gravity"):
            check_range(name, getattr(self, name), 0, 1e6, open=True)

    def field(self, x, u, scenario, time):
        place, speed, angle, rate = x[:, 0], x[:, 1], x[:, 2], x[:, 3]
        pushed = (time >= scenario.begins) & (time < scenario.begins + self.push_lasts)
        coupling = self.spring * pull(place) + self.damper * pull(speed)
        force = u[:, 0] + scenario.stiffness * coupling + jnp.where(pushed, scenario.push, 0.0)
        mass, sin, cos = self.cart + self.pole, jnp.sin(angle), jnp.cos(angle)
        p = (force + self.pole * self.half * rate**2 * sin) / mass
        turn = (self.gravity * sin - p * cos) / (self.half * (4 / 3 - self.pole * cos**2 / mass))
        return jnp.stack([speed, p - self.pole * self.half * turn * cos / mass, rate, turn], axis=1)


def pull(values: Float[Array, "agent"]) -> Float[Array, "agent"]:
    """The sum over those beside i of their value minus that of i."""
    gap = jnp.diff(values, prepend=values[:1], append=values[-1:])
    return gap[1:] - gap[:-1]


class CartPoles(AbstractRegulation):
    """Carts in a row, coupled by springs, keep their poles upright, each cart at its own place.

    Unstable without control: by a factor 1.08 a step. The cost of an agent is x^2 + 0.1 x'^2
    + 10 theta^2 + 0.1 theta'^2 + 0.1 a^2. The team fails when a cart is farther than `most_place`
    from its place or a pole leans by more than `most_angle`.
    """

    agents: int = 5  # N
    graph: str = "path"  # who sees whom; the springs join neighbouring carts whatever it is
    plant: CartPoleRow = CartPoleRow()  # pyright: ignore
    place: float = 0.05  # a cart within this of its place has arrived (m)
    angle: float = 0.02  # so has a pole that leans by no more (rad)
    most_place: float = 2.4  # beyond it the team has failed (m)
    most_angle: float = 0.20943951023931953  # 12 degrees; beyond it the team has failed (rad)
    weights: tuple[float, ...] = (1.0, 0.1, 10.0, 0.1)  # of the squared errors in the cost
    effort: float = 0.1  # weight of the squared action in the cost
    start_place: float = 0.4  # starts are uniform up to this far from a cart's place (m)
    start_angle: float = 0.08  # and up to this angle (rad)
    start_rate: float = 0.05  # and up to these rates (m/s and rad/s)
    stiffness_spread: float = 0.0  # springs are drawn anew in an episode, up to this share off
    push: float = 0.0  # largest push on each cart, at a random time of an episode (N)
    spacing: float = 1.5  # between the carts' places (m)
    dt: float = 0.02  # s
    horizon: int = 500  # steps in an episode

    def __check_init__(self):
        for name in ("place", "angle", "most_place", "most_angle", "spacing"):
            check_range(name, getattr(self, name), 0, 1e6, open=True)
        for name in ("effort", "start_place", "start_angle", "start_rate", "push"):
            check_range(name, getattr(self, name), 0, 1e6)
        check_range("stiffness_spread", self.stiffness_spread, 0, 1)
        check_weights(self.weights, 4)

    @property
    def tolerances(self):
        most = self.place, float("inf"), self.angle, float("inf")
        pairs = zip(self.plant.states, most, strict=True)
        return tuple(Tolerance(e.name, e.unit, m, e.frame) for e, m in pairs)

    def reset(self, key):
        k_x, k_row, k_push = jax.random.split(key, 3)
        most = jnp.array([self.start_place, self.start_rate, self.start_angle, self.start_rate])
        x = most[None] * jax.random.uniform(k_x, (self.agents, 4), minval=-1.0)
        off = jax.random.uniform(k_row, (2,), minval=jnp.array([-1.0, 0.0]))
        row = Row(
            stiffness=1 + self.stiffness_spread * off[0],
            push=self.push * jax.random.uniform(k_push, (self.agents,), minval=-1.0),
            begins=off[1] * self.horizon * self.dt,
        )
        return State(x=x, scenario=row, t=jnp.asarray(0))

    def observe(self, state, links):
        """Its own state, and the place and velocity of each neighbour against its own."""
        gap = state.x[None, :, :2] - state.x[:, None, :2]
        return beside(state.x, gap, jnp.asarray(self.slots), links)

    def observation_entries(self):
        seen = (
            Entry("displacement of {j} - own displacement", "m"),
            Entry("velocity of {j} - own velocity", "m/s"),
        )
        return beside_entries(self.plant.states, seen, self.slots.shape[1])

    def errors(self, state):
        return state.x

    def costs(self, state, action):
        effort = jnp.sum(jnp.clip(action, -1.0, 1.0) ** 2, axis=1)
        return self.errors(state) ** 2 @ jnp.asarray(self.weights) + self.effort * effort

    def failed(self, state):
        place, angle = jnp.abs(state.x[:, 0]), jnp.abs(state.x[:, 2])
        return ~jnp.all((place <= self.most_place) & (angle <= self.most_angle))

    @property
    def edge_cost(self):
        return max(self.weights[0] * self.place**2, self.weights[2] * self.angle**2)

    @property
    def failure_cost(self):
        return 10.0

    def at_target(self, state):
        return eqx.tree_at(lambda s: s.x, state, jnp.zeros_like(state.x))

    def scene(self, state):
        """The carts on their track, and then the tips of their poles."""
        place, speed, angle, rate = state.x.T
        goal = self.spacing * (jnp.arange(self.agents) - (self.agents - 1) / 2)
        cart, length = goal + place, 2 * self.plant.half
        tip = cart + length * jnp.sin(angle), length * jnp.cos(angle)
        swing = length * rate
        tip_speed = speed + swing * jnp.cos(angle), -swing * jnp.sin(angle)
        rows = lambda x, y: jnp.stack([x, y], axis=1)
        still = jnp.zeros(self.agents)
        return Scene(
            position=jnp.concatenate([rows(cart, still), rows(*tip)]),
            velocity=jnp.concatenate([rows(speed, still), rows(*tip_speed)]),
            goal=rows(goal, still),
            spin=jnp.concatenate([rate, rate]),  # of an agent, its pole's
            rods=tuple((i, self.agents + i) for i in range(self.agents)),
        )

    def state_shapes(self, state):
        return super().state_shapes(state) | {"x": (state.x, (self.agents, 4))}


def check_weights(weights: tuple[float, ...], errors: int, name: str = "weights") -> None:
    """Raise UserError unless there is a weight >= 0 for each error."""
    if len(weights) != errors or not all(0 <= w < 1e6 for w in weights):
        raise UserError(f"{name}: {weights} must be {errors} numbers, each 0 or more.")
