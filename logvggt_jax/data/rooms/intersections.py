"""Where lines start + t way meet furniture: one arithmetic for the renderers in numpy and in JAX.

Points and ways are given by components, arrays or numbers each, about the thing's centre and along its axes.
"""

from collections.abc import Sequence
from typing import Any

from logvggt_jax.geometry.rotations import namespace


def chord(start: Sequence[Any], way: Sequence[Any], squared_radius: Any) -> tuple[Any, Any]:
    """Where lines are nearest to the centre of a circle or sphere, and how far before and behind that its edge lies.

    Both are values of t; the second is NaN for lines that pass it.
    """
    squared = sum(each * each for each in way)
    middle = -sum(each * along for each, along in zip(way, start, strict=True)) / squared
    # Distance of the line from the centre at its nearest point: no cancellation of large squares.
    nearest = [offset + middle * each for offset, each in zip(start, way, strict=True)]
    return middle, namespace(middle).sqrt((squared_radius - sum(each * each for each in nearest)) / squared)


def slab(start: Any, inverse_way: Any, half_size: Any) -> tuple[Any, Any]:
    """Where lines come between two parallel planes, `half_size` on each side of the centre, and where they leave them.

    All are along the planes' normal; `inverse_way` is 1 / way.
    """
    middle, reach = -start * inverse_way, half_size * abs(inverse_way)
    return middle - reach, middle + reach


def box(start: Sequence[Any], inverse_way: Sequence[Any], half_size: Sequence[Any]) -> tuple[list[Any], Any, Any]:
    """Where lines come between each pair of a box's faces, where they enter the box (the last of these) and leave it;
    those that pass it leave before they enter."""
    near, far = zip(*(slab(*each) for each in zip(start, inverse_way, half_size, strict=True)), strict=True)
    xp = namespace(near[0])
    return list(near), xp.maximum(xp.maximum(*near[:2]), near[2]), xp.minimum(xp.minimum(*far[:2]), far[2])
