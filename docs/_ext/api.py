"""The reference of the Python interface: every public name of flytune, with the docstring that stands in the code."""

import inspect
import re
from typing import Any

from docutils import nodes
from docutils.statemachine import StringList
from sphinx.application import Sphinx
from sphinx.util.docutils import SphinxDirective

SECTION = re.compile(r"^(Args|Returns|Raises|Yields|Attributes|Source|Example|Examples|Note|Notes):$")


def as_restructured_text(lines: list[str]) -> list[str]:
    """A docstring in plain text as reStructuredText: signs are kept, and indented lines are shown as they stand."""
    result: list[str] = []
    literal = section = False
    for line in lines:
        if SECTION.match(line.strip()) and not line.startswith(" "):
            section, literal = True, False
        elif line and not line.startswith(" "):
            section = literal = False
        if line.startswith("    ") and not section and not literal and (not result or not result[-1].strip()):
            result += ["::", ""]
            literal = True
        result.append(line if literal else escaped(line))
    return result


def escaped(line: str) -> str:
    """A line whose stars and bars are no markup, outside of backticks."""
    parts = re.split(r"(`[^`]*`)", line)
    return "".join(
        part if part.startswith("`") else re.sub(r"([*|_])(?=\W|$)|(?<=\W)([*|])", r"\\\g<0>", part) for part in parts
    )


def process(app: Sphinx, what: str, name: str, thing: Any, options: Any, lines: list[str]) -> None:
    """Called by autodoc for each docstring, before napoleon reads it."""
    lines[:] = as_restructured_text(lines)


class PublicNames(SphinxDirective):
    """Every name of `flytune.__all__`, by its kind."""

    def run(self) -> list[nodes.Node]:
        """The functions, then the classes, then the errors."""
        import flytune

        things = {name: getattr(flytune, name) for name in flytune.__all__}
        errors = [name for name, thing in things.items() if inspect.isclass(thing) and issubclass(thing, Exception)]
        classes = [name for name, thing in things.items() if inspect.isclass(thing) and name not in errors]
        functions = [name for name, thing in things.items() if inspect.isroutine(thing)]
        found: list[nodes.Node] = []
        for title, names, directive in (
            ("Functions", functions, "autofunction"),
            ("Classes", classes, "autoclass"),
            ("Errors", errors, "autoexception"),
        ):
            section = nodes.section(ids=[title.lower()], names=[title.lower()])
            section += nodes.title(text=title)
            text = []
            for name in names:
                text += [f".. {directive}:: flytune.{name}"]
                text += ["   :members:", ""] if directive != "autofunction" else [""]
            section += self.rst(text)
            found.append(section)
        return found

    def rst(self, lines: list[str]) -> list[nodes.Node]:
        """The nodes of a text in reStructuredText."""
        container = nodes.Element()
        self.state.nested_parse(StringList(lines, source="flytune"), self.content_offset, container)
        return container.children


def setup(app: Sphinx) -> dict[str, bool]:
    """Registers the directive `public-names`."""
    app.add_directive("public-names", PublicNames)
    app.connect("autodoc-process-docstring", process, priority=400)
    return {"parallel_read_safe": True}
