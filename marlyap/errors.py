"""What the user can mend, said in one sentence."""


class UserError(Exception):
    """Bad input. The message is one sentence that names the field and the mend.

    The command line prints it on standard error and exits with code 2, without a traceback. It is
    one line whatever was quoted in it, and nothing in it moves a terminal's cursor.
    """

    def __str__(self) -> str:
        visible = "".join(c if c.isprintable() else " " for c in super().__str__())
        return " ".join(visible.split())


def within(
    name: str, value: float | int, low: float | int, high: float | int, open: bool = False
) -> None:
    """Raise UserError unless low <= value <= high; `open` leaves `low` itself out."""
    if not (low < value if open else low <= value) or not value <= high:
        least = f"more than {low:g}" if open else f"{low:g}"
        raise UserError(f"{name}: {value} is out of range; take {least} to {high:g}.")
