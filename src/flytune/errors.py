"""The few exceptions a user can meet, each with the exit code of the command line."""


class FlytuneError(Exception):
    """Base of every error flytune raises on purpose; its text is one line for the user."""

    exit_code = 1


class BadInput(FlytuneError, ValueError):
    """What the user gave cannot be used; the text names the field, the value, what is allowed and the remedy."""

    exit_code = 2


class Diverged(FlytuneError, ArithmeticError):
    """Numbers stopped being finite, in training or in a controller; the text says what, where and when."""

    exit_code = 3


class Unmet(FlytuneError):
    """A tuning ended without meeting its requirement; the text says what is missing and why nothing could help."""

    exit_code = 4


class Interrupted(FlytuneError):
    """The user stopped a training; the text names the checkpoint that was saved."""

    exit_code = 130
