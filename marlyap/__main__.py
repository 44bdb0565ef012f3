"""`python -m marlyap`."""

from marlyap.cli import program


if __name__ == "__main__":
    program()
