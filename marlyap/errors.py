"""What the user can mend, said in one sentence."""


class UserError(Exception):
    """Bad input. The message is one sentence that names the field and the mend.

    The command line prints it on standard error and exits with code 2, without a traceback.
    """
