"""What there is to see of a state, as plain shapes: matplotlib draws figures and films from them, a browser's canvas clips.

Places and lengths are in the environment's own units. A colour is a role, such as "agent" or "wall", to which whoever draws
gives a colour of its palette, or any colour that CSS and matplotlib both know, such as "#2f9e78". Shapes lie over one another in
their order.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable
from typing import Any, ClassVar


@dataclasses.dataclass(frozen=True)
class Rectangle:
    """A filled rectangle around (x, y), turned by `angle` from the x axis towards the y axis."""

    kind: ClassVar[str] = "rectangle"
    x: float  # of the centre
    y: float
    width: float
    height: float
    colour: str
    angle: float = 0.0  # rad
    outline: str | None = None  # colour of its edge


@dataclasses.dataclass(frozen=True)
class Circle:
    """A filled circle around (x, y)."""

    kind: ClassVar[str] = "circle"
    x: float
    y: float
    radius: float
    colour: str
    outline: str | None = None  # colour of its edge


@dataclasses.dataclass(frozen=True)
class Polyline:
    """Points joined by straight lines."""

    kind: ClassVar[str] = "polyline"
    points: tuple[tuple[float, float], ...]
    colour: str


@dataclasses.dataclass(frozen=True)
class Text:
    """A short text, centred at (x, y)."""

    kind: ClassVar[str] = "text"
    x: float
    y: float
    text: str
    colour: str = "ink"


Shape = Rectangle | Circle | Polyline | Text


@dataclasses.dataclass(frozen=True)
class Scene:
    """Shapes, and the part of the environment that is in view."""

    shapes: tuple[Shape, ...]
    extent: tuple[float, float, float, float]  # least and largest x, least and largest y in view
    y_down: bool = False  # whether y grows downwards
    background: str = "floor"  # colour where there is no shape

    def as_dict(self) -> dict[str, Any]:
        """The scene as JSON knows it; every shape says its `kind`."""
        shapes = [{"kind": shape.kind} | dataclasses.asdict(shape) for shape in self.shapes]
        return dataclasses.asdict(self) | {"shapes": shapes}


def area(bounds: Iterable[float], colour: str) -> Rectangle:
    """The rectangle from (x0, y0) to (x1, y1) of `bounds` (x0, y0, x1, y1)."""
    x0, y0, x1, y1 = (float(bound) for bound in bounds)
    return Rectangle((x0 + x1) / 2, (y0 + y1) / 2, x1 - x0, y1 - y0, colour)
