"""The cascaded law of gradient consensus and tree pursuit: error, then speeds, then inputs."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from marlyap.controllers.controller import Robots, left


class Cascade(eqx.Module):
    """Drive one unicycle to the point e metres away, forwards or in reverse.

    With e_h = e.h ahead and e_n = e.n to the left, theta = atan2(sgn(e_h) e_n, |e_h|) is the angle
    between the axis of the agent and the line to the point, and

        v_d = S(e_h, near, a_max) cos(theta)^alignment,      a = k_a (v_d - v),
        w_d = S(theta, near_angle, r_max),                   r = k_r (w_d - w),
        S(gap, near, limit) = sgn(gap) min(sqrt(limit / near) |gap|, sqrt(2 braking limit |gap|)).

    The second root is the largest speed from which the share `braking` of the limit still stops
    in time; both roots grow as sqrt(limit), so one set of gains serves all limits. No loop is
    faster than one step, 1/dt. After Dimarogonas and Kyriakopoulos, IEEE Trans. Automatic Control
    52(5), 2007; the roots and the power of cos(theta), 0 in the plain law, are added here. The law
    jumps at e = 0, as it must to converge fast, so w_d fades out within `calm` metres.
    """

    near: float = 0.125  # distance below which the speed is proportional to it (m)
    near_angle: float = 0.045  # angle below which the turn rate is proportional to it (rad)
    k_a: float = 10.0  # speed loop (1/s)
    k_r: float = 9.0  # turn rate loop (1/s)
    braking: float = 0.7  # share of the limits that the desired speeds count on
    alignment: float = 2.4  # how strongly to turn before driving; 0 is the plain law
    calm: float = 0.005  # distance within which the heading no longer matters (m)

    def __call__(
        self, game: Robots, x: Float[Array, "dx"], e: Float[Array, "2"]
    ) -> Float[Array, "du"]:
        """Inputs a (m/s^2) and r (rad/s^2) for the state x, not yet clipped to the limits."""
        (a_max, r_max), fastest = game.dynamics.limits, 1 / game.dt
        h = game.dynamics.heading(x)
        ahead, aside, far = jnp.dot(e, h), jnp.dot(e, left(h)), jnp.linalg.norm(e)
        theta = jnp.arctan2(jnp.where(ahead < 0, -aside, aside), jnp.abs(ahead))
        turned = jnp.maximum(jnp.cos(theta), 0.0) ** self.alignment
        v_d = self._speed(ahead, self.near, a_max, fastest) * turned
        w_d = self._speed(theta, self.near_angle, r_max, fastest) * jnp.clip(far / self.calm, max=1)
        a = jnp.minimum(self.k_a, fastest) * (v_d - x[3])
        r = jnp.minimum(self.k_r, fastest) * (w_d - x[4])
        return jnp.stack([a, r])

    def _speed(self, gap, near, limit, fastest):
        gain = jnp.minimum(jnp.sqrt(limit / near), fastest)
        stoppable = jnp.sqrt(2 * self.braking * limit * jnp.abs(gap))
        return jnp.sign(gap) * jnp.minimum(gain * jnp.abs(gap), stoppable)
