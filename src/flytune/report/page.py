"""Pages: one HTML file that carries its style, its scripts and its data, and loads nothing.

A page is a template in `templates/` that extends `page.html` and fills its blocks `title` and `body`:

    {% extends "page.html" %}
    {% from "parts.html" import figure, contents, definitions %}
    {% block title %}{{ name }}{% endblock %}
    {% block body %}
    <h1>{{ name }}</h1>
    {{ table }}
    {% call figure(plot) %}What to look at in it.{% endcall %}
    {% endblock %}

    write_page(path, "my_page.html", name=name, table=Table(...), plot=go.Figure(...))

Every text that is given is escaped; a `flytune.tables.Table` writes itself as HTML; a figure may be a sentence instead,
which says why there is nothing to draw. Captions live in the templates. Styles and scripts are in `assets/`.
"""

import base64
import functools
import gzip
import hashlib
from importlib import resources
from pathlib import Path
from typing import Any

import jinja2
from markupsafe import Markup
from plotly.offline import get_plotlyjs

from flytune.config import files
from flytune.kernels import native


def page_mark(template: str) -> bytes:
    """What every page of a template contains near its beginning."""
    return f'content="flytune {Path(template).stem}"'.encode()


def write_page(path: Path, template: str, **values: Any) -> None:
    """Write a page, whole or not at all; an earlier file is replaced.

    Raises:
        BadInput: the file cannot be written.
    """
    files.check_file(path)
    files.write_text(path, render(template, **values))


def render(template: str, **values: Any) -> str:
    """The page that a template of `templates/` makes of the values."""
    return _environment().get_template(template).render(kind=Path(template).stem, **values)


@functools.cache
def _environment() -> jinja2.Environment:
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("flytune.report"),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.globals.update(asset=_asset, plotly=_packed_plotly)
    environment.filters["packed"] = lambda plot: pack(plot.to_json(validate=False))
    environment.filters["base64"] = lambda text: base64.b64encode(text.encode()).decode()
    environment.tests["in_space"] = lambda plot: any(trace.type == "scatter3d" for trace in plot.data)
    return environment


@functools.cache
def _asset(name: str) -> Markup:
    """A file of `assets/`, which is ours and needs no escaping."""
    return Markup((resources.files("flytune.report") / "assets" / name).read_text(encoding="utf-8"))


@functools.cache
def _packed_plotly() -> str:
    """The script of plotly, packed; kept beside the compiled programs, since to pack it takes a third of a second."""
    script = get_plotlyjs()
    folder = native.cache_folder()
    if folder is None:
        return pack(script)
    place = folder / f"page-{hashlib.sha256(script.encode()).hexdigest()[:40]}"
    if (known := native.kept(place)) is not None:
        return known.decode()
    packed = pack(script)
    native.keep(place, packed.encode())
    return packed


def pack(text: str) -> str:
    """A text, compressed, in characters that need no escaping in HTML; `page.js` unpacks it."""
    return base64.b64encode(gzip.compress(text.encode(), mtime=0)).decode()
