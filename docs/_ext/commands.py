"""The reference of the command line: what each command prints when it is asked for help, at the time of the build."""

import os
import re
import subprocess
import sys

from docutils import nodes
from sphinx.application import Sphinx
from sphinx.util.docutils import SphinxDirective


def help_of(*command: str) -> str:
    """The help text of `flytune COMMAND`."""
    settings = {"COLUMNS": "88", "LINES": "1000", "NO_COLOR": "1", "TERM": "dumb", "PYTHONUTF8": "1"}
    answer = subprocess.run(
        [sys.executable, "-m", "flytune", *command, "--help"],
        env={**os.environ, **settings},
        capture_output=True,
        text=True,
        check=True,
    )
    return re.sub(r"\x1b\[[0-9;]*m", "", answer.stdout).rstrip()


class Commands(SphinxDirective):
    """A section for each command, with its help."""

    def run(self) -> list[nodes.Node]:
        """The help of `flytune`, and a section for each command."""
        overview = help_of()
        found: list[nodes.Node] = [nodes.literal_block(text=overview, language="text")]
        for name in re.findall(r"^[│ ]{1,4}([a-z][a-z-]+) {2,}\S", overview, flags=re.MULTILINE):
            section = nodes.section(ids=[name], names=[name])
            section += nodes.title(text=f"flytune {name}")
            section += nodes.literal_block(text=help_of(name), language="text")
            found.append(section)
        return found


def setup(app: Sphinx) -> dict[str, bool]:
    """Registers the directive `commands`."""
    app.add_directive("commands", Commands)
    return {"parallel_read_safe": True}
