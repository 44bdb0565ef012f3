"""Lloyd's algorithm: each robot drives to the centre of its own Voronoi cell."""

from marlyap.controllers.controller import AbstractController, as_action
from marlyap.tasks.coverage import Coverage, Wheels


class Lloyd(AbstractController):
    """Lloyd's law u_i = gain (C_i - p_i) / dt, C_i the centre of the cell among those that i sees.

    The mean squared distance to the nearest robot falls in every step: Lloyd, IEEE Trans.
    Information Theory 28(2), 1982; Cortes et al., IEEE Trans. Robotics and Automation 20(2), 2004.
    """

    drives = (Wheels,)

    game: Coverage
    gain: float = 1.0

    def __call__(self, state, key):
        centres = self.game.centres(state, self.game.linked(state))
        return as_action(self.game, self.gain * (centres - state.x) / self.game.dt)
