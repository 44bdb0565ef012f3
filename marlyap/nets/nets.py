"""The function approximators pi_phi, Q_theta and L_psi, each written for one sample."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from marlyap.nets.layout import batch_last, broadcast, matmul, rows_as_columns, total
from marlyap.simulation.rollout import AbstractExplorer
from marlyap.types import Action, Features, Key, Obs, Scalar


class Shape(NamedTuple):
    """All that a learning rule may know of a game before it has seen a transition."""

    agents: int
    obs: int
    features: int
    errors: int  # how many leading features are zero exactly on the target set
    du: int
    kinds: tuple[int, ...] = ()  # of each agent: those of one kind may share weights; (): all alike
    inputs: tuple[int, ...] = ()  # of each agent: the first so many of du actions count; (): all


EPS = 1e-5  # of LayerNorm


class Layer(eqx.Module):
    """x -> W x + b, initialised uniformly in +- 1/sqrt(in); then LayerNorm's gain and offset."""

    weight: Float[Array, "out in"]
    bias: Float[Array, "out"]
    norm: tuple[Float[Array, "out"], Float[Array, "out"]] | None

    def __init__(self, size_in: int, size_out: int, normalise: bool, *, key: Key):
        k_weight, k_bias = jax.random.split(key)
        draw = lambda k, shape: jax.random.uniform(k, shape, minval=-1.0, maxval=1.0)
        self.weight = draw(k_weight, (size_out, size_in)) / size_in**0.5
        self.bias = draw(k_bias, (size_out,)) / size_in**0.5
        self.norm = (jnp.ones(size_out), jnp.zeros(size_out)) if normalise else None

    def __call__(self, x: Float[Array, "*stack in batch"]) -> Float[Array, "*nets out batch"]:
        if self.norm is None:
            return matmul(self.weight, x) + self.bias[..., None]
        # The mean over outputs that LayerNorm subtracts is linear in W and b: take it there.
        centred = lambda a, axis: a - jnp.mean(a, axis=axis, keepdims=True)
        y = matmul(centred(self.weight, -2), x) + centred(self.bias, -1)[..., None]
        scale = jax.lax.rsqrt(total(y * y) / y.shape[-2] + EPS)
        gain, offset = self.norm
        return y * broadcast(scale, y.shape[-2]) * gain[..., None] + offset[..., None]

    def lipschitz(self) -> Scalar:
        """An upper bound: the spectral norm of W, and what LayerNorm may stretch next to 0."""
        norm = jnp.linalg.norm(self.weight, ord=2)
        return norm if self.norm is None else norm * jnp.max(jnp.abs(self.norm[0])) / EPS**0.5


class MLP(eqx.Module):
    """ReLU layers, with LayerNorm before each ReLU where asked; linear at the end."""

    layers: tuple[Layer, ...]

    def __init__(self, sizes: tuple[int, ...], normalise: bool = False, *, key: Key):
        keys = jax.random.split(key, len(sizes) - 1)
        last = len(sizes) - 2
        self.layers = tuple(
            Layer(sizes[i], sizes[i + 1], normalise and i < last, key=k) for i, k in enumerate(keys)
        )

    def __call__(self, x: Float[Array, "in"]) -> Float[Array, "out"]:
        return _apply(self, x[:, None])[:, 0]


def _forward(net: MLP, x: Float[Array, "*stack in batch"]) -> Float[Array, "*nets out batch"]:
    for layer in net.layers[:-1]:
        x = jax.nn.relu(layer(x))
    return net.layers[-1](x)


_apply = batch_last(_forward)
_apply_to_rows = batch_last(rows_as_columns(_forward))  # one net for every row of x


class Sample(NamedTuple):
    """a ~ pi(. | o), log pi_i(a_i | o_i), and the same for the action in the memory."""

    action: Action
    log_prob: Float[Array, "agent"]
    log_prob_memory: Float[Array, "agent"]


class Actors(eqx.Module):
    """pi_phi = {pi_phi_1, ..., pi_phi_N}: a Gaussian squashed by tanh for every agent.

    Agent i's action is made of row i of the observations alone. Weights are each agent's own, or
    shared by all, which serves any number of agents, or shared by those of one kind.
    """

    net: MLP  # leaves have a leading axis `agent`, or `kind`; none where all share
    shared: bool | tuple[int, ...]  # the kind of each agent where those of one kind share
    du: int | tuple[int, ...]  # actions of every agent, or of each: those beyond them are 0

    def __init__(self, shape: Shape, width: int, shared: bool = False, *, key: Key):
        make = lambda k: MLP((shape.obs, width, width, 2 * shape.du), key=k)
        several = lambda n: eqx.filter_vmap(make)(jax.random.split(key, n))
        self.shared = shape.kinds if shared and len({*shape.kinds}) > 1 else shared
        if isinstance(self.shared, tuple):
            self.net = several(1 + max(self.shared))
        else:
            self.net = make(key) if shared else several(shape.agents)
        self.du = shape.inputs or shape.du

    @property
    def each(self) -> MLP:
        """The weights of each agent; one set where all share it."""
        if isinstance(self.shared, bool):
            return self.net
        return jax.tree.map(lambda leaf: leaf[jnp.array(self.shared)], self.net)

    def sample(self, obs: Obs, noise: Action, memory: Action) -> Sample:
        """tanh(mean + std * noise) for standard normal noise: reparametrised."""
        per_agent = _squashed_rows if self.shared is True else eqx.filter_vmap(_squashed)
        column = lambda x: x[..., None]
        masks = (column(mask),) if (mask := self.mask) is not None else ()
        out = per_agent(self.each, (column(obs), column(noise), column(memory), *masks))
        return Sample(out[0][..., 0], out[1][..., 0, 0], out[2][..., 0, 0])

    def mode(self, obs: Obs) -> Action:
        """The deterministic policy that is evaluated, certified and deployed."""
        per_agent = _apply_to_rows if self.shared is True else eqx.filter_vmap(_apply)
        mean = jnp.split(per_agent(self.each, obs[..., None])[..., 0], 2, axis=-1)[0]
        return self.within(jnp.tanh(mean))

    @property
    def width(self) -> int:
        """Actions in a row: of the agent that has most."""
        return self.du if isinstance(self.du, int) else max(self.du)

    @property
    def mask(self) -> Action | None:
        """1 where an action counts, 0 where it is there because another agent has more."""
        if isinstance(self.du, int):
            return None
        return jnp.asarray([[float(k < n) for k in range(self.width)] for n in self.du])

    def within(self, action: Action) -> Action:
        """The same, 0 where it does not count."""
        return action if (mask := self.mask) is None else action * mask


def _squash(net: MLP, x: tuple[Array, ...]) -> tuple[Array, Array, Array]:
    """(obs, noise, memory) [*stack, ., batch] -> (action, log pi of it, log pi of memory).

    A fourth array says which actions count; the others are 0 and have no part in log pi.
    """
    obs, noise, memory, *masks = x
    counted = lambda y: y * masks[0] if masks else y
    mean, log_std = jnp.split(_forward(net, obs), 2, axis=-2)
    log_std = jnp.clip(log_std, -5.0, 2.0)

    def log_prob(u, z):
        log_normal = -0.5 * z**2 - log_std - 0.5 * jnp.log(2 * jnp.pi)
        log_squash = 2 * (jnp.log(2.0) - u - jax.nn.softplus(-2 * u))  # log(1 - tanh(u)^2)
        return total(counted(log_normal - log_squash))

    u = mean + jnp.exp(log_std) * noise
    past = jnp.arctanh(jnp.clip(memory, -1 + 1e-6, 1 - 1e-6))
    return (
        counted(jnp.tanh(u)),
        log_prob(u, noise),
        log_prob(past, (past - mean) * jnp.exp(-log_std)),
    )


_squashed = batch_last(_squash)
_squashed_rows = batch_last(rows_as_columns(_squash))


class Sampled(AbstractExplorer):
    """The policy that explores."""

    pi: Actors

    def __call__(self, obs: Obs, key: Key) -> Action:
        noise = jax.random.normal(key, (obs.shape[0], self.pi.width))
        return self.pi.sample(obs, noise, noise).action

    def log_prob(self, obs: Obs, action: Action) -> Float[Array, "agent"]:
        return self.pi.sample(obs, action, action).log_prob_memory


class Noisy(AbstractExplorer):
    """The deterministic policy with Gaussian noise added, clipped to what can be done."""

    pi: Actors
    std: Scalar | float

    def __call__(self, obs: Obs, key: Key) -> Action:
        mode = self.pi.mode(obs)
        return jnp.clip(mode + self.std * jax.random.normal(key, mode.shape), -1.0, 1.0)

    def log_prob(self, obs: Obs, action: Action) -> Float[Array, "agent"]:
        """The density of the noise, as if it had not been clipped."""
        noise = (action - self.pi.mode(obs)) / self.std
        return jnp.sum(-0.5 * noise**2 - jnp.log(self.std) - 0.5 * jnp.log(2 * jnp.pi), axis=1)


class Greedy(eqx.Module):
    """The policy that is deployed."""

    pi: Actors

    def __call__(self, obs: Obs, key: Key) -> Action:
        return self.pi.mode(obs)


class Critic(eqx.Module):
    """Q_theta^1 and Q_theta^2 of (s, a): central, twin; one value for the team or one an agent."""

    nets: MLP  # leaves have a leading axis `twin`

    def __init__(
        self, shape: Shape, width: int, heads: int, normalise: bool, twins: int = 2, *, key: Key
    ):
        size = shape.agents * (shape.features + shape.du)
        make = lambda k: MLP((size, width, width, heads), normalise, key=k)
        self.nets = eqx.filter_vmap(make)(jax.random.split(key, twins))

    def __call__(self, features: Features, action: Action) -> Float[Array, "twin head"]:
        x = jnp.concatenate([features.ravel(), action.ravel()])
        return eqx.filter_vmap(lambda net: net(x))(self.nets)


class MeanFieldCritic(eqx.Module):
    """Q of agent i's own state and action and the mean of the others' (Yang et al. 2018), twin.

    One net for all agents: neither its weights nor an agent's share of the work grow with their
    number, and to exchange two agents exchanges their values. The mean over agents is the team's.
    """

    nets: MLP  # leaves have a leading axis of 2
    team: bool

    def __init__(self, shape: Shape, width: int, team: bool, normalise: bool, *, key: Key):
        size = 2 * (shape.features + shape.du)
        make = lambda k: MLP((size, width, width, 1), normalise, key=k)
        self.nets = eqx.filter_vmap(make)(jax.random.split(key, 2))
        self.team = team

    def __call__(self, features: Features, action: Action) -> Float[Array, "twin head"]:
        own = jnp.concatenate([features, action], axis=1)
        others = jnp.sum(own, axis=0, keepdims=True) - own
        x = jnp.concatenate([own, others / max(own.shape[0] - 1, 1)], axis=1)
        each = eqx.filter_vmap(lambda net: _apply_to_rows(net, x[..., None])[:, 0, 0])(self.nets)
        return jnp.mean(each, axis=1, keepdims=True) if self.team else each


class LyapunovNet(eqx.Module):
    """L_psi(s, a) >= 0: layers of 64, 64 and 16 (section 4); the squares of the last sum to L."""

    net: MLP

    def __init__(self, shape: Shape, normalise: bool = False, *, key: Key):
        size = shape.agents * (shape.features + shape.du)
        self.net = MLP((size, 64, 64, 16), normalise, key=key)

    def __call__(self, features: Features, action: Action) -> Scalar:
        out = self.net(jnp.concatenate([features.ravel(), action.ravel()]))
        return jnp.sum(jax.nn.relu(out) ** 2)


class NormNet(eqx.Module):
    """V(s) = ||Phi(e) - Phi(0)|| + slope ||e||, where e is zero exactly on the target set.

    So V is 0 on the target set, positive elsewhere whatever the weights, and its Lipschitz
    constant in e is at most the product of the layers' constants plus `slope`.
    """

    net: MLP
    errors: int  # how many leading features make up e
    slope: float = 0.1

    def __init__(self, shape: Shape, normalise: bool = False, *, key: Key):
        self.net = MLP((shape.agents * shape.errors, 64, 64, 16), normalise, key=key)
        self.errors = shape.errors

    def __call__(self, features: Features, action: Action | None = None) -> Scalar:
        e = features[:, : self.errors].ravel()
        at_zero = _forward(self.net, jnp.zeros((e.shape[0], 1)))[:, 0]  # one for the whole batch
        change = jnp.where(jnp.any(e != 0), self.net(e) - at_zero, 0.0)  # 0 to the last bit at 0
        return _norm(change) + self.slope * _norm(e)

    def lipschitz(self) -> Scalar:
        """An upper bound on |V(s) - V(s')| / ||e - e'||."""
        bounds = [layer.lipschitz() for layer in self.net.layers]
        return jnp.prod(jnp.stack(bounds)) + self.slope


def _norm(x: Float[Array, "n"]) -> Scalar:
    """||x||, with a gradient of 0 at 0."""
    square = jnp.sum(x * x)
    return jnp.where(square > 0, jnp.sqrt(jnp.where(square > 0, square, 1.0)), 0.0)
