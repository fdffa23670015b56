"""Rendered films with exact truth, for demonstrations, tests and benchmarks."""

from pliant.tracking.rendering.comparison import TrackAccuracy, Truth
from pliant.tracking.rendering.paint import face_paint
from pliant.tracking.rendering.rendered_film import RenderedFilm, render_film

__all__ = ["RenderedFilm", "TrackAccuracy", "Truth", "face_paint", "render_film"]
