"""Columns of packed arrays. A launch pays up to 6 µs for each array, so kernels receive few arrays of many columns."""

from itertools import accumulate

# Numbers of a value: of a point in an image, a vector, a twist or a wrench, and a 3×4 transform, row by row.
SCALAR, PAIR, VECTOR, SPATIAL, TRANSFORM = 1, 2, 3, 6, 12


def columns(*widths: int) -> tuple[int, ...]:
    """Return the first column of each value of a packed row, and then the number of all columns."""
    return tuple(accumulate(widths, initial=0))
