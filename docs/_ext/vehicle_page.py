"""Of vehicles: a drawing of a layout, and the table of numbers with how to measure each, both from the data."""

import math
from html import escape

from docutils import nodes
from sphinx.application import Sphinx
from sphinx.util.docutils import SphinxDirective

SIDE, MARGIN = 260, 34  # of the drawing, in px


def drawing(name: str) -> str:
    """A vehicle from above as SVG, x up and y to the left: number, place and direction of turn of each rotor."""
    from flytune.physics.rotors import places, spins
    from flytune.physics.vehicle import load_vehicle

    vehicle = load_vehicle(name)
    rotors = places(vehicle)
    reach = abs(rotors).max() + vehicle.propeller_radius
    scale = (SIDE / 2 - MARGIN) / reach
    radius = vehicle.propeller_radius * scale
    parts = []
    for motor, ((x, y), spin) in enumerate(zip(rotors, spins(vehicle), strict=True)):
        across, down = -y * scale, -x * scale
        near = 1 - radius / math.hypot(across, down)  # an arm ends at the propeller's circle
        parts.append(f'<line x1="0" y1="0" x2="{near * across:.1f}" y2="{near * down:.1f}"/>')
        parts.append(f'<circle cx="{across:.1f}" cy="{down:.1f}" r="{radius:.1f}" opacity="0.5"/>')
        parts.append(_turn(across, down, radius, clockwise=spin > 0))
        parts.append(
            f'<text x="{across:.1f}" y="{down + 4:.1f}" stroke="none" fill="currentColor">{motor}: {spin:+d}</text>'
        )
    forward = f'<path d="M0 {-SIDE / 2 + 24} V{-SIDE / 2 + 6} m-4 6 l4 -6 l4 6"/>'
    return (
        f'<svg viewBox="{-SIDE / 2} {-SIDE / 2} {SIDE} {SIDE}" width="{SIDE}" role="img" fill="none" '
        f'stroke="currentColor" text-anchor="middle" font-size="12" aria-label="Rotors of {escape(name)} from above">'
        f'{forward}<text x="22" y="{-SIDE / 2 + 18}" stroke="none" fill="currentColor">x</text>{"".join(parts)}</svg>'
    )


def _turn(across: float, down: float, radius: float, *, clockwise: bool) -> str:
    """An arc with a head, from the right of a rotor over its top, or the other way."""
    way = 1 if clockwise else -1
    ends = [(across + radius * math.cos(angle) * -way, down - radius * math.sin(angle)) for angle in (0.5, 2.2)]
    (x0, y0), (x1, y1) = ends
    head = f"m{-7 * way:.0f} -3 l{7 * way:.0f} 3 l{-2 * way:.0f} -8"
    return (
        f'<path stroke-width="2" d="M{x0:.1f} {y0:.1f} A{radius:.1f} {radius:.1f} 0 0 {int(clockwise)} '
        f'{x1:.1f} {y1:.1f} {head}"/>'
    )


class Layout(SphinxDirective):
    """The drawing of each vehicle that is named."""

    required_arguments = 1
    final_argument_whitespace = True

    def run(self) -> list[nodes.Node]:
        """A figure for each name."""
        figures = "".join(
            f'<figure style="display: inline-block; margin: 0 1em 1em 0">{drawing(name)}'
            f'<figcaption style="text-align: center">{escape(name)}</figcaption></figure>'
            for name in self.arguments[0].split()
        )
        return [nodes.raw(text=figures, format="html")]


class Measuring(SphinxDirective):
    """A table of the numbers of a vehicle: unit, and how to measure each."""

    def run(self) -> list[nodes.Node]:
        """The table, from what `flytune vehicle` says of a number that is missing."""
        from flytune.config.fields import annotations, unit_text
        from flytune.physics.found_vehicle import TO_MEASURE
        from flytune.physics.vehicle import Vehicle

        known = annotations(Vehicle)
        rows = [
            f"| `{name}` | {unit_text(known[name]) if name in known else ''} | {how.replace('|', chr(92) + '|')} |"
            for name, how in TO_MEASURE.items()
        ]
        text = "\n".join(["| number | unit | how to measure or look it up |", "|---|---|---|", *rows])
        return self.parse_text_to_nodes(text)


def setup(app: Sphinx) -> dict[str, bool]:
    """Registers the directives `rotor-layout` and `vehicle-numbers`."""
    app.add_directive("rotor-layout", Layout)
    app.add_directive("vehicle-numbers", Measuring)
    return {"parallel_read_safe": True}
