"""What a user reads who typed something that is not understood: one line with the option, the value and the remedy."""

import difflib
from collections.abc import Iterable
from typing import Literal, get_args, get_origin

from cyclopts import App, CoercionError, CycloptsError, MissingArgumentError, UnknownOptionError, UnusedCliTokensError
from cyclopts.exceptions import ConsumeMultipleError, UnknownCommandError

_NO_EDITS = "is no option of {}. Edits of a task belong to train, tune and show."


def refusal(error: CycloptsError) -> str:
    """The one line that says which option or command, which value, what is allowed and where to read on."""
    help_command = f"{' '.join(['flytune', *(error.command_chain or ())])} --help"
    return f"{_problem(error)} See: {help_command}"


def _problem(error: CycloptsError) -> str:
    option = error.argument.name if error.argument is not None else ""
    match error:
        case UnknownCommandError():
            typed = (error.unused_tokens or [""])[0]
            known = _commands(error.app)
            if typed.startswith("-"):
                return f"{typed}: there is no such option.{_hint(typed, ['--help', '--version'])}"
            return f"{typed!r}: there is no such command.{_hint(typed, known)} Allowed: {', '.join(known)}."
        case UnknownOptionError():
            typed = (error.token.keyword or error.token.value).partition("=")[0]
            names = [name for argument in error.argument_collection for name in argument.names if name[0] == "-"]
            if "--set" not in names and _nearest(typed, [*names, "--set"]) == "--set":
                return f"{typed}: {_NO_EDITS.format(' '.join(error.command_chain or ()))}"
            return f"{typed}: there is no such option.{_hint(typed, [*names, '--help'])}"
        case CoercionError():
            typed = error.token.value if error.token is not None else ""
            choices = get_args(error.target_type) if get_origin(error.target_type) is Literal else ()
            allowed = ", ".join(choices) or error.msg or "the option without a value"  # a converter says what it takes
            return f"{option}: {typed!r} is not allowed.{_hint(typed, choices)} Allowed: {allowed}."
        case MissingArgumentError() | ConsumeMultipleError() if error.argument is not None:
            parameter, hint = error.argument.parameter, error.argument.hint
            value = "|".join(get_args(hint)) if get_origin(hint) is Literal else parameter.metavar or "VALUE"
            wanted = f"{option} {value}" if option.startswith("-") else option
            return f"{option}: a value is missing. Give {wanted}: {(parameter.help or '').removesuffix(' ...')}."
        case UnusedCliTokensError():
            return _too_many(error)
    return str(error).replace("\n", " ")


def _too_many(error: UnusedCliTokensError) -> str:
    """The line about values that stand where none is expected: behind an option that takes one, or one too many."""
    unused, typed = error.unused_tokens or [""], error.root_input_tokens or []
    arguments = error.app.assemble_argument_collection() if error.app is not None else ()
    before = typed[: len(typed) - len(unused)] if typed[-len(unused) :] == unused else []
    option = next((each for each in arguments if before[-2:-1] and before[-2] in each.names), None)
    if option is not None and "," in (wanted := option.parameter.metavar or ""):
        one = ",".join([before[-1], *unused])
        example = f" Write {option.name} {one}." if one.count(",") == wanted.count(",") else ""
        return f"{option.name}: {len(unused) + 1} values are not allowed. Allowed: one, {wanted}.{example}"
    places = [each for each in arguments if each.index is not None]
    if not places:
        return f"{unused[0]!r}: a value is not expected here. {(error.command_chain or [''])[-1]} takes options alone."
    words = f"{places[0].name} stands" if places[0].token_count()[1] else f"One {places[0].name} is allowed,"
    several = " `flytune compare` takes several." if error.command_chain == ("evaluate",) else ""
    return f"{unused[0]!r}: a value is not expected here. {words} before the options.{several}"


def _commands(app: App | None) -> list[str]:
    return [] if app is None else [name for name in app if not name.startswith("-")]


def _nearest(typed: str, allowed: Iterable[str]) -> str | None:
    return next(iter(difflib.get_close_matches(typed, [str(value) for value in allowed], n=1, cutoff=0.6)), None)


def _hint(typed: str, allowed: Iterable[str]) -> str:
    near = _nearest(typed, allowed)
    return f" Did you mean {near}?" if near else ""
