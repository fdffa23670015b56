"""Errors of the solver.

    SolverError                 base: catch this one
    ├── InvalidInput            invalid input, with the expected and the actual value and a hint
    │   └── InvalidSettings     a setting is out of its range, or two settings contradict each other
    └── NotFinite               the arithmetic overflowed, or equations are singular to rounding; no result

Not converging is not an error: see `pliant.solver.Outcome`.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from pliant.schemas.invalid import Invalid, Picklable

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import ArrayLike, NDArray


class SolverError(Picklable):
    """The solver failed."""


class NotFinite(SolverError):
    """The arithmetic overflowed: the energy is infinite or NaN, or rounding errors made equations singular."""

    code = "not_finite"

    def __init__(self, what: str) -> None:
        super().__init__(f"{what}. Check the tracks for absurdly large values, or solve in float64.")


class InvalidInput(Invalid, SolverError):
    """An input is invalid; ``code``, ``field``, ``expected``, ``got`` and ``hint`` are attributes."""


class InvalidSettings(InvalidInput):
    """A setting is out of its range, or two settings contradict each other."""


@contextmanager
def singular_refused() -> Iterator[None]:
    """Raise `NotFinite` where rounding errors made a matrix singular or indefinite, as coordinates of very different sizes do."""
    from numpy.linalg import LinAlgError

    try:
        yield
    except LinAlgError as error:
        raise NotFinite(f"rounding errors made the equations singular ({error})") from error


def wrong_input(field: str, code: str, expected: str, got: str, hint: str) -> InvalidInput:
    """Return the error for an invalid input; all arguments are required and therefore positional."""
    return InvalidInput(code, field=field, expected=expected, got=got, hint=hint)


def numeric(value: ArrayLike, field: str, hint: str, *, kinds: str = "fiu") -> NDArray[np.generic]:
    """Return an input as an array, masked entries as NaN.

    Parameters
    ----------
    value : array_like
        The input.
    field : str
        Name of the input, for the error.
    hint : str
        What the user can do, for the error.
    kinds : str
        Kinds of dtype that are accepted, of ``b`` (bool), ``f`` (float), ``i`` and ``u`` (integers).

    Raises
    ------
    InvalidInput
        The input is a list of rows of different lengths, or its numbers are of another kind.
    """
    import numpy as np

    try:
        masked = isinstance(value, np.ma.MaskedArray)
        array = np.ma.filled(np.ma.asarray(value, dtype=float), np.nan) if masked else np.asarray(value)
    except (TypeError, ValueError):
        raise wrong_input(
            field,
            "wrong_type",
            "a rectangular array of numbers",
            f"a {type(value).__name__} that NumPy cannot convert",
            hint,
        ) from None
    if array.dtype.kind not in kinds:
        expected = "integers" if "f" not in kinds else "bool or numbers" if "b" in kinds else "real numbers"
        raise wrong_input(field, "wrong_type", expected, f"dtype {array.dtype}", hint)
    return array


def shape_text(array: NDArray[np.generic]) -> str:
    """Return the shape of an array as text for messages, e.g. ``(10, 3)``."""
    return "(" + ", ".join(str(n) for n in array.shape) + ")"
