"""`flytune` and `python -m flytune`, and what is said where a package is too old to be imported."""

import sys

from flytune.errors import BadInput, check_installed


def main() -> int:
    """The exit code of one command, see `flytune.cli.main.main`."""
    try:
        try:
            from flytune.cli.main import main as run

            return run()
        except Exception:
            check_installed()  # where a package is too old, this line says so instead of a traceback
            raise
    except BadInput as error:
        print(error, file=sys.stderr)
        return error.exit_code


if __name__ == "__main__":
    sys.exit(main())
