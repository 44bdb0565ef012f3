"""The linear-quadratic regulator of one cart, as if there were no springs."""

from marlyap.controllers.cart_feedback import CartFeedback


SINGLE = (2.384, 2.673, 14.857, 3.257)  # the discrete Riccati equation of one nominal cart solved


class CartLQR(CartFeedback):
    """a_i = k . (x, x', theta, theta') with the gains of the LQR of one cart, springs ignored.

    The cost is that of the game. It stabilises the coupled row all the same.
    """

    ends: tuple[float, ...] = SINGLE  # k of the two ends (1/m, s/m, 1, s)
    inside: tuple[float, ...] = SINGLE  # k of the others (1/m, s/m, 1, s)
